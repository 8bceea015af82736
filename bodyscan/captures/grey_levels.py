"""Grey levels, 0 to 255: what the numbers in image files mean, and several exposures merged."""

from __future__ import annotations

from collections.abc import Sequence
from functools import reduce

import numpy as np
from numpy.typing import NDArray

from bodyscan.arrays import Array, Floats, Greys
from bodyscan.errors import ImageError
from bodyscan.geometry.robust import SIGMAS_PER_MEDIAN

Raw = NDArray[np.uint8] | NDArray[np.uint16]


def find_full_scale(images: Sequence[Raw], bits: int | None) -> float:
    """Find the number that stands for white in one sequence's images; 255 for 8-bit files.

    A file with 16 bits per sample holds what the camera measured: 16 bits, or 10, 12 or 14 at the
    low or the high end of the number. Nothing in the file says which; the numbers of a whole
    sequence do.

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
    largest = max(int(value.max()) for value in values)
    used = reduce(int.__or__, (int(np.bitwise_or.reduce(value)) for value in values))
    if bits is None:
        _refuse_eight_bits(values, largest, used)
        counts = (10, 12, 14, 16)
        low = next(count for count in counts if largest < 1 << count)
        high = next(count for count in counts if used & ((1 << (16 - count)) - 1) == 0)
        bits = low if low < 16 else high
    spare = 16 - bits
    if largest < 1 << bits:
        return float((1 << bits) - 1)
    low_end_is_empty = used & ((1 << spare) - 1) == 0
    return float(65536 - (1 << spare)) if low_end_is_empty else 65535.0


def convert_to_greys(image: Raw, scale: float) -> Greys:
    """Scale to grey levels 0 to 255, float32, so that `scale` is white; keep 8-bit images."""
    if image.dtype == np.uint8:
        return image.astype(np.uint8, copy=False)
    return np.minimum(image * np.float32(255.0 / scale), np.float32(255.0))


def _sample(image: Raw) -> NDArray[np.uint16]:
    """Sample about a million numbers: 8 bits in 16 show within the first thousand."""
    values = image.ravel()
    return values[:: max(1, values.size >> 20)].astype(np.uint16, copy=False)


def _refuse_eight_bits(values: Sequence[NDArray[np.uint16]], largest: int, used: int) -> None:
    found = ""
    if largest < 256:
        found = f"none of their numbers is above {largest}"
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


def merge_exposures(stacks: Sequence[Greys], names: Sequence[str], where: str) -> Floats:
    """Merge exposures into images (F, H, W) float32, in grey levels of the shortest.

    A pixel that is not too bright in a longer exposure is less noisy there. Each image of a longer
    exposure is brought to the unit of the shortest, short = a + b long, where a and b are found
    from the images, and averaged with it. Near white an exposure's weight falls gradually, so that
    there is no seam. Source: Debevec and Malik, Recovering high dynamic range radiance maps (1997),
    for a linear camera.

    stacks: (F, H, W) grey levels of each exposure, the shortest first, images in equal order.
    names: of the exposures.

    Raises ImageError for exposures that are out of order or cannot be compared.
    """
    lines = [(0.0, 1.0)]
    for k in range(1, len(stacks)):
        offset, slope = _fit_exposures(stacks[k - 1], stacks[k], names[k - 1 : k + 1], where)
        start, unit = lines[-1]
        lines.append((start + unit * offset, unit * slope))
    merged = np.empty(stacks[0].shape, np.float32)
    for image in range(len(merged)):
        merged[image] = _merge_image([stack[image] for stack in stacks], lines)
    return merged


def _merge_image(images: Sequence[Greys], lines: Sequence[tuple[float, float]]) -> Floats:
    """Merge one image (H, W); lines: offset and slope that bring each exposure to the shortest."""
    total = images[0].astype(np.float32)
    weights = np.ones_like(total)
    for image, (offset, slope) in zip(images[1:], lines[1:], strict=True):
        level = image.astype(np.float32)
        # The sensor's noise shrinks with the unit: the weight is its inverse variance. Sensors
        # become non-linear below white: from 215 to 245 it falls to zero.
        weight = np.clip((245.0 - level) / 30.0, 0.0, 1.0) / np.float32(slope * slope)
        total += weight * (np.float32(offset) + np.float32(slope) * level)
        weights += weight
    return np.clip(total / weights, 0.0, 255.0)


def _fit_exposures(
    shorter: Greys, longer: Greys, names: Sequence[str], where: str
) -> tuple[float, float]:
    """Fit offset and slope in shorter = offset + slope * longer to pixels neither black nor white."""
    step = max(1, shorter.size // 1_600_000)
    one, other = (stack.reshape(-1)[::step].astype(float) for stack in (shorter, longer))
    brighter = np.maximum(one, other)
    usable = (brighter > 12.0) & (brighter < 215.0)
    if np.count_nonzero(usable) < 1000:
        raise ImageError(
            f"exposures {names[0]} and {names[1]} cannot be compared: hardly a pixel is neither black "
            "nor white in both",
            where=where,
            remedy="Choose exposures that are closer to each other: 2 to 8 times.",
        )
    offset, slope = _fit_line(other[usable], one[usable])
    if slope > 1.0 / 0.95:  # darker than the shorter one by more than rounding
        raise ImageError(
            f"exposure {names[1]} is {1.0 / slope:.2g} times as bright as {names[0]}, which is listed"
            " as the shorter one",
            where=where,
            remedy=f"Name the shortest first: `exposures: [{names[1]}, {names[0]}]`.",
        )
    return offset, slope


def _fit_line(x: Array, y: Array) -> tuple[float, float]:
    """Fit offset and slope of y against x, without residuals beyond 4 sigma."""
    inliers = np.ones(len(x), bool)
    slope, offset = 1.0, 0.0
    for _ in range(4):
        slope, offset = np.polyfit(x[inliers], y[inliers], 1)
        residual = np.abs(y - offset - slope * x)
        inliers = residual <= 4.0 * SIGMAS_PER_MEDIAN * max(float(np.median(residual)), 0.1)
    return float(offset), float(slope)
