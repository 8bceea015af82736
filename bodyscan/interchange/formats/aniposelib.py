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
    read_camera_table,
    read_toml,
)
from bodyscan.interchange.found_camera import FoundCamera
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


def read_aniposelib(path: Path) -> dict[str, FoundCamera]:
    """Read cameras by their names, and by those of their tables."""
    file = ForeignFile.read(path)
    tables = {key: table for key, table in read_toml(file).items() if key != "metadata"}
    found: dict[str, FoundCamera] = {}
    for key, table in tables.items():
        if not isinstance(table, dict) or "matrix" not in table:
            raise file.error("is not a camera as aniposelib writes it", key)
        found[key] = read_camera_table(file, table, key)
    named = {str(table["name"]): found[key] for key, table in tables.items() if "name" in table}
    if not found:
        raise file.error("holds no cameras")
    return found | named


FORMAT = RigFormat("aniposelib.toml", None, write_aniposelib, read_aniposelib)
