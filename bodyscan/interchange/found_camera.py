"""A camera, or a projector described as one, as it stands in another program's file."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from bodyscan.arrays import Array
from bodyscan.errors import CalibrationFileError
from bodyscan.files.model import did_you_mean
from bodyscan.geometry.camera import Camera
from bodyscan.geometry.lenses.lens import Lens
from bodyscan.geometry.transforms import RigidTransform


@dataclass(frozen=True, eq=False)
class FoundCamera:
    """matrix: A of Eq. 1, (3, 3), px, whole numbers at pixel centres.

    size: of its picture, (width, height) px; None where the file does not say.
    camera_from_world: its pose, lengths in the file's unit; None where the file does not say.
    where: the file, and the line if it has lines.
    """

    matrix: Array
    lens: Lens
    size: tuple[int, int] | None
    camera_from_world: RigidTransform | None
    where: str

    def camera(self, width: int, height: int) -> Camera:
        """With a picture of that size, px.

        Raises CalibrationFileError if the file says another, or its axis is beside such a picture.
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
        if self.size is None and not (0.0 < u0 < width and 0.0 < v0 < height):
            raise CalibrationFileError(
                f"has its principal point at ({u0:.1f}, {v0:.1f}), outside of a picture of "
                f"{width} x {height} px: it is of another camera, or of pictures of another size",
                where=self.where,
                remedy=told,
            )
        return self.projector(width, height)

    def projector(self, width: int, height: int) -> Camera:
        """With a picture of that size, px; many projectors shine upwards, their axis beside it."""
        a = self.matrix
        return Camera(
            float(a[0, 0]), float(a[1, 1]), float(a[0, 1]), float(a[0, 2]), float(a[1, 2]),
            self.lens, width, height,
        )  # fmt: skip


def camera_named(cameras: Mapping[str, FoundCamera], name: str, where: str) -> FoundCamera:
    """One of a file's cameras. Raises CalibrationFileError, with those there are, if it is none."""
    if name not in cameras:
        raise CalibrationFileError(
            f"has no camera {name!r}{did_you_mean(name, cameras)}",
            where=where,
            remedy=f"it has {', '.join(cameras) or 'none'}; say which is meant in the rig file",
        )
    return cameras[name]
