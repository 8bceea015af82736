"""A pair that every scan wants to move the same way, which no person's sway explains."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import fdtri

from bodyscan.arrays import Array

FEWEST_SCANS = 3
"""A person sways by as much as a pair may have moved: this many scans can tell the two apart."""
BY_CHANCE, LEAST_MM = 1e-4, 0.3
LEAST_SIGMA_MM = 0.05


@dataclass(frozen=True)
class PairDrift:
    """Mean motion of a pair over several scans.

    shift: mean motion (3,) mm at the body's centre that its overlaps asked for, rig axes.
    sigma_mm: its standard deviation, from the variation between scans; None for fewer than three.
    limit_mm: a shift beyond it is not chance.
    """

    pair: str
    shift: tuple[float, float, float]
    sigma_mm: float | None
    limit_mm: float

    @property
    def shift_mm(self) -> float:
        return float(np.linalg.norm(self.shift))

    @property
    def moved(self) -> bool:
        """Whether every scan shows the same motion, which no sway explains."""
        return self.shift_mm > self.limit_mm


def mean_drift(name: str, shifts: Array) -> PairDrift:
    """The drift of a pair or pole; shifts: (scans, 3) mm, at the body's centre."""
    scans = len(shifts)
    x, y, z = (float(value) for value in shifts.mean(axis=0))
    if scans < FEWEST_SCANS:
        return PairDrift(name, (x, y, z), None, np.inf)
    varies = float(np.sqrt(shifts.var(axis=0, ddof=1).sum() / scans))
    sigma = max(varies, LEAST_SIGMA_MM)
    # Hotelling's test with one variance for all axes: the ratio of squares has an F distribution.
    times = float(np.sqrt(fdtri(3, 3 * (scans - 1), 1.0 - BY_CHANCE)))
    return PairDrift(name, (x, y, z), sigma, max(times * sigma, LEAST_MM))
