"""mrcal's .cameramodel: one file per camera, a Python literal; rt_cam_ref was once extrinsics.

Lengths are in the unit in which its board was given.
"""

from __future__ import annotations

import ast
import re
import warnings
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from bodyscan.errors import BadInput, CalibrationFileError
from bodyscan.files.atomic import write_text
from bodyscan.interchange.foreign_file import ForeignFile
from bodyscan.interchange.found_camera import FoundCamera, FoundCameras
from bodyscan.interchange.rig_format import RigCameras, RigFormat, describe_opencv_lens

COEFFICIENTS = {"PINHOLE": 0, "OPENCV4": 4, "OPENCV5": 5, "OPENCV8": 8, "OPENCV12": 12}
SUFFIX = ".cameramodel"
SKEW = "bodyscan skew: "


def write_mrcal(cameras: RigCameras, folder: Path) -> Path:
    """Write one file per pair, mm; the reference is the rig frame. Returns `folder`.

    Raises BadInput for a lens that mrcal does not have, before anything is written.
    """
    texts = {name: _format_model(name, *camera) for name, camera in cameras.items()}
    for name, text in texts.items():
        write_text(Path(folder) / f"{name}{SUFFIX}", text)
    return Path(folder)


def read_mrcal(path: Path) -> FoundCameras:
    """Read the cameras of one file, or of all in a folder, by the files' names without suffix."""
    files = sorted(path.glob(f"*{SUFFIX}")) if path.is_dir() else [path]
    if not files:
        remedy = "give a file or their folder"
        raise ForeignFile(path).error(f"holds no {SUFFIX} files", remedy=remedy)
    return {file.stem: partial(_read_model, file) for file in files}


def _format_model(name: str, camera: Any, rig_from_camera: Any) -> str:
    is_fisheye, coefficients = describe_opencv_lens(camera)
    rest = np.flatnonzero(coefficients)
    used = int(rest[-1]) + 1 if len(rest) else 0
    model = next((m for m, count in COEFFICIENTS.items() if count >= used), None)
    if model is None or is_fisheye:
        what = f"mrcal has no lens like {camera.lens.kind!r}"
        raise BadInput(what, where=f"pair {name}", remedy="choose another format")
    lens = np.append(coefficients, np.zeros(12))[: COEFFICIENTS[model]]
    intrinsics = [camera.alpha, camera.beta, camera.u0, camera.v0, *lens.tolist()]
    camera_from_rig = rig_from_camera.inverse()
    extrinsics = [*camera_from_rig.rotation_vector.tolist(), *camera_from_rig.translation.tolist()]
    return (
        f"# Pair {name}. Lengths in mm. The reference is the rig frame.\n"
        "# mrcal's cameras have no skew: shear a point (u, v) of the pair to\n"
        "# (u - skew / fy * (v - cy), v) before using it with this model.\n"
        f"# {SKEW}{camera.gamma!r}\n"
        "{\n"
        f"    'lensmodel': 'LENSMODEL_{model}',\n"
        f"    'intrinsics': {intrinsics!r},\n"
        f"    'extrinsics': {extrinsics!r},\n"
        f"    'imagersize': [{camera.width}, {camera.height}],\n"
        "}\n"
    )


def _read_model(path: Path) -> FoundCamera:
    file = ForeignFile.read(path)
    content = _parse_literal(file)
    model = str(content.get("lensmodel", content.get("distortion_model", "")))
    kind = re.sub("^NONE$", "PINHOLE", re.sub(r"^(LENSMODEL|DISTORTION)_", "", model))
    pose_key = "extrinsics" if "extrinsics" in content else "rt_cam_ref"
    file.require(content, ("intrinsics", pose_key, "imagersize"), "")
    if kind not in COEFFICIENTS:
        remedy = f"mrcal-convert-lensmodel makes one of {', '.join(COEFFICIENTS)}"
        raise file.error(f"{model!r} is a lens that is not supported", "lensmodel", remedy)
    numbers = file.numbers(content["intrinsics"], "intrinsics", 4 + COEFFICIENTS[kind])
    matrix = file.pinhole_matrix(numbers[:4], "intrinsics")
    skew = re.search(rf"^# {SKEW}(\S+)$", file.text, re.MULTILINE)
    if skew:
        matrix[0, 1] = file.numbers(skew[1], "skew", 1)[0]
    pose = file.numbers(content[pose_key], pose_key, 6)
    return FoundCamera(
        matrix,
        file.lens(numbers[4:], "intrinsics"),
        file.size(content["imagersize"], "imagersize"),
        file.pose(pose[:3], pose[3:], pose_key),
        file.where("intrinsics"),
    )


def _parse_literal(file: ForeignFile) -> dict[Any, Any]:
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", SyntaxWarning)
            content = ast.literal_eval(file.text.strip())
    except (SyntaxError, ValueError, MemoryError, RecursionError) as error:
        line = getattr(error, "lineno", None)
        raise CalibrationFileError(
            "is not an mrcal cameramodel",
            where=f"{file.path}:{line}" if line else str(file.path),
            remedy="give the file as mrcal wrote it",
        ) from None
    if not isinstance(content, dict):
        raise file.error("is not an mrcal cameramodel")
    return content


FORMAT = RigFormat("mrcal", None, write_mrcal, read_mrcal)
