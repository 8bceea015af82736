"""What the numbers in an image file mean as grey levels, 0 to 255.

A file with 16 bits per sample holds what the camera measured: 16 bits, or 10, 12 or 14 at the low
or at the high end of the number. Nothing in the file says which; the numbers of a whole sequence
do.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import reduce

import numpy as np
from numpy.typing import NDArray

from bodyscan.arrays import Greys
from bodyscan.errors import ImageError

Raw = NDArray[np.uint8] | NDArray[np.uint16]
USUAL_BITS = (10, 12, 14, 16)
MOST_SAMPLED = 1 << 20
"""Numbers examined per image: a file with 8 bits shows it within the first thousand."""


def full_scale(images: Sequence[Raw], bits: int | None) -> float:
    """The number that stands for white in one sequence's images; 255 for 8-bit files.

    bits: how many the camera measures; None: judged by the numbers. Too few do no harm: a dim
        sequence is taken for one of fewer bits, which changes only its unit of brightness.

    Raises ImageError for 16-bit files that hold only 8 bits, unless `bits` says so, and for 8-bit
    files if `bits` says more.
    """
    if images[0].dtype == np.uint8:
        if bits is not None and bits > 8:
            raise ImageError(
                f"has 8 bits a sample, but the rig file says `bits: {bits}`",
                remedy=f"Let the camera's software save files of 16 bits, with {bits} in them, or "
                "leave `bits` out.",
            )
        return 255.0
    values = [_sample(image) for image in images]
    most = max(int(value.max()) for value in values)
    used = reduce(int.__or__, (int(np.bitwise_or.reduce(value)) for value in values))
    if bits is None:
        _refuse_eight(values, most, used)
        at_low_end = (count for count in USUAL_BITS if most < 1 << count)
        at_high_end = (count for count in USUAL_BITS if used & ((1 << (16 - count)) - 1) == 0)
        low, high = next(at_low_end), next(at_high_end)
        bits = low if low < 16 else high
    spare = 16 - bits
    if most < 1 << bits:
        return float((1 << bits) - 1)
    low_end_is_empty = used & ((1 << spare) - 1) == 0
    return float(65536 - (1 << spare)) if low_end_is_empty else 65535.0


def as_greys(image: Raw, scale: float) -> Greys:
    """Grey levels of an image whose white is `scale`: unchanged if that is 255 (whole numbers),
    else float32."""
    if image.dtype == np.uint8:
        return image.astype(np.uint8, copy=False)
    return np.minimum(image * np.float32(255.0 / scale), np.float32(255.0))


def _sample(image: Raw) -> NDArray[np.uint16]:
    values = image.ravel()
    return values[:: max(1, values.size // MOST_SAMPLED)].astype(np.uint16, copy=False)


def _refuse_eight(values: Sequence[NDArray[np.uint16]], most: int, used: int) -> None:
    found = ""
    if most < 256:
        found = f"none of their numbers is above {most}"
    elif used & 0xFF == 0:
        found = "all their numbers are multiples of 256"
    elif all(np.array_equal(value >> 8, value & 0xFF) for value in values):
        found = "all their numbers are multiples of 257"
    if found:
        raise ImageError(
            f"the files have 16 bits a sample, but 8 bits in them ({found})",
            remedy="Let the camera's software save all bits that the camera has (Mono12, Mono16); if "
            "8 are all it has, write `bits: 8` below `camera` in the rig file.",
        )
