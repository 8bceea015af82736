"""One scan: the body model, how it was made, and its files on disk.

These are `cloud.ply`, `mesh.ply`, and `scan.json`, written last.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from datetime import datetime
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from bodyscan.alignment.icp import Alignment
from bodyscan.errors import FailedWork, ResultError, ScanFailed
from bodyscan.files.atomic import write_json
from bodyscan.files.hashing import hash_file
from bodyscan.files.model import describe_first_error
from bodyscan.files.reading import read_json_object
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.mesh.body import BodyCloud, BodyMesh
from bodyscan.mesh.ply import read_ply_cloud, read_ply_mesh, write_ply
from bodyscan.motion.person_motion import PersonMotion
from bodyscan.progress import map_threads
from bodyscan.reconstruction.range_image import RangeImage
from bodyscan.registration.rig_calibration import FLOOR_AXES
from bodyscan.verdict import Verdict
from bodyscan.version import __version__

SCHEMA = "bodyscan-scan"
VERSION = 1
FILE_NAME = "scan.json"
CLOUD_NAME, MESH_NAME = "cloud.ply", "mesh.ply"
REMEDY = "scan again, or give the folder that `bodyscan scan` wrote"

Made = Callable[[BodyCloud | BodyMesh], None]
"""Called with a scan's cloud, and then with its mesh, as soon as each exists; from any thread."""


def ignore_made(body: BodyCloud | BodyMesh) -> None:
    """A `Made` that does nothing."""


@dataclass(frozen=True, eq=False)
class Scan:
    """A body model, how it was made, and whether it is good.

    measured: number of points in each pair's cleaned range image.
    failed: pairs that gave none, with the reason.
    range_images: cleaned, of pairs that saw the subject, cropped to it, carried to one moment.
    rig_from_camera: each pair's pose relative to the subject, after alignment.
    person: how a moving body moved, part by part.
    notes: on the range images, such as stripes that were not used.
    """

    cloud: BodyCloud
    mesh: BodyMesh
    alignment: Alignment | None
    measured: dict[str, int]
    failed: dict[str, str]
    verdict: Verdict
    range_images: tuple[RangeImage, ...]
    rig_from_camera: dict[str, RigidTransform]
    person: PersonMotion | None = None
    notes: tuple[str, ...] = ()


DERIVED = (
    *(CLOUD_NAME, MESH_NAME, "raw.e57", "report.html", "measurements.json", "export", "shared"),
    *("cloud.png", "sigma.png", "pairs.png", "mesh.png", "*-deviation.png"),
)


@dataclass(frozen=True)
class Origin:
    """Whose scan it is (a pseudonym), when it was taken, and the calibration it was made with."""

    calibration_id: str
    subject: str | None
    when: datetime | None
    simulated: bool = False
    axes: str = FLOOR_AXES  # where the rig frame lies, in words

    @property
    def facts(self) -> dict[str, Any]:
        """The entries that scan.json begins with."""
        return {
            "schema": SCHEMA,
            "version": VERSION,
            "software": f"bodyscan {__version__}",
            "units": "mm",
            "axes": self.axes,
            "subject": self.subject,
            "when": self.when.isoformat() if self.when else None,
            "calibration_id": self.calibration_id,
        } | ({"simulated": True} if self.simulated else {})


@dataclass(frozen=True, eq=False)
class StoredScan:
    """A scan as read back; facts: the content of scan.json."""

    cloud: BodyCloud
    mesh: BodyMesh
    facts: dict[str, Any]

    def __repr__(self) -> str:  # the facts alone fill a terminal
        grade, points = self.verdict and self.verdict.grade, len(self.cloud.points)
        return f"<StoredScan of {self.facts.get('subject')!r}: {grade}, {points} points>"

    @property
    def verdict(self) -> Verdict | None:
        """The verdict; None for scans from before there were any."""
        return read_stored_verdict(self.facts)


def make_room(folder: Path, overwrite: bool) -> None:
    """Raise ResultError if `folder` holds a model that may not be replaced."""
    if (folder / FILE_NAME).exists() and (folder / CLOUD_NAME).exists() and not overwrite:
        raise ResultError(
            "a result already exists here",
            where=str(folder),
            remedy="give another --out; --overwrite deletes it and everything derived from it",
        )


def refuse_own_file(path: Path, folder: Path) -> None:
    """Raise ResultError if writing `path` would replace a file of the result in `folder`."""
    if path.resolve() in {(folder / n).resolve() for n in (FILE_NAME, CLOUD_NAME, MESH_NAME)}:
        raise ResultError("is of the result itself", where=str(path), remedy="write elsewhere")


def clear(folder: Path) -> None:
    """Remove a result and what was made of it, so that no two persons' files stay side by side.

    A folder that holds no result is left unchanged.
    """
    if not (folder / FILE_NAME).exists():
        return
    for pattern in (FILE_NAME, *DERIVED):
        for path in folder.glob(pattern):
            if path.is_dir() and not path.is_symlink():
                shutil.rmtree(path)
            else:
                path.unlink()


@contextmanager
def save_body(scan: Scan, folder: Path) -> Iterator[dict[str, str]]:
    """Write the cloud and the mesh into `folder`; yield their SHA-256 by name, for `save_facts`.

    Both are removed if one cannot be written or the block raises: without scan.json they are nobody's.
    """
    (folder / FILE_NAME).unlink(missing_ok=True)

    def write(name: str) -> str:
        write_ply(folder / name, scan.cloud if name == CLOUD_NAME else scan.mesh)
        return hash_file(folder / name)

    names = (CLOUD_NAME, MESH_NAME)
    try:
        yield dict(zip(names, map_threads(write, names), strict=True))
    except BaseException:
        for name in names:
            (folder / name).unlink(missing_ok=True)
        raise


def save_facts(scan: Scan, folder: Path, origin: Origin, digests: Mapping[str, str]) -> Path:
    """Write scan.json, which makes the files in `folder` a result; return its path.

    digests: as `save_body` yields them.
    """
    write_json(
        folder / FILE_NAME,
        origin.facts
        | {
            "sha256": digests,
            "counts": {
                "points": len(scan.cloud.points),
                "vertices": len(scan.mesh.vertices),
                "faces": len(scan.mesh.faces),
                "filled_faces": int(np.count_nonzero(scan.mesh.filled)),
                "filled_share": scan.mesh.filled_share,
            },
            "stature_mm": _number(float(scan.mesh.vertices[:, 2].max())),
            "median_sigma_mm": _number(float(np.nanmedian(scan.cloud.sigma_mm))),
            "regions": scan.cloud.region_shares,
            "verdict": asdict(scan.verdict),
            "measured": scan.measured,
            "failed": scan.failed,
            "alignment": _describe_alignment(scan),
            "person": asdict(scan.person) if scan.person else None,
        },
    )
    return folder / FILE_NAME


def save_failure(error: ScanFailed, folder: Path, origin: Origin) -> Path:
    """Write a scan.json that says why there is no model; files of an earlier try are removed."""
    for name in (FILE_NAME, CLOUD_NAME, MESH_NAME):
        (folder / name).unlink(missing_ok=True)
    # A line that ends in a colon says less than the one that follows.
    reasons = tuple(line.strip() for line in str(error).replace(":\n ", ":").splitlines())
    write_json(folder / FILE_NAME, origin.facts | {"verdict": asdict(Verdict("repeat", reasons))})
    return folder / FILE_NAME


Row = Annotated[list[float], Field(min_length=4, max_length=4)]
Matrix = Annotated[list[Row], Field(min_length=4, max_length=4)]


class _Part(BaseModel):
    model_config = ConfigDict(extra="allow", allow_inf_nan=False, strict=True)


class _Verdict(_Part):
    grade: Literal["good", "usable", "repeat"]
    reasons: list[str]
    consequences: list[str] = []


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
    person: PersonMotion | None = None


def read_facts(folder: Path) -> dict[str, Any]:
    """Read the scan.json in `folder`, whether or not its scan gave a model (then it has `sha256`).

    Raises ResultError for a file that is missing or not a scan.json.
    """
    file = folder / FILE_NAME
    try:
        facts = read_json_object(file)
        _Facts.model_validate_json(json.dumps(facts))
    except (FileNotFoundError, NotADirectoryError):
        near = (folder / "scan", folder.parent)  # of a batch's job; of a file or folder in a result
        holds = (f"give {one}, which holds one" for one in near if (one / FILE_NAME).is_file())
        remedy = next(holds, REMEDY)
        raise ResultError("there is no such file", where=str(file), remedy=remedy) from None
    except (OSError, ValueError) as error:
        reason = describe_first_error(error) if isinstance(error, ValidationError) else str(error)
        raise ResultError(
            f"is not a readable scan result ({reason})", where=str(file), remedy=REMEDY
        ) from error
    return facts


def read_stored_verdict(facts: dict[str, Any]) -> Verdict | None:
    """The stored verdict; None for scans from before there were verdicts."""
    verdict = facts.get("verdict")
    if not verdict:
        return None
    consequences = tuple(verdict.get("consequences", ()))
    return Verdict(verdict["grade"], tuple(verdict["reasons"]), consequences)


def load_scan(folder: Path) -> StoredScan:
    """Read what `save_scan` wrote.

    Raises ResultError if it is missing, incomplete or damaged, or if the scan gave no model.
    """
    facts = read_facts(folder)
    if "sha256" not in facts:
        reasons = (
            "; ".join(facts["verdict"]["reasons"]) if facts.get("verdict") else "it was cut short"
        )
        raise ResultError(f"this scan gave no model: {reasons}", where=str(folder / FILE_NAME))
    for name, digest in facts["sha256"].items():
        file = folder / name
        if not file.is_file():
            raise ResultError("there is no such file", where=str(file), remedy=REMEDY)
        if hash_file(file) != digest:
            raise ResultError("was changed or cut short", where=str(file), remedy=REMEDY)
    cloud, mesh = read_ply_cloud(folder / CLOUD_NAME), read_ply_mesh(folder / MESH_NAME)
    return StoredScan(cloud, mesh, facts)


def refuse_repeat(folder: Path, facts: Mapping[str, Any]) -> None:
    """Raise FailedWork for a scan to be repeated: anything made from it would be taken as right."""
    verdict = facts.get("verdict") or {}
    if verdict.get("grade") == "repeat":
        reasons = "".join(f"\n  {reason}" for reason in verdict["reasons"])
        raise FailedWork(
            f"this scan is to be repeated:{reasons}",
            where=str(folder),
            remedy="scan again, or use --anyway at your own risk",
        )


def _describe_alignment(scan: Scan) -> dict[str, Any] | None:
    if scan.alignment is None:
        return None
    alignment = scan.alignment
    return {
        "rms_before_mm": _number(alignment.rms_before_mm),
        "rms_after_mm": _number(alignment.rms_after_mm),
        "motion_mm": alignment.motion_mm,
        "refused": alignment.refused,
        "rig_from_camera": {name: t.matrix for name, t in alignment.rig_from_camera.items()},
        "overlaps": [
            {key: _number(value) for key, value in asdict(overlap).items()}
            for overlap in alignment.overlaps
        ],
    }


def _number(value: Any) -> Any:
    return None if isinstance(value, float) and not np.isfinite(value) else value
