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


def whole_grey(image: Greys) -> Bytes:
    """The image, rounded to whole grey levels."""
    return cast(Bytes, image) if image.dtype == np.uint8 else np.rint(image).astype(np.uint8)
