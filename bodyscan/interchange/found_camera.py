"""A camera, or a projector described as one, as found in another program's file."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from bodyscan.arrays import Array
from bodyscan.errors import CalibrationFileError
from bodyscan.files.model import did_you_mean
from bodyscan.geometry.camera import Camera
from bodyscan.geometry.lenses.lens import Lens
from bodyscan.geometry.transforms import RigidTransform


@dataclass(frozen=True, eq=False)
class FoundCamera:
    """A camera, or a projector described as one, read from a file."""

    matrix: Array  # A of Eq. 1, (3, 3), px, whole numbers at pixel centres
    lens: Lens
    size: tuple[int, int] | None  # of its image, (width, height) px; None if the file does not say
    # Its pose, lengths in the file's unit; None if the file does not say.
    camera_from_world: RigidTransform | None
    where: str  # the file, and the line if it has lines

    def camera(self, width: int, height: int) -> Camera:
        """Make the camera with an image of that size, px.

        Raises CalibrationFileError if the file gives another size, if its axis is outside such an
        image, or if its lens folds within it.
        """
        remedy = "calibrate that camera as it is used now, or correct the size in the rig file"
        if self.size is not None and self.size != (width, height):
            raise CalibrationFileError(
                f"is of a camera of {self.size[0]} x {self.size[1]} px, the rig file says "
                f"{width} x {height} px",
                where=self.where,
                remedy=remedy,
            )
        centre, half = self.matrix[:2, 2], np.array([width, height]) / 2.0
        # Of a camera of known size: a shift lens moves its axis by less than half an image.
        if np.any(np.abs(centre / half - 1.0) >= (2.0 if self.size else 1.0)):
            raise CalibrationFileError(
                f"has its principal point at ({centre[0]:.1f}, {centre[1]:.1f}), outside an image of "
                f"{width} x {height} px: it is of another camera, or of images of another size",
                where=self.where,
                remedy=remedy,
            )
        return self.projector(width, height)

    def projector(self, width: int, height: int) -> Camera:
        """Make the projector with an image of that size, px; many shine upwards, their axis outside it.

        Raises CalibrationFileError if the lens folds within it.
        """
        a = self.matrix
        camera = Camera(
            float(a[0, 0]), float(a[1, 1]), float(a[0, 1]), float(a[0, 2]), float(a[1, 2]),
            self.lens, width, height,
        )  # fmt: skip
        # Every lens has rays in the inner half; without boards in the corners it may fold there.
        shares = np.linspace(0.25, 0.75, 5)
        inner = np.stack(np.meshgrid(shares, shares), axis=-1) * [width - 1.0, height - 1.0]
        if not np.isfinite(camera.rays(inner)).all():
            raise CalibrationFileError(
                f"its distortion is not invertible within {width} x {height} px: distortion and "
                "matrix do not belong together, or both belong to another device",
                where=self.where,
                remedy="name each device's matrix and distortion in the rig file, and check that "
                "camera and projector are not exchanged",
            )
        return camera


FoundCameras: TypeAlias = Mapping[str, Callable[[], FoundCamera]]
"""What reads each camera by its name, or raises CalibrationFileError, which hinders no other."""


def find_camera(cameras: FoundCameras, name: str, where: str) -> FoundCamera:
    """Find a camera by name.

    Raises CalibrationFileError if it cannot be used, or is not there: then all that are there are
    listed, those that cannot be used with the reasons.
    """
    if name in cameras:
        return cameras[name]()
    usable, reasons = [], []
    for other, read in cameras.items():
        try:
            read()
            usable.append(other)
        except CalibrationFileError as error:
            reasons.append(f"{other} cannot be used ({error.where}: {error.what})")
    has = f"it has {', '.join(usable) or 'none that can be used'}"
    raise CalibrationFileError(
        f"has no camera {name!r}{did_you_mean(name, cameras)}",
        where=where,
        # More reasons than eight cannot be read at a glance.
        remedy="; ".join([has, *reasons[:8], "say which is meant in the rig file"]),
    )
