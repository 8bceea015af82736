"""aniposelib's calibration.toml: tables cam_0, cam_1, ..., each with the camera's name.

Lengths are in the unit in which its board's squares were given.
"""

from __future__ import annotations

import json
from pathlib import Path

from bodyscan.files.atomic import write_text
from bodyscan.interchange.foreign_file import ForeignFile
from bodyscan.interchange.found_camera import FoundCamera
from bodyscan.interchange.rig_format import RigCameras, RigFormat
from bodyscan.interchange.toml_cameras import NOTE, camera_of_table, read_toml, table_of_camera


def write_aniposelib(cameras: RigCameras, path: Path) -> Path:
    """Write the cameras in mm; returns `path`. Raises BadInput
    for a lens that OpenCV does not have."""
    text = "# Lengths in mm.\n" + NOTE
    for number, (name, (camera, rig_from_camera)) in enumerate(cameras.items()):
        text += f"\n[cam_{number}]\nname = {json.dumps(name)}\n"
        text += table_of_camera(name, camera, rig_from_camera.inverse(), 1.0)
    write_text(Path(path), f"{text}\n[metadata]\nadjusted = true\n")
    return Path(path)


def read_aniposelib(path: Path) -> dict[str, FoundCamera]:
    """Cameras by their names, and by those of their tables."""
    file = ForeignFile.read(path)
    tables = {key: own for key, own in read_toml(file).items() if key != "metadata"}
    found: dict[str, FoundCamera] = {}
    for key, own in tables.items():
        if not isinstance(own, dict) or "matrix" not in own:
            raise file.error("is not a camera as aniposelib writes it", key)
        found[key] = camera_of_table(file, own, key)
    named = {str(own["name"]): found[key] for key, own in tables.items() if "name" in own}
    if not found:
        raise file.error("holds no cameras")
    return found | named


FORMAT = RigFormat("aniposelib.toml", None, write_aniposelib, read_aniposelib)
