"""What the scans of a day tell of the rig: how far alignment moved each pair, over time."""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Iterable
from contextlib import suppress
from datetime import UTC, datetime
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from bodyscan.alignment.displaced_poles import MIN_SCANS, estimate_drift
from bodyscan.arrays import Array
from bodyscan.errors import BodyscanError
from bodyscan.jobs.job import CALIBRATION, read_job
from bodyscan.jobs.summary import pair_motions
from bodyscan.registration.storage import calibration_id

WINDOW = 5
"""Scans of which a point is the mean: fewer tell sway from drift badly, more hide a warm-up."""


def describe_rig(calibration: Path, name: str) -> dict[str, Any]:
    """Which calibration is in use, and how old it is; the rig's name alone if there is none yet."""
    file = calibration / CALIBRATION
    if not file.exists():
        return {"name": name, "id": None}
    content = json.loads(file.read_text("utf-8"))
    written = datetime.fromtimestamp(file.stat().st_mtime, UTC).isoformat(timespec="seconds")
    used = calibration_id(calibration)[:12]
    return {"name": name, "id": used, "written": written, "pairs": list(content["pairs"])}


def find_series(folders: Iterable[Path]) -> dict[str, list[dict[str, Any]]]:
    """Of each pair, a point for every scan from the third: the drift of the last WINDOW scans, its
    sigma, and the length beyond which it is no chance (mm).

    folders: of jobs, in the order in which they were scanned.
    """
    shifts: dict[str, list[Array]] = defaultdict(list)
    series: dict[str, list[dict[str, Any]]] = defaultdict(list)
    for folder in folders:
        motions: dict[str, Array] = {}
        with suppress(OSError, BodyscanError, KeyError, ValueError):  # no result, or a damaged one
            motions = _read_motions(folder, (folder / "scan" / "scan.json").stat().st_mtime_ns)
        for pair, shift in sorted(motions.items()):
            shifts[pair].append(shift)
            if len(shifts[pair]) < MIN_SCANS:
                continue
            found = estimate_drift(pair, np.array(shifts[pair][-WINDOW:]))
            point = {"job": folder.name, "mm": found.shift_mm, "sigma_mm": found.sigma_mm}
            series[pair].append(point | {"limit_mm": found.limit_mm, "moved": found.moved})
    return dict(series)


@lru_cache(maxsize=2000)
def _read_motions(folder: Path, written_ns: int) -> dict[str, Array]:
    """`pair_motions` of the job whose scan was written then: read once, not at each look at the day."""
    return pair_motions(read_job(folder))
