"""Read scan.json, checking that everything in it is of the type that reports and exports expect."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from bodyscan.errors import ResultError
from bodyscan.files.model import describe_first_error
from bodyscan.files.reading import read_json_object
from bodyscan.verdict import Verdict

SCHEMA = "bodyscan-scan"
VERSION = 1
FILE_NAME = "scan.json"
CLOUD_NAME, MESH_NAME = "cloud.ply", "mesh.ply"
REMEDY = "scan again, or give the folder that `bodyscan scan` wrote"

Row = Annotated[list[float], Field(min_length=4, max_length=4)]
Matrix = Annotated[list[Row], Field(min_length=4, max_length=4)]


class _Part(BaseModel):
    model_config = ConfigDict(extra="allow", allow_inf_nan=False, strict=True)


class _Verdict(_Part):
    grade: Literal["good", "usable", "repeat"]
    reasons: list[str]


class _Overlap(_Part):
    source: str
    target: str
    points: int
    rms_before_mm: float | None
    rms_after_mm: float | None
    expected_mm: float | None = None


class _Alignment(_Part):
    rms_before_mm: float | None
    rms_after_mm: float | None
    motion_mm: dict[str, float]
    refused: dict[str, float] = {}
    rig_from_camera: dict[str, Matrix] = {}
    overlaps: list[_Overlap] = []


class _PartMotion(_Part):
    name: str
    moved_mm: float
    left_mm: float
    seen_once: float


class _Person(_Part):
    parts: list[_PartMotion]
    breathed_mm: float | None
    moment_ms: float | None


class _Hashes(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True)
    cloud: str = Field(alias="cloud.ply")
    mesh: str = Field(alias="mesh.ply")


class _Facts(_Part):
    schema_: Literal["bodyscan-scan"] = Field(alias="schema")
    version: Literal[1]
    software: str
    calibration_id: str = Field(min_length=1)
    subject: str | None = None
    when: str | None = None
    simulated: bool = False
    verdict: _Verdict | None = None
    sha256: _Hashes | None = None
    counts: dict[str, float] = {}
    regions: dict[str, float] | None = None
    measured: dict[str, int] = {}
    failed: dict[str, str] = {}
    alignment: _Alignment | None = None
    person: _Person | None = None


def read_facts(folder: Path) -> dict[str, Any]:
    """Read the scan.json in `folder`, whether or not its scan gave a model (then it has `sha256`).

    Raises ResultError for a file that is missing or not a scan.json.
    """
    file = folder / FILE_NAME
    try:
        facts = read_json_object(file)
        _Facts.model_validate(facts)
    except FileNotFoundError:
        raise ResultError("there is no such file", where=str(file), remedy=REMEDY) from None
    except (OSError, ValueError) as error:
        raise ResultError(
            f"is not a readable scan result ({_reason(error)})", where=str(file), remedy=REMEDY
        ) from error
    return facts


def stored_verdict(facts: dict[str, Any]) -> Verdict | None:
    """The stored verdict; None for scans from before there were verdicts."""
    verdict = facts.get("verdict")
    return Verdict(verdict["grade"], tuple(verdict["reasons"])) if verdict else None


def _reason(error: Exception) -> str:
    if isinstance(error, ValidationError):
        return describe_first_error(error)
    return str(error)
