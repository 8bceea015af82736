"""What the TOML of caliscope and of aniposelib share: a table of OpenCV's numbers per camera."""

from __future__ import annotations

import tomllib
from typing import Any

from bodyscan.geometry.camera import Camera
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.interchange.foreign_file import ForeignFile
from bodyscan.interchange.found_camera import FoundCamera
from bodyscan.interchange.rig_format import opencv_lens

NOTE = (
    "# Pixel centres at whole numbers; x_camera = R(rotation) x_rig + translation. matrix holds the\n"
    "# skew, which OpenCV's functions ignore: use it with pixels sheared to\n"
    "# u - skew / fy * (v - cy), v.\n"
)


def read_toml(file: ForeignFile) -> dict[str, Any]:
    """The content of a TOML file. Raises CalibrationFileError, with the line, if it is not TOML."""
    try:
        return tomllib.loads(file.text)
    except tomllib.TOMLDecodeError as error:
        raise file.error(f"is not TOML: {error}") from None


def camera_of_table(file: ForeignFile, table: dict[str, Any], key: str) -> FoundCamera:
    """The camera in a table; key: the table's own, as written in the file."""
    file.require(table, ("size", "matrix", "distortions"), key)
    if table.get("fisheye", False):
        raise file.error(
            "is OpenCV's fisheye lens, which there is not here", "fisheye",
            "calibrate it with an ordinary lens", after=key,
        )  # fmt: skip
    pose = None
    if "rotation" in table and "translation" in table:
        words = "rotation", "translation"
        pose = file.pose(table["rotation"], table["translation"], words, after=key)
    return FoundCamera(
        file.matrix(table["matrix"], "matrix", after=key),
        file.lens(table["distortions"], "distortions", after=key),
        file.size(table["size"], "size", after=key),
        pose,
        file.where(key),
    )


def table_of_camera(
    name: str, camera: Camera, camera_from_rig: RigidTransform, mm_a_unit: float
) -> str:
    """The lines for size, matrix, distortions, rotation and translation.

    Raises BadInput for a lens that OpenCV does not have.
    """
    return "".join(
        f"{word} = {value!r}\n"
        for word, value in (
            ("size", [camera.width, camera.height]),
            ("matrix", camera.matrix.tolist()),
            ("distortions", opencv_lens(name, camera).tolist()),
            ("rotation", camera_from_rig.rotation_vector.tolist()),
            ("translation", (camera_from_rig.translation / mm_a_unit).tolist()),
        )
    )
