"""Calibrations on disk: an exact, diffable `calibration.json` and dense arrays as .npz.

The JSON holds the hash of the arrays and one of its own content, so that a change by hand, a disk
fault or an interrupted copy does not go unnoticed.
"""

from __future__ import annotations

import json
from contextlib import suppress
from dataclasses import asdict, fields, replace
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import TypeAdapter, ValidationError

from bodyscan.calibration.pair import PairCalibration, PairQuality
from bodyscan.errors import CalibrationFileError
from bodyscan.files.atomic import format_json, write_bytes, write_json, write_npz
from bodyscan.files.hashing import hash_content, hash_file
from bodyscan.files.model import describe_first_error
from bodyscan.files.reading import read_json_object, read_npz, read_regular
from bodyscan.geometry.camera import camera_from_fields, describe_camera
from bodyscan.geometry.light_planes import LightSheets
from bodyscan.geometry.light_sheets import sheets_from_arrays, sheets_to_arrays
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.geometry.uncertainty import COLUMNS, ROWS, PoseCovariance, RayUncertainty
from bodyscan.registration.rig_calibration import ObservedCorners, RigCalibration
from bodyscan.registration.sanity_checks import find_faults
from bodyscan.rig.rig import Rig
from bodyscan.version import __version__

SCHEMA = "bodyscan-calibration"
VERSION = 2
WITHOUT_HASH = 1
"""The previous version, also read: it had no hash of the JSON itself."""
HASH = "sha256"
EDITED = "the calibration was edited by hand, and the change accepted"
FILE_NAME = "calibration.json"
HISTORY = "history"
ARRAYS_NAME = "calibration.npz"
CORNERS_NAME = "corners.vnl"
REPORT_NAME, MAP_NAME = "report.html", "sigma-map.png"
DERIVED = (REPORT_NAME, MAP_NAME)
"""What is made from a calibration and lies beside it; it goes when the calibration changes."""
ACCEPT = "if the change is meant, say `bodyscan accept-changed` of its folder"
CHANGED = f"restore the file from a copy, or calibrate again; {ACCEPT}"

UNUSED_QUALITY: dict[str, Any] = {"flatness_mm": None, "ways": []}
"""Keys of a pair's quality that files of 0.2 and before fill; they are written empty, not read."""


def refuse_existing(folder: Path, overwrite: bool) -> None:
    """Raise CalibrationFileError if `folder` holds a calibration that may not be replaced."""
    if (folder / FILE_NAME).exists() and not overwrite:
        raise CalibrationFileError(
            "a calibration already exists here",
            where=str(folder),
            remedy="give another --out, or use --overwrite: this one then moves into its "
            f"`{HISTORY}`, where scans made with it are found again",
        )


def archive_previous(folder: Path) -> Path | None:
    """Copy the calibration in `folder` into its `history/HASH`, before it is replaced; what was made
    from it moves there.

    HASH is the one by which scans refer to it. Returns the copy's folder, None if there is none.
    """
    if not (folder / FILE_NAME).exists():
        return None
    kept = folder / HISTORY / calibration_id(folder)
    with suppress(FileNotFoundError):  # without its arrays it is as damaged there as here
        for name in (ARRAYS_NAME, FILE_NAME):  # the JSON, which vouches for both, comes last
            write_bytes(kept / name, read_regular(folder / name))
    for name in (*DERIVED, CORNERS_NAME):
        with suppress(FileNotFoundError):
            (folder / name).replace(kept / name)
    return kept


def save_calibration(calibration: RigCalibration, folder: Path) -> Path:
    """Write `calibration.json` and `calibration.npz` into `folder`; return the JSON's path.

    Reports and maps of what was there are removed: they would be taken for the new one's.

    Until the JSON is replaced, which is atomic, the calibration that `archive_previous` kept is loaded.
    """
    arrays: dict[str, Any] = {"placing_covariance": calibration.covariance.matrix}
    for name, pair in calibration.pairs.items():
        arrays[f"{name}/camera_covariance"] = pair.camera_covariance
        for key, sheets in (("light", pair.sheets), ("crossing", pair.crossing)):
            parts = sheets_to_arrays(sheets) if sheets is not None else {}
            arrays |= {f"{name}/{key}/{part}": array for part, array in parts.items()}
        parts = vars(pair.rays) if pair.rays is not None else {}
        arrays |= {f"{name}/rays/{part}": array for part, array in parts.items()}
    for name, corners in calibration.observed.items():
        arrays |= {f"{name}/seen/{part}": array for part, array in vars(corners).items()}
    write_npz(folder / ARRAYS_NAME, **arrays)
    content = {
        "schema": SCHEMA,
        "version": VERSION,
        "software": f"bodyscan {__version__}",
        "arrays_sha256": hash_file(folder / ARRAYS_NAME),
        "rig": calibration.rig.model_dump(mode="json"),
        "pairs": {name: _describe_pair(calibration, name) for name in calibration.pairs},
        "boards": [
            {"shot": shot, "board": board, "rig_from_board": transform.matrix}
            for (shot, board), transform in sorted(calibration.rig_from_board.items())
        ],
        "placing_covariance_order": calibration.covariance.names,
        "failed": calibration.failed,
        "notes": calibration.notes,
        "advice": calibration.advice,
    }
    plain = json.loads(format_json(content))
    for name in DERIVED:
        (folder / name).unlink(missing_ok=True)
    write_json(folder / FILE_NAME, plain | {HASH: hash_content(plain)})
    return folder / FILE_NAME


def load_calibration(path: Path, *, accept_changed: bool = False) -> RigCalibration:
    """Read a calibration from its folder or its JSON file.

    accept_changed: read it although it has changed since it was stored.

    Raises CalibrationFileError if files are missing, changed, of another schema version, or hold
    what no calibration can have.
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
        content = read_json_object(file)
        if content.get("schema") != SCHEMA or content.get("version") not in (VERSION, WITHOUT_HASH):
            raise CalibrationFileError(
                f"schema {content.get('schema')} version {content.get('version')}, "
                f"expected {SCHEMA} version {VERSION}",
                where=str(file),
                remedy="calibrate again with this version of bodyscan",
            )
        arrays_file = _find_arrays(file, content)
        if not accept_changed:
            _refuse_changed(content, file, arrays_file)
        calibration = _read_calibration(content, read_npz(arrays_file))
    except FileNotFoundError as error:
        raise CalibrationFileError(
            "there is no such file",
            where=str(error.filename or file),
            remedy="give the folder that `bodyscan calibrate-rig` wrote",
        ) from error
    except (OSError, LookupError, TypeError, AttributeError, ValueError, OverflowError) as error:
        raise CalibrationFileError(
            f"is not a readable calibration ({_format_reason(error)})",
            where=str(file),
            remedy="restore the file from a copy, or calibrate again",
        ) from error
    # An error lists five.
    faults = list(islice(find_faults(calibration), 5))
    if faults:
        raise CalibrationFileError(
            "holds what no calibration can be like:"
            + "".join(f"\n  {where} {what}" for where, what in faults),
            where=str(file),
            remedy="restore the file from a copy, or calibrate again",
        )
    return calibration


def accept_calibration(path: Path) -> Path | None:
    """Store an edited calibration as valid, with a note that says so; return the path of its JSON.

    None, with nothing written, if it is as stored. Raises as `load_calibration`, but for the change.
    """
    folder = path if path.is_dir() else path.parent
    found = load_calibration(folder, accept_changed=True)
    content = read_json_object(folder / FILE_NAME)
    with suppress(CalibrationFileError):
        _refuse_changed(content, folder / FILE_NAME, _find_arrays(folder / FILE_NAME, content))
        if content["version"] != WITHOUT_HASH:  # which does not tell whether it was edited
            return None
    return save_calibration(replace(found, notes=(*found.notes, EDITED)), folder)


def _find_arrays(file: Path, content: dict[str, Any]) -> Path:
    """The arrays beside the JSON, or the kept ones if a replacement was interrupted."""
    current = file.with_name(ARRAYS_NAME)
    archived = file.parent / HISTORY / hash_file(file) / ARRAYS_NAME
    expected = content.get("arrays_sha256")
    if archived.exists() and hash_file(current) != expected and hash_file(archived) == expected:
        return archived
    return current


def _refuse_changed(content: dict[str, Any], file: Path, arrays_file: Path) -> None:
    if content["version"] == VERSION:
        unhashed = {key: value for key, value in content.items() if key != HASH}
        if hash_content(unhashed) != content.get(HASH):
            raise CalibrationFileError(
                "was changed after it was stored", where=str(file), remedy=CHANGED
            )
    if hash_file(arrays_file) != content.get("arrays_sha256"):
        raise CalibrationFileError(
            f"does not belong to {file.name}",
            where=str(arrays_file),
            remedy=f"restore both files from one calibration, or calibrate again; {ACCEPT}",
        )


def _format_reason(error: Exception) -> str:
    if isinstance(error, ValidationError):
        return describe_first_error(error)
    return f"{error.args[0]} is missing" if isinstance(error, KeyError) else str(error)


def calibration_id(path: Path) -> str:
    """SHA-256 of the calibration's JSON, which itself holds the hash of its arrays."""
    return hash_file(path / FILE_NAME if path.is_dir() else path)


def _describe_pair(calibration: RigCalibration, name: str) -> dict[str, Any]:
    pair = calibration.pairs[name]
    crossing = {} if pair.crossing is None else {"crossing": _describe_light(pair.crossing)}
    return {
        "camera": describe_camera(pair.camera),
        "rig_from_camera": calibration.rig_from_camera[name].matrix,
        "light": None if pair.sheets is None else _describe_light(pair.sheets),
        "quality": asdict(pair.quality) | UNUSED_QUALITY,
    } | crossing


def _describe_light(sheets: LightSheets) -> dict[str, Any]:
    return {"kind": sheets.kind, "direction": sheets.direction}


def _read_calibration(content: dict[str, Any], arrays: dict[str, Any]) -> RigCalibration:
    parts = content["pairs"]
    pairs = {
        name: PairCalibration(
            name,
            camera_from_fields(part["camera"]),
            arrays[f"{name}/camera_covariance"],
            None if part["light"] is None else _read_light(part["light"], f"{name}/light/", arrays),
            _read_quality(part["quality"]),
            _read_light(part["crossing"], f"{name}/crossing/", arrays)
            if "crossing" in part
            else None,
            _read_ray_uncertainty(name, arrays),
        )
        for name, part in parts.items()
    }
    read = TypeAdapter(tuple[str, str]).validate_python
    boards = {
        read((part["shot"], part["board"]), strict=True): _transform(part["rig_from_board"])
        for part in content["boards"]
    }
    if len(boards) < len(content["boards"]):
        raise ValueError("a board of a shot is listed twice")
    return RigCalibration(
        Rig.model_validate(content["rig"]),
        pairs,
        {name: _transform(part["rig_from_camera"]) for name, part in parts.items()},
        PoseCovariance(
            _read_texts(content["placing_covariance_order"]), arrays["placing_covariance"]
        ),
        boards,
        TypeAdapter(dict[str, str]).validate_python(content["failed"], strict=True),
        _read_texts(content["notes"]),
        _read_texts(content.get("advice", [])),
        {
            name: ObservedCorners(**_select_prefixed(f"{name}/seen/", arrays))
            for name in parts
            if f"{name}/seen/pixels" in arrays
        },
    )


def _read_light(content: dict[str, Any], prefix: str, arrays: dict[str, Any]) -> LightSheets:
    return sheets_from_arrays(
        content["kind"], _select_prefixed(prefix, arrays), content["direction"]
    )


def _read_ray_uncertainty(name: str, arrays: dict[str, Any]) -> RayUncertainty | None:
    parts = _select_prefixed(f"{name}/rays/", arrays)
    if not parts:
        return None
    for part in parts.values():
        if part.shape != (ROWS, COLUMNS) or not np.all(part >= 0.0):
            raise ValueError(f"the rays of {name} have no standard deviations, {ROWS} x {COLUMNS}")
    return RayUncertainty(**parts)


def _select_prefixed(prefix: str, arrays: dict[str, Any]) -> dict[str, Any]:
    return {k.removeprefix(prefix): array for k, array in arrays.items() if k.startswith(prefix)}


def _read_quality(content: dict[str, Any]) -> PairQuality:
    """Read the quality, requiring exactly the types of its fields."""
    content = {key: part for key, part in content.items() if key not in UNUSED_QUALITY}
    odd = content.keys() - {part.name for part in fields(PairQuality)}
    if odd:
        raise ValueError(f"quality has no {', '.join(sorted(odd))}")
    return TypeAdapter(PairQuality).validate_json(json.dumps(content), strict=True)


def _transform(matrix: Any) -> RigidTransform:
    """Read a transform to the last bit. Raises ValueError; does not check that it is a rotation."""
    array = np.array(matrix)
    if array.shape != (4, 4) or array.dtype.kind not in "fiu" or any(array[3] != (0, 0, 0, 1)):
        raise ValueError(f"{matrix} is not a 4 x 4 matrix of a rigid motion")
    array = array.astype(np.float64)
    return RigidTransform(array[:3, :3].copy(), array[:3, 3].copy())


def _read_texts(values: Any) -> tuple[str, ...]:
    return tuple(TypeAdapter(list[str]).validate_python(values, strict=True))
