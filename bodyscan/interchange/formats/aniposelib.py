"""aniposelib's calibration.toml: tables cam_0, cam_1, ..., each with the camera's name.

Lengths are in the unit in which its board's squares were given.
"""

from __future__ import annotations

import json
from pathlib import Path

from bodyscan.files.atomic import write_text
from bodyscan.interchange.foreign_file import (
    TOML_NOTE,
    ForeignFile,
    format_camera_table,
    read_camera_tables,
    read_toml,
)
from bodyscan.interchange.found_camera import FoundCameras
from bodyscan.interchange.rig_format import RigCameras, RigFormat


def write_aniposelib(cameras: RigCameras, path: Path) -> Path:
    """Write the cameras in mm; returns `path`. Raises BadInput
    for a lens that OpenCV does not have."""
    text = "# Lengths in mm.\n" + TOML_NOTE
    for number, (name, (camera, rig_from_camera)) in enumerate(cameras.items()):
        text += f"\n[cam_{number}]\nname = {json.dumps(name)}\n"
        text += format_camera_table(name, camera, rig_from_camera.inverse(), 1.0)
    write_text(Path(path), f"{text}\n[metadata]\nadjusted = true\n")
    return Path(path)


def read_aniposelib(path: Path) -> FoundCameras:
    """Read cameras by their names, and by those of their tables."""
    file = ForeignFile.read(path)
    return read_camera_tables(file, read_toml(file), "")


FORMAT = RigFormat("aniposelib.toml", None, write_aniposelib, read_aniposelib)
