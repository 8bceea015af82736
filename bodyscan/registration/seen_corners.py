"""The corners a rig's solve used, for the report: loading a calibration then needs no solver."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from bodyscan.registration.rig_calibration import SeenCorners
from bodyscan.registration.rig_solve import RigSolution, corner_residuals


def seen_corners(placed: RigSolution, names: Iterable[str]) -> dict[str, SeenCorners]:
    """The corners by pair, for those of `names` that were placed."""
    number = {target: k for k, target in enumerate(sorted(placed.rig_from_board))}
    found = {}
    for name in sorted(set(names) & set(placed.rig_from_camera)):
        own = [view for view in placed.views if view.pair == name]
        if not own:
            continue
        residuals = [
            corner_residuals(view, placed.cameras, placed.rig_from_camera, placed.rig_from_board)
            for view in own
        ]
        found[name] = SeenCorners(
            np.concatenate([view.pixels for view in own]).astype(np.float32),
            np.concatenate(residuals).astype(np.float32),
            np.repeat([number[v.target] for v in own], [len(v.pixels) for v in own]).astype(
                np.int16
            ),
        )
    return found
