"""The array types used in signatures; docstrings give each array's shape, unit and frame."""

from typing import cast

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
"""Coordinates, lengths, angles: the type that geometry is computed in."""

Floats = NDArray[np.float32]
"""Values stored per pixel or point, at half the size."""

Mask = NDArray[np.bool_]
Indices = NDArray[np.int64]
Bytes = NDArray[np.uint8]
"""Grey levels and colours."""

Greys = NDArray[np.uint8] | NDArray[np.float32]
"""Grey levels, 0 to 255: float32 where a camera or merged exposures resolve finer steps."""


def round_to_grey(image: Greys) -> Bytes:
    """The image, rounded to whole grey levels."""
    return cast(Bytes, image) if image.dtype == np.uint8 else np.rint(image).astype(np.uint8)


Crop = tuple[slice, slice]
"""Slices of rows and columns."""
WHOLE: Crop = (slice(None), slice(None))


def find_crop(shown: Mask) -> Crop | None:
    """The smallest box (rows, columns) around the true pixels; None if there are none."""
    rows, columns = np.flatnonzero(shown.any(axis=1)), np.flatnonzero(shown.any(axis=0))
    if not rows.size:
        return None
    return slice(int(rows[0]), int(rows[-1]) + 1), slice(int(columns[0]), int(columns[-1]) + 1)


def pad_crop(crop: Crop, margin: int) -> Crop:
    """The crop with `margin` more rows and columns on each side, stopping at row and column 0."""
    rows, columns = (slice(max(side.start - margin, 0), side.stop + margin) for side in crop)
    return rows, columns
