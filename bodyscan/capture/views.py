"""What the images of one pair in one shot say: where a board's corners are, which stripe is where."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class BoardView:
    """A board as one camera saw it in one shot.

    corner_ids: (N,) int, index into `boards.corner_points(board)` (front face first, then back).
    pixels: (N, 2) float64, real image coordinates, px.
    turnable: the detector may have numbered this board from its other end.
    """

    pair: str
    shot: str
    board: str
    corner_ids: NDArray[np.int64]
    pixels: Array
    turnable: bool = False


@dataclass(frozen=True, eq=False)
class StripeMap:
    """The stripe coordinate of every lit pixel, and the stripe boundaries between them.

    s: (height, width) float32, in [0, S]; NaN where there is none.
    sigma: (height, width) float32, standard deviation of s, in stripes; NaN likewise.
    lit: (height, width) uint8, the fully lit image (grey).
    boundary_index: (N,) int64: boundary i lies between stripes i - 1 and i, that is s = i.
    boundary_pixels: (N, 2) float64, where it was seen, px, sub-pixel.
    boundary_sigma_px: (N,) float32, standard deviation across the stripe, px.
    stripes: S, the number of stripes projected.
    beyond: (height, width) bool, lit by a stripe that lies deeper than wanted; None where all stripes
    were wanted. s is NaN there (see `WantedStripes`).
    """

    s: NDArray[np.float32]
    sigma: NDArray[np.float32]
    lit: NDArray[np.uint8]
    boundary_index: NDArray[np.int64]
    boundary_pixels: Array
    boundary_sigma_px: NDArray[np.float32]
    stripes: int
    beyond: NDArray[np.bool_] | None = None
