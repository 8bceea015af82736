"""What a format for the cameras of a calibrated rig provides, and the registry of formats."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal, TypeAlias

from bodyscan.files.registry import Registry

if TYPE_CHECKING:
    from bodyscan.arrays import Array
    from bodyscan.geometry.camera import Camera
    from bodyscan.geometry.transforms import RigidTransform
    from bodyscan.interchange.found_camera import FoundCamera, FoundCameras

RigCameras: TypeAlias = "Mapping[str, tuple[Camera, RigidTransform]]"
"""Camera and `rig_from_camera` by the pair's name; projectors, as cameras, by `projector_name`."""
Unit = Literal["mm", "cm", "m"]
MILLIMETRES: dict[Unit, float] = {"mm": 1.0, "cm": 10.0, "m": 1000.0}  # per unit
Nodes: TypeAlias = Mapping[str, str]
"""Names of a file's nodes by what they hold: matrix, distortion, size, width, height, rotation ..."""


@dataclass(frozen=True)
class RigFormat:
    """One format.

    path: of what is written, a file or a folder, below the folder that the user chose.
    unit: of lengths in such files; None if the format leaves it open.
    write: writes cameras to that path, which it returns; raises BadInput for a lens that the format
        cannot express.
    read: returns every camera of such a file or folder, by name, each checked when it is taken.
    read_nodes: reads one camera of a file whose nodes may have any name, and its pose of that file or
        another; None if the format fixes the names. Both raise CalibrationFileError.
    """

    path: str
    unit: Unit | None
    write: Callable[[RigCameras, Path], Path]
    read: Callable[[Path], FoundCameras]
    read_nodes: Callable[[Path, Nodes, Path | None], FoundCamera] | None = None


def projector_name(pair: str) -> str:
    """Return the name of a pair's projector among the cameras."""
    return f"{pair}-projector"


def describe_opencv_lens(camera: Camera) -> tuple[bool, Array]:
    """Return whether the lens is OpenCV's fisheye, and its coefficients: four, or else five or more."""
    is_fisheye = camera.lens.kind == "fisheye"
    return is_fisheye, camera.lens.coefficients if is_fisheye else camera.lens.opencv()


RIG_FORMATS: Registry[RigFormat] = Registry("bodyscan.interchange.formats", "a rig")
