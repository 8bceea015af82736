"""How much of each camera's image the boards covered: beyond it, the lens is extrapolated."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from bodyscan.arrays import Array
from bodyscan.boards.view import BoardView
from bodyscan.rig.rig import Rig

CELLS = 64
"""Cells into which the image is divided, across and down."""
TOO_LITTLE = 0.2


def covered_share(pixels: Sequence[Array], width: int, height: int) -> float:
    """Share of an image inside the hulls of all views' corners; pixels: (N, 2) each."""
    mask = np.zeros((CELLS, CELLS), np.uint8)
    scale = np.array([CELLS / width, CELLS / height])
    for corners in pixels:
        hull = cv2.convexHull(((corners + 0.5) * scale - 0.5).astype(np.float32))
        cv2.fillConvexPoly(mask, np.rint(hull).astype(np.int32), 1)
    return float(mask.mean())


def coverage_notes(rig: Rig, views: Sequence[BoardView]) -> list[str]:
    """One line for each camera whose boards cover too little of the image to determine its lens."""
    notes = []
    for pair in rig.pairs:
        own = [view.pixels for view in views if view.pair == pair.name]
        share = covered_share(own, pair.camera.width, pair.camera.height)
        if own and share < TOO_LITTLE:
            notes.append(
                f"{pair.name}: in all {len(own)} views together the board covers only "
                f"{100 * share:.0f} % of the picture, so its lens and focal length are poorly "
                "known: bring the board closer, and into the corners"
            )
    return notes
