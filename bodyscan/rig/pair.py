"""A pair: its camera, its projector, their nominal poses, and what another program calibrated."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, Literal

from pydantic import Field, PositiveFloat

from bodyscan.files.model import Model, Name, Problem, did_you_mean
from bodyscan.interchange.rig_format import RIG_FORMATS, Unit
from bodyscan.rig.gauge import Vector
from bodyscan.stripes.codes import AnyStripeCode

Pixels = Annotated[int, Field(gt=0, le=32767)]
AUTO = "auto"  # held-out boards choose the lens


class CameraSpec(Model):
    """A camera's image size in pixels, its kind of lens, and what its files hold.

    lens: a kind of lens; auto: held-out boards choose.
    bits: per grey level, where 16-bit files hold fewer and their numbers do not show it.
    channel: which channel of a colour image is used; grey: all of them, as luma.
    """

    width: Pixels
    height: Pixels
    bits: Annotated[int, Field(ge=8, le=16)] | None = None
    channel: Literal["grey", "red", "green", "blue"] = "grey"
    lens: str = AUTO

    @property
    def channel_number(self) -> int | None:
        """Which of red, green and blue is used, from 0; None for all of them."""
        return None if self.channel == "grey" else ("red", "green", "blue").index(self.channel)

    def problems(self) -> Iterator[Problem]:
        if self.lens == AUTO:
            return
        from bodyscan.geometry.lenses import LENSES  # imported here: heavier than a rig file needs

        if self.lens not in LENSES:
            yield ("lens",), f"must be one of {', '.join((AUTO, *LENSES))} (got {self.lens!r})"


class NominalPose(Model):
    """A nominal pose in the rig frame: at `position_mm`, looking at `look_at_mm`."""

    position_mm: Vector
    look_at_mm: Vector

    def problems(self) -> Iterator[Problem]:
        if self.position_mm == self.look_at_mm:
            yield ("look_at_mm",), "must differ from position_mm, or it looks nowhere"


Text = Annotated[str, Field(min_length=1)]


class KnownCamera(Model):
    """A camera, or a projector described as one, in another program's file.

    file: if it differs from the pair's.
    pose_file: if rotation and translation are in another file than the matrix.
    name: the camera's name in the file.
    matrix, distortion, size (or width and height), rotation, translation: names of OpenCV's nodes.
    inverse: rotation and translation take the camera's coordinates to the world's, not the reverse.
    """

    file: Text | None = None
    pose_file: Text | None = None
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
        keys = ("matrix", "distortion", "size", "width", "height", "rotation", "translation")
        return {key: getattr(self, key) for key in keys if getattr(self, key) is not None}

    def problems(self) -> Iterator[Problem]:
        for keys, what in (
            (("rotation", "translation"), "a pose is a rotation and a translation"),
            (("width", "height"), "an image has a width and a height"),
        ):
            absent = [key for key in keys if getattr(self, key) is None]
            if len(absent) == 1:
                yield (absent[0],), f"is missing: {what}"
        if self.pose_file is not None and self.rotation is None:
            yield ("rotation",), "is missing: the node of `pose_file` that holds it"
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
        elif self.format != "opencv":  # whose files leave names to the user
            for key, device in (("camera", self.camera), ("projector", self.projector)):
                for node in device.nodes if device else ():
                    yield (key, node), "is for format: opencv; name the camera instead"
        named = self.projector
        if named and not (named.name or named.nodes or named.file):
            yield ("projector",), "does not say which of the file's cameras the projector is"


class Pair(Model):
    """One camera and one projector, or a camera alone.

    known: what another program has calibrated of it.
    """

    name: Name
    pole: Name | None = None
    camera: CameraSpec
    projector: AnyStripeCode | None = None
    nominal: NominalPose | None = None
    projector_nominal: NominalPose | None = None
    known: Known | None = None

    def problems(self) -> Iterator[Problem]:
        if self.projector_nominal and not self.projector:
            yield ("projector_nominal",), "needs a projector: this pair is a camera alone"
        if self.known and self.known.projector and not self.projector:
            yield ("known", "projector"), "needs a projector: this pair is a camera alone"
        if self.known and self.known.projector and self.projector and self.projector.stripes == 1:
            yield ("known", "projector"), "is no laser: leave it out, boards calibrate its line"
