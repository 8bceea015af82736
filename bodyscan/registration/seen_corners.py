"""What each camera saw of the boards in the joint solve, and how far that is from where it should
be: for a look at where in the picture the boards were, and where the lens does not fit."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bodyscan.registration.rig_solve import PlacedRig, corner_residuals


@dataclass(frozen=True, eq=False)
class SeenCorners:
    """Board corners that one camera saw and that the joint solve used.

    pixels: (N, 2) float32, where they were seen.  residuals_px: (N, 2) float32, projected less seen.
    target: (N,) int16, number of its (shot, board) among those of `rig_from_board`, sorted.
    """

    pixels: NDArray[np.float32]
    residuals_px: NDArray[np.float32]
    target: NDArray[np.int16]


def seen_corners(placed: PlacedRig, names: Iterable[str]) -> dict[str, SeenCorners]:
    """By the pair's name, for those of `names` that were placed."""
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
