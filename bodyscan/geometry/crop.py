"""The part of a picture that shows something."""

from __future__ import annotations

import numpy as np

from bodyscan.arrays import Mask

Crop = tuple[slice, slice]
"""Rows and columns."""
WHOLE: Crop = (slice(None), slice(None))


def crop_of(shown: Mask) -> Crop | None:
    """Slices (rows, columns) of the smallest box around what is true; None if nothing is."""
    rows, columns = np.flatnonzero(shown.any(axis=1)), np.flatnonzero(shown.any(axis=0))
    if not rows.size:
        return None
    return slice(int(rows[0]), int(rows[-1]) + 1), slice(int(columns[0]), int(columns[-1]) + 1)


def ends_of(crop: Crop) -> tuple[int, int, int, int]:
    """Top, bottom, left and right of a crop, for compiled functions."""
    rows, columns = crop
    return rows.start, rows.stop, columns.start, columns.stop


def widened(crop: Crop, margin: int) -> Crop:
    """With so many more rows and columns on every side, as far as there are any before the first."""
    rows, columns = (slice(max(side.start - margin, 0), side.stop + margin) for side in crop)
    return rows, columns
