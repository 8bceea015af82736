"""What the scans of a day tell of the rig: how far alignment moved each pair, over time."""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Iterable
from datetime import UTC, datetime
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


def describe_rig(calibration: Path) -> dict[str, Any]:
    """Which calibration is in use, and how old it is."""
    file = calibration / CALIBRATION if calibration.is_dir() else calibration
    content = json.loads(file.read_text("utf-8"))
    written = datetime.fromtimestamp(file.stat().st_mtime, UTC)
    return {
        "name": content["rig"]["name"],
        "id": calibration_id(calibration)[:12],
        "written": written.isoformat(timespec="seconds"),
        "pairs": list(content["pairs"]),
        "failed": content["failed"],
    }


def find_series(folders: Iterable[Path]) -> dict[str, list[dict[str, Any]]]:
    """Of each pair, a point for every scan from the third: the drift of the last WINDOW scans, its
    sigma, and the length beyond which it is no chance (mm).

    folders: of jobs, in the order in which they were scanned.
    """
    shifts: dict[str, list[Array]] = defaultdict(list)
    series: dict[str, list[dict[str, Any]]] = defaultdict(list)
    for folder in folders:
        try:
            motions = pair_motions(read_job(folder))
        except (BodyscanError, KeyError, ValueError):
            continue  # without a result, or with a damaged one
        for pair, shift in sorted(motions.items()):
            shifts[pair].append(shift)
            if len(shifts[pair]) < MIN_SCANS:
                continue
            found = estimate_drift(pair, np.array(shifts[pair][-WINDOW:]))
            point = {"job": folder.name, "mm": found.shift_mm, "sigma_mm": found.sigma_mm}
            series[pair].append(point | {"limit_mm": found.limit_mm, "moved": found.moved})
    return dict(series)
