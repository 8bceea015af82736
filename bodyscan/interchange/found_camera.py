"""A camera, or a projector described as one, as found in another program's file."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from bodyscan.arrays import Array
from bodyscan.errors import CalibrationFileError
from bodyscan.files.model import did_you_mean
from bodyscan.geometry.camera import Camera
from bodyscan.geometry.lenses.lens import Lens
from bodyscan.geometry.transforms import RigidTransform

SHIFTED = 0.5
"""How far outside its image the axis of a camera of known size may lie, in image sizes: a shift
lens moves it by less."""
STEPS = np.linspace(0.25, 0.75, 5)
INNER = np.stack(np.meshgrid(STEPS, STEPS), axis=-1)
"""Where every lens has rays; one fitted without boards in the corners may fold there."""


@dataclass(frozen=True, eq=False)
class FoundCamera:
    """A camera, or a projector described as one, read from a file.

    matrix: A of Eq. 1, (3, 3), px, whole numbers at pixel centres.
    size: of its image, (width, height) px; None if the file does not say.
    camera_from_world: its pose, lengths in the file's unit; None if the file does not say.
    where: the file, and the line if it has lines.
    """

    matrix: Array
    lens: Lens
    size: tuple[int, int] | None
    camera_from_world: RigidTransform | None
    where: str

    def camera(self, width: int, height: int) -> Camera:
        """The camera with an image of that size, px.

        Raises CalibrationFileError if the file gives another size, if its axis is outside such an
        image, or if its lens folds within it.
        """
        told = "calibrate that camera as it is used now, or correct the size in the rig file"
        if self.size is not None and self.size != (width, height):
            raise CalibrationFileError(
                f"is of a camera of {self.size[0]} x {self.size[1]} px, the rig file says "
                f"{width} x {height} px",
                where=self.where,
                remedy=told,
            )
        u0, v0 = float(self.matrix[0, 2]), float(self.matrix[1, 2])
        aside = SHIFTED if self.size else 0.0
        if not (
            -aside * width < u0 < (1.0 + aside) * width
            and -aside * height < v0 < (1.0 + aside) * height
        ):
            raise CalibrationFileError(
                f"has its principal point at ({u0:.1f}, {v0:.1f}), outside of a picture of "
                f"{width} x {height} px: it is of another camera, or of pictures of another size",
                where=self.where,
                remedy=told,
            )
        return self.projector(width, height)

    def projector(self, width: int, height: int) -> Camera:
        """The projector with an image of that size, px; its axis may be outside it, as many shine
        upwards.

        Raises CalibrationFileError if the lens folds within it.
        """
        a = self.matrix
        camera = Camera(
            float(a[0, 0]), float(a[1, 1]), float(a[0, 1]), float(a[0, 2]), float(a[1, 2]),
            self.lens, width, height,
        )  # fmt: skip
        inner = INNER * [width - 1.0, height - 1.0]
        if not np.isfinite(camera.rays(inner)).all():
            raise CalibrationFileError(
                f"has a lens that folds inside a picture of {width} x {height} px: distortion and "
                "matrix do not belong together, or both to another device",
                where=self.where,
                remedy="name each device's own matrix and distortion in the rig file: are camera and "
                "projector exchanged?",
            )
        return camera


def camera_named(cameras: Mapping[str, FoundCamera], name: str, where: str) -> FoundCamera:
    """One of a file's cameras. Raises CalibrationFileError, which lists them, if there is none."""
    if name not in cameras:
        raise CalibrationFileError(
            f"has no camera {name!r}{did_you_mean(name, cameras)}",
            where=where,
            remedy=f"it has {', '.join(cameras) or 'none'}; say which is meant in the rig file",
        )
    return cameras[name]
