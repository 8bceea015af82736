"""What a pixel's ray and its stripe coordinate say about depth, whatever the projector's model."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bodyscan.geometry.bowed_sheets import BowedSheets
from bodyscan.geometry.light_planes import LightSheets
from bodyscan.geometry.plane_table import PlaneTable

Array = NDArray[np.float64]

MOST_SIGMA = 1e-3
"""A sheet that leaves a depth uncertain by more than this share of it is as good as none: so far
from all boards a smooth model only guesses."""


@dataclass(frozen=True, eq=False)
class Measured:
    """depth: z (...) mm.  per_stripe: dz/ds (...), mm.  variance_mm2: of the depth, from the sheets
    alone.  All NaN where there is no depth that can be trusted."""

    depth: Array
    per_stripe: Array
    variance_mm2: Array


def measure(sheets: LightSheets, rays: Array, s: Array) -> Measured:
    """Rays (..., 3) with z = 1, camera frame, at real stripe coordinates s (...)."""
    if isinstance(sheets, BowedSheets) and sheets.kind == "smooth-planes":
        flat = PlaneTable.of(sheets).measure(rays.reshape(-1, 3), np.ravel(s))
        depth, per_stripe, variance = (values.reshape(np.shape(s)) for values in flat)
    else:
        depth = sheets.depth(rays, s)
        variance = sheets.variance_mm2(rays, s, depth)
        per_stripe = sheets.depth_per_stripe(rays, s, depth)
    unsure = variance > (MOST_SIGMA * depth) ** 2
    depth, per_stripe, variance = (
        np.where(unsure, np.nan, values) for values in (depth, per_stripe, variance)
    )
    return Measured(depth, per_stripe, variance)
