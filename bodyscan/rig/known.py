"""What another program has already calibrated of a pair, and where its file says so."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated

from pydantic import Field, PositiveFloat

from bodyscan.files.model import Model, Problem, did_you_mean
from bodyscan.interchange.rig_format import RIG_FORMATS, Unit

Text = Annotated[str, Field(min_length=1)]
WITH_NODES = "opencv"
"""The format whose files leave names to the user, so that the rig file must give them."""


class KnownCamera(Model):
    """A camera, or a projector described as one, in another program's file.

    file: if it differs from the pair's.
    name: the camera's name in the file.
    matrix, distortion, size (or width and height), rotation, translation: names of OpenCV's nodes.
    inverse: rotation and translation take the camera's coordinates to the world's, not the reverse.
    """

    file: Text | None = None
    name: Text | None = None
    matrix: Text | None = None
    distortion: Text | None = None
    size: Text | None = None
    width: Text | None = None
    height: Text | None = None
    rotation: Text | None = None
    translation: Text | None = None
    inverse: bool = False

    @property
    def nodes(self) -> dict[str, str]:
        """Names of nodes, by what they hold."""
        given = {
            "matrix": self.matrix,
            "distortion": self.distortion,
            "size": self.size,
            "width": self.width,
            "height": self.height,
            "rotation": self.rotation,
            "translation": self.translation,
        }
        return {what: name for what, name in given.items() if name is not None}

    def problems(self) -> Iterator[Problem]:
        if (self.rotation is None) != (self.translation is None):
            absent = "rotation" if self.rotation is None else "translation"
            yield (absent,), "is missing: a pose is a rotation and a translation"
        if (self.width is None) != (self.height is None):
            absent = "width" if self.width is None else "height"
            yield (absent,), "is missing: a picture has a width and a height"
        if self.size is not None and self.width is not None:
            yield ("size",), "is said twice: give it, or width and height"
        if self.nodes and self.matrix is None:
            yield ("matrix",), "is missing: the node that holds the camera matrix"
        if self.nodes and self.name is not None:
            yield ("name",), "is for files that name their cameras: give it, or names of nodes"


class Known(Model):
    """A calibration by another program.

    file: relative to the rig file.
    units: of its lengths, where the format leaves that open.
    camera: if left out, the one named as the pair is.
    projector: if left out, nothing is known of it.
    sigma_px: standard deviation of pixels due to this calibration; None: it is used as it is, and
        its accuracy is unknown.
    """

    file: Text
    format: str
    units: Unit | None = None
    camera: KnownCamera = KnownCamera()
    projector: KnownCamera | None = None
    sigma_px: PositiveFloat | None = None

    def problems(self) -> Iterator[Problem]:
        names = RIG_FORMATS.names()
        if self.format not in names:
            known = f"{', '.join(names)} are"
            hint = did_you_mean(self.format, names)
            yield ("format",), f"is not a format known here, {known}{hint} (got {self.format!r})"
        elif self.format != WITH_NODES:
            for key, device in (("camera", self.camera), ("projector", self.projector)):
                for node in device.nodes if device else ():
                    yield (key, node), f"is for format: {WITH_NODES}; name the camera instead"
        light = self.projector
        if light and not (light.name or light.nodes or light.file):
            yield ("projector",), "does not say which of the file's cameras the projector is"
