"""caliscope's camera_array.toml: tables cameras.0, cameras.1, ...; metres."""

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


def write_caliscope(cameras: RigCameras, path: Path) -> Path:
    """Write the cameras, numbered in the order of the pairs, with the pairs' names beside the
    numbers.

    Returns `path`. Raises BadInput for a lens that OpenCV does not have.
    """
    text = "# Lengths in metres.\n" + TOML_NOTE
    for number, (name, (camera, rig_from_camera)) in enumerate(cameras.items()):
        text += f"\n[cameras.{number}]\ncam_id = {number}\nname = {json.dumps(name)}\n"
        text += "rotation_count = 0\n"
        text += format_camera_table(name, camera, rig_from_camera.inverse(), 1000.0)
    write_text(Path(path), text)
    return Path(path)


def read_caliscope(path: Path) -> FoundCameras:
    """Read cameras by their numbers, and by the pair's name if bodyscan wrote the file.

    `rotation_count` turns what caliscope shows, not what it calibrates, and is not looked at.
    """
    file = ForeignFile.read(path)
    tables = read_toml(file).get("cameras")
    return read_camera_tables(file, tables if isinstance(tables, dict) else {}, "cameras.")


FORMAT = RigFormat("camera_array.toml", "m", write_caliscope, read_caliscope)
