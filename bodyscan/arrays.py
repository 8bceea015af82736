"""The array types that signatures name; a docstring gives an array's shape, unit and frame."""

from typing import cast

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
"""Coordinates, lengths, angles: whatever geometry is computed in."""

Floats = NDArray[np.float32]
"""What is stored for every pixel or point, at half the size."""

Mask = NDArray[np.bool_]
Indices = NDArray[np.int64]
Bytes = NDArray[np.uint8]
"""Grey levels and colours."""

Greys = NDArray[np.uint8] | NDArray[np.float32]
"""Grey levels, 0 to 255: float32 where a camera or several exposures tell parts of them."""


def whole_grey(image: Greys) -> Bytes:
    """The image in whole grey levels."""
    return cast(Bytes, image) if image.dtype == np.uint8 else np.rint(image).astype(np.uint8)
