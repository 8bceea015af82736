"""aniposelib's calibration.toml: tables cam_0, cam_1, ..., each with the camera's name.

Lengths are in the unit in which its board's squares were given. caliscope's TOML holds the same
tables of OpenCV's numbers below other keys.
"""

from __future__ import annotations

import json
import tomllib
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

from bodyscan.files.atomic import write_text
from bodyscan.interchange.foreign_file import ForeignFile
from bodyscan.interchange.found_camera import FoundCamera, FoundCameras
from bodyscan.interchange.rig_format import RigCameras, RigFormat, describe_opencv_lens

NOTE = (
    "# Pixel centres at whole numbers; x_camera = R(rotation) x_rig + translation. matrix holds the\n"
    "# skew, which OpenCV's functions ignore: use it with pixels sheared to\n"
    "# u - skew / fy * (v - cy), v.\n"
)


def write_aniposelib(cameras: RigCameras, path: Path) -> Path:
    """Write the cameras in mm; returns `path`."""
    tables = format_tables(cameras, "\n[cam_{number}]\nname = {name}\n", 1.0)
    write_text(Path(path), f"# Lengths in mm.\n{tables}\n[metadata]\nadjusted = true\n")
    return Path(path)


def format_tables(cameras: RigCameras, head: str, mm_a_unit: float) -> str:
    """Format NOTE and every camera's table.

    head: begins each table, with its {number} and {name}.
    """
    text = NOTE
    for number, (name, (camera, rig_from_camera)) in enumerate(cameras.items()):
        is_fisheye, coefficients = describe_opencv_lens(camera)
        pose = rig_from_camera.inverse()
        values = {
            "size": [camera.width, camera.height],
            "fisheye": is_fisheye,
            "matrix": camera.matrix.tolist(),
            "distortions": coefficients.tolist(),
            "rotation": pose.rotation_vector.tolist(),
            "translation": (pose.translation / mm_a_unit).tolist(),
        }
        text += head.format(number=number, name=json.dumps(name))
        text += "".join(f"{word} = {json.dumps(value)}\n" for word, value in values.items())
    return text


def read_aniposelib(path: Path) -> FoundCameras:
    """Read cameras by their names, and by those of their tables."""
    file = ForeignFile.read(path)
    return read_tables(file, parse_toml(file), "")


def parse_toml(file: ForeignFile) -> dict[str, Any]:
    """Parse a TOML file. Raises CalibrationFileError, with the line, if it is not TOML."""
    try:
        return tomllib.loads(file.text)
    except (ValueError, RecursionError) as error:  # TOMLDecodeError, a number of 5,000 digits
        raise file.error(f"is not TOML: {error}") from None


def read_tables(file: ForeignFile, tables: Mapping[str, Any], prefix: str) -> FoundCameras:
    """Find cameras by their tables' keys, which follow `prefix` in the file, and by their `name`.

    Raises CalibrationFileError if there are none.
    """
    readers = {}
    for key, table in tables.items():
        if isinstance(table, dict) and key != "metadata":
            readers[key] = partial(_read_table, file, table, prefix + key)
            readers[str(table.get("name", key))] = readers[key]
    if not readers:
        raise file.error("holds no cameras as this program writes them")
    return readers


def _read_table(file: ForeignFile, table: dict[str, Any], key: str) -> FoundCamera:
    file.require(table, ("size", "matrix", "distortions"), key)
    pose = None
    if all(table.get(word, "null") != "null" for word in ("rotation", "translation")):
        names = f"{key}.rotation", f"{key}.translation"
        pose = file.pose(table["rotation"], table["translation"], *names)
    return FoundCamera(
        file.matrix(table["matrix"], f"{key}.matrix"),
        file.lens(table["distortions"], f"{key}.distortions", table),
        file.size(table["size"], f"{key}.size"),
        pose,
        file.where(key),
    )


FORMAT = RigFormat("aniposelib.toml", None, write_aniposelib, read_aniposelib)
