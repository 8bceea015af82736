"""Calibrations on disk: `calibration.json`, diffable and exact, dense arrays beside it as .npz."""

from __future__ import annotations

import json
import zipfile
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ValidationError

from bodyscan.calibration.model_selection import HeldOutModel
from bodyscan.calibration.pair import PairCalibration, PairQuality
from bodyscan.errors import CalibrationFileError
from bodyscan.files.atomic import write_json, write_npz
from bodyscan.files.hashing import file_hash
from bodyscan.geometry.camera_fields import from_fields, to_fields
from bodyscan.geometry.light_planes import LightSheets
from bodyscan.geometry.pose_covariance import PoseCovariance
from bodyscan.geometry.sheet_arrays import from_arrays, to_arrays
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.registration.rig_calibration import RigCalibration, SeenCorners
from bodyscan.rig.rig import Rig
from bodyscan.version import __version__

SCHEMA = "bodyscan-calibration"
VERSION = 1
FILE_NAME = "calibration.json"
ARRAYS_NAME = "calibration.npz"


def save_calibration(calibration: RigCalibration, folder: Path) -> Path:
    """Write `calibration.json` and `calibration.npz` into `folder`; returns the JSON's path."""
    arrays: dict[str, Any] = {"placing_covariance": calibration.covariance.matrix}
    for name, pair in calibration.pairs.items():
        arrays[f"{name}/camera_covariance"] = pair.camera_covariance
        if pair.sheets is not None:
            for key, array in to_arrays(pair.sheets).items():
                arrays[f"{name}/light/{key}"] = array
        if pair.crossing is not None:
            for key, array in to_arrays(pair.crossing).items():
                arrays[f"{name}/crossing/{key}"] = array
    for name, seen in calibration.seen.items():
        for part in fields(seen):
            arrays[f"{name}/seen/{part.name}"] = getattr(seen, part.name)
    write_npz(folder / ARRAYS_NAME, **arrays)
    content = {
        "schema": SCHEMA,
        "version": VERSION,
        "software": f"bodyscan {__version__}",
        "arrays_sha256": file_hash(folder / ARRAYS_NAME),
        "rig": calibration.rig.model_dump(mode="json"),
        "pairs": {name: _pair_content(calibration, name) for name in calibration.pairs},
        "boards": [
            {"shot": shot, "board": board, "rig_from_board": transform.matrix}
            for (shot, board), transform in sorted(calibration.rig_from_board.items())
        ],
        "placing_covariance_order": calibration.covariance.names,
        "failed": calibration.failed,
        "notes": calibration.notes,
        "advice": calibration.advice,
    }
    write_json(folder / FILE_NAME, content)
    return folder / FILE_NAME


def load_calibration(path: Path) -> RigCalibration:
    """Read a calibration from its folder or its JSON file.

    Raises CalibrationFileError if files are missing, damaged, or of another schema version.
    """
    file = path / FILE_NAME if path.is_dir() else path
    if file.suffix in (".yaml", ".yml"):
        raise CalibrationFileError(
            "is a rig file, not a calibration",
            where=str(file),
            remedy="give the folder that `bodyscan calibrate-rig` wrote, by default `calibration` "
            "beside the rig file",
        )
    try:
        content = json.loads(file.read_text("utf-8"))
        if content.get("schema") != SCHEMA or content.get("version") != VERSION:
            raise CalibrationFileError(
                f"schema {content.get('schema')} version {content.get('version')}, "
                f"expected {SCHEMA} version {VERSION}",
                where=str(file),
                remedy="calibrate again with this version of bodyscan",
            )
        arrays_file = file.with_name(ARRAYS_NAME)
        if file_hash(arrays_file) != content["arrays_sha256"]:
            raise CalibrationFileError(
                f"does not belong to {file.name}",
                where=str(arrays_file),
                remedy="restore both files from one calibration, or calibrate again",
            )
        with np.load(arrays_file, allow_pickle=False) as arrays:
            return _calibration(content, arrays)
    except FileNotFoundError as error:
        raise CalibrationFileError(
            "there is no such file",
            where=str(error.filename or file),
            remedy="give the folder that `bodyscan calibrate-rig` wrote",
        ) from error
    except (
        OSError,
        KeyError,
        TypeError,
        AttributeError,
        ValueError,
        zipfile.BadZipFile,
        ValidationError,
    ) as error:
        raise CalibrationFileError(
            f"is not a readable calibration ({type(error).__name__}: {error})",
            where=str(file),
            remedy="restore the file from a copy, or calibrate again",
        ) from error


def calibration_id(path: Path) -> str:
    """SHA-256 of the calibration's JSON, which itself holds the hash of its arrays."""
    return file_hash(path / FILE_NAME if path.is_dir() else path)


def _pair_content(calibration: RigCalibration, name: str) -> dict[str, Any]:
    pair = calibration.pairs[name]
    crossing = {} if pair.crossing is None else {"crossing": _light_content(pair.crossing)}
    return {
        "camera": to_fields(pair.camera),
        "rig_from_camera": calibration.rig_from_camera[name].matrix,
        "light": None if pair.sheets is None else _light_content(pair.sheets),
        "quality": asdict(pair.quality),
    } | crossing


def _light_content(sheets: LightSheets) -> dict[str, Any]:
    return {"kind": sheets.kind, "direction": sheets.direction}


def _calibration(content: dict[str, Any], arrays: Any) -> RigCalibration:
    pairs = {
        name: PairCalibration(
            name,
            from_fields(part["camera"]),
            arrays[f"{name}/camera_covariance"],
            None if part["light"] is None else _light(part["light"], f"{name}/light/", arrays),
            _quality(part["quality"]),
            _light(part["crossing"], f"{name}/crossing/", arrays) if "crossing" in part else None,
        )
        for name, part in content["pairs"].items()
    }
    return RigCalibration(
        Rig.model_validate(content["rig"]),
        pairs,
        {name: _transform(part["rig_from_camera"]) for name, part in content["pairs"].items()},
        PoseCovariance(tuple(content["placing_covariance_order"]), arrays["placing_covariance"]),
        {
            (part["shot"], part["board"]): _transform(part["rig_from_board"])
            for part in content["boards"]
        },
        content["failed"],
        tuple(content["notes"]),
        tuple(content.get("advice", ())),
        {
            name: SeenCorners(**_under(f"{name}/seen/", arrays))
            for name in content["pairs"]
            if f"{name}/seen/pixels" in arrays.files
        },
    )


def _light(content: dict[str, Any], prefix: str, arrays: Any) -> LightSheets:
    return from_arrays(content["kind"], _under(prefix, arrays), content["direction"])


def _under(prefix: str, arrays: Any) -> dict[str, Any]:
    return {key.removeprefix(prefix): arrays[key] for key in arrays.files if key.startswith(prefix)}


def _quality(content: dict[str, Any]) -> PairQuality:
    tried = tuple(HeldOutModel(**figures) for figures in content["held_out"])
    two = {name: tuple(content[name]) for name in ("flatness_mm", "boards_mm") if content.get(name)}
    return PairQuality(**content | {"held_out": tried} | two)


def _transform(matrix: Any) -> RigidTransform:
    """As written, to the last bit: no orthonormalisation on reading."""
    array = np.array(matrix, float)
    return RigidTransform(array[:3, :3].copy(), array[:3, 3].copy())
