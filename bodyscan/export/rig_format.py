"""How a calibrated rig is written for another program, and read back."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias

from bodyscan.export.registry import Registry

if TYPE_CHECKING:
    from bodyscan.geometry.camera import Camera
    from bodyscan.geometry.transforms import RigidTransform
    from bodyscan.registration.rig_calibration import RigCalibration

RigCameras: TypeAlias = "dict[str, tuple[Camera, RigidTransform]]"
"""Camera and `rig_from_camera` by the pair's name."""


@dataclass(frozen=True)
class RigFormat:
    """path: of what is written, a file or a folder, below the folder that the user chose.
    write: a calibration to that path, which it returns.  read: cameras and poses from it; raises
    BadInput."""

    path: str
    write: Callable[[RigCalibration, Path], Path]
    read: Callable[[Path], RigCameras]


RIG_FORMATS: Registry[RigFormat] = Registry("bodyscan.export.rig_formats", "a rig")


def cameras_of(calibration: RigCalibration) -> RigCameras:
    """Camera and pose of every pair of a calibration."""
    return {
        name: (pair.camera, calibration.rig_from_camera[name])
        for name, pair in calibration.pairs.items()
    }
