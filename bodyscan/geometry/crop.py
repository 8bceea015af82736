"""The part of an image that shows something."""

from __future__ import annotations

import numpy as np

from bodyscan.arrays import Mask

Crop = tuple[slice, slice]
"""Slices of rows and columns."""
WHOLE: Crop = (slice(None), slice(None))


def find_crop(shown: Mask) -> Crop | None:
    """The smallest box (rows, columns) around the true pixels; None if there are none."""
    rows, columns = np.flatnonzero(shown.any(axis=1)), np.flatnonzero(shown.any(axis=0))
    if not rows.size:
        return None
    return slice(int(rows[0]), int(rows[-1]) + 1), slice(int(columns[0]), int(columns[-1]) + 1)


def crop_bounds(crop: Crop) -> tuple[int, int, int, int]:
    """Top, bottom, left and right of a crop, for compiled functions."""
    rows, columns = crop
    return rows.start, rows.stop, columns.start, columns.stop


def pad_crop(crop: Crop, margin: int) -> Crop:
    """The crop with `margin` more rows and columns on each side, stopping at row and column 0."""
    rows, columns = (slice(max(side.start - margin, 0), side.stop + margin) for side in crop)
    return rows, columns
