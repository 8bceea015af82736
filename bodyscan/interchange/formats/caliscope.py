"""caliscope's camera_array.toml: tables cameras.0, cameras.1, ...; metres."""

from __future__ import annotations

from pathlib import Path

from bodyscan.files.atomic import write_text
from bodyscan.interchange.foreign_file import ForeignFile
from bodyscan.interchange.formats.aniposelib import format_tables, parse_toml, read_tables
from bodyscan.interchange.found_camera import FoundCameras
from bodyscan.interchange.rig_format import RigCameras, RigFormat

HEAD = "\n[cameras.{number}]\ncam_id = {number}\nname = {name}\nrotation_count = 0\n"


def write_caliscope(cameras: RigCameras, path: Path) -> Path:
    """Write the cameras, numbered in the order of the pairs, with the pairs' names beside the
    numbers; returns `path`."""
    write_text(Path(path), f"# Lengths in metres.\n{format_tables(cameras, HEAD, 1000.0)}")
    return Path(path)


def read_caliscope(path: Path) -> FoundCameras:
    """Read cameras by their numbers, and by the pair's name if bodyscan wrote the file.

    `rotation_count` turns what caliscope shows, not what it calibrates, and is not looked at.
    """
    file = ForeignFile.read(path)
    tables = parse_toml(file).get("cameras")
    return read_tables(file, tables if isinstance(tables, dict) else {}, "cameras.")


FORMAT = RigFormat("camera_array.toml", "m", write_caliscope, read_caliscope)
