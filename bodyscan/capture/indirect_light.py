"""Light that reached a pixel by way of another surface: in armpits, between legs, in shadows.

A pixel's lit minus dark is D + I: what comes to it straight, and what other surfaces throw there. A
pattern minus its inverse is +-D + J; J is what the pattern and its inverse do not share of the
indirect light: little where stripes are fine, anything up to I where they are broad (Nayar et al.
2006). So a bit is certain where D > I (Xu and Aliaga 2007), which the finest patterns tell; and a
boundary lies where the difference is J, not 0: in the middle between the values on its two sides.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from bodyscan.capture.stripe_images import ScanLines

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Mask = NDArray[np.bool_]

LEAST_DIRECT = 0.5
WIDEST_DIP_PX = 7
FINE_BITS = 3
BEST, SHARP = 90, 0.8
"""A pattern is sharp if this percentile of the pixels' shares is at least so much."""

BESIDE_PX = (3, 4, 5, 6)
"""From the two pixels around a boundary to those that lie clear of it."""
FEWEST_STRIPES = 2
"""Reach at least that is of use."""
SIGNIFICANCE = 4.0
UNEXPLAINED = 0.3


def mostly_direct(images: ScanLines, usable: Mask, bit: int, variance: NDArray[np.float32]) -> Mask:
    """(L, P): pixels that get more light from the projector than from other surfaces.

    bit: of the patterns, the one of stripes two wide. It tells, or the next coarser one that the
    projector throws sharply (in procam-board its lens leaves a fifth of the finest). Where a bit
    flips its difference is small whatever the light; such dips along the lines are filled.
    usable: (L, P) that are looked at.  variance: (256,) of each grey level.
    """
    contrast = np.maximum(images.contrast, 1.0)
    dips = np.ones((1, WIDEST_DIP_PX), np.uint8)
    for fine in range(bit, max(bit - FINE_BITS, -1), -1):
        difference, noise = images.difference_image(fine, variance)
        share = (np.abs(difference) + noise) / contrast
        filled = cv2.morphologyEx(np.asarray(share, np.float32), cv2.MORPH_CLOSE, dips)
        if usable.any() and np.percentile(filled[usable], BEST) >= SHARP:
            return np.asarray(filled >= LEAST_DIRECT)
    return np.ones_like(usable)


def imbalance(
    images: ScanLines,
    codes: NDArray[np.int32],
    usable: Mask,
    variance: NDArray[np.float32],
    bit: Ints,
    index: Ints,
    at: Ints,
    reach: Ints,
) -> tuple[Floats, Floats]:
    """J / (D + I) at boundaries `index` (N,) of `bit` (N,), and how far it may be off.

    at: (N,) flat pixels before the boundaries.  reach: (N,) stripes beside them for which the bit
    surely keeps its value. It is 0 where noise may explain it, and for the finest bit, which has
    no room beside its boundaries and whose J is least.
    """
    width = images.lit.shape[1]
    place = at % width
    reach = np.where(reach >= FEWEST_STRIPES, reach, 0)
    contrast = images.contrast.ravel()
    total, size, noise2, count = np.zeros((4, len(at)))
    for step in BESIDE_PX:
        inside = (place >= step) & (place + 1 + step < width)
        pixels = [np.where(inside, at - step, at), np.where(inside, at + 1 + step, at)]
        off = [codes.ravel()[pixel] + 0.5 - index for pixel in pixels]
        clear = inside & (off[0] * off[1] < 0.0) & (np.abs(off).max(axis=0) < reach)
        clear &= usable.ravel()[pixels[0]] & usable.ravel()[pixels[1]]
        for pixel in pixels:
            difference, noise = images.difference(bit, pixel, variance)
            bright = np.maximum(contrast[pixel], 1.0)
            total += np.where(clear, difference / bright, 0.0)
            size += np.where(clear, np.abs(difference) / bright, 0.0)
            noise2 += np.where(clear, (noise / bright) ** 2, 0.0)
            count += clear
    count = np.maximum(count, 1.0)
    mean, variance2, indirect = (
        total / count,
        noise2 / count**2,
        np.maximum(1.0 - size / count, 0.0),
    )
    mean = np.clip(mean, -indirect, indirect)  # |J| <= I
    kept = mean * mean**2 / (mean**2 + SIGNIFICANCE**2 * variance2 + 1e-12)
    return kept, np.hypot(np.minimum(np.sqrt(variance2), np.abs(kept)), UNEXPLAINED * np.abs(kept))
