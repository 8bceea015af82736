"""The images of a stripe sequence laid out so that every row crosses the stripes."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from bodyscan.arrays import Bytes, Floats, Greys, Indices, Mask
from bodyscan.compiled import compiled

Words = NDArray[np.uint16]

WHOLE_SHARE = 128
"""A share of 1 in images of shares (`ScanLines.direct_share`)."""


@dataclass(frozen=True, eq=False)
class ScanLines:
    """Images of one type as scan lines: L lines, each of P pixels across the stripes."""

    # lit, dark: (L, P).
    lit: Greys
    dark: Greys
    patterns: Greys  # (F, L, P), the images of the code
    inverses: Greys | None  # (F, L, P), None if none are projected
    transposed: bool  # the lines are the camera image's columns (its stripes are horizontal)

    @staticmethod
    def from_images(
        lit: Greys, dark: Greys, patterns: Greys, inverses: Greys | None, direction: str
    ) -> ScanLines:
        """Lay out images (H, W) and stacks (F, H, W)."""
        if direction != "horizontal":
            return ScanLines(lit, dark, patterns, inverses, False)
        lit, dark = cv2.transpose(lit), cv2.transpose(dark)
        inverses = None if inverses is None else transpose(inverses)
        return ScanLines(lit, dark, transpose(patterns), inverses, True)

    @property
    def contrast(self) -> Floats:
        """Lit minus dark, (L, P), grey levels."""
        return cv2.subtract(self.lit, self.dark, dtype=cv2.CV_32F)

    def words(self) -> Words:
        """Read the code words (L, P), the first pattern being the most significant bit."""
        words = np.zeros(self.lit.shape, np.uint16)
        for bit in range(len(self.patterns)):
            words <<= 1
            words |= self.bright(bit)
        return words

    def bright(self, bit: int) -> Mask:
        """Where a pattern is brighter (L, P) than its inverse, or without inverses than the mean of
        lit and dark."""
        if self.inverses is not None:
            return np.asarray(self.patterns[bit] > self.inverses[bit])
        if self.lit.dtype != np.uint8:
            return np.asarray(2.0 * self.patterns[bit] > self.lit + self.dark)
        total = cv2.add(self.lit, self.dark, dtype=cv2.CV_16S)
        return np.asarray(2 * self.patterns[bit].astype(np.int16) > total)

    def difference(self, bit: Indices, pixels: Indices, variance: Floats) -> tuple[Floats, Floats]:
        """Compute pattern minus inverse of bits (N,) at flat pixels (N, K), and its standard
        deviation, grey levels. variance: (256,) of each grey level.

        Without inverses: twice the excess of the pattern over the mean of lit and dark.
        """
        patterns, inverses = self.patterns.reshape(-1), self._inverses.reshape(-1)
        return _compute_differences(
            self.lit.ravel(), self.dark.ravel(), patterns, inverses, bit, pixels, variance
        )

    def direct_share(self, bit: int, variance: Floats) -> Bytes:
        """Compute |difference| of one bit plus its noise, as a share (L, P) of lit minus dark in
        units of 1/WHOLE_SHARE, at most 255."""
        share = np.empty(self.lit.size, np.uint8)
        inverse = self._inverses[bit : bit + 1].reshape(-1)
        frames = (self.lit.ravel(), self.dark.ravel(), self.patterns[bit].ravel(), inverse)
        # With whole grey levels there is at least one wherever there is any light.
        min_contrast = np.float32(1.0 if self.lit.dtype == np.uint8 else 0.02)
        _fill_share(*frames, variance, min_contrast, share)
        return share.reshape(self.lit.shape)

    @property
    def _inverses(self) -> Greys:
        """Inverses (F, L, P), or (0, L, P) if none are projected."""
        return self.patterns[:0] if self.inverses is None else self.inverses


def transpose(images: Greys) -> Greys:
    """Transpose each image of a stack (F, H, W)."""
    result = np.empty((len(images), *images.shape[:0:-1]), images.dtype)
    for image, target in zip(images, result, strict=True):
        cv2.transpose(image, dst=target)
    return result


@compiled
def _difference(
    pattern: float, inverse: float, lit: float, dark: float, inverted: bool, variance: Floats
) -> tuple[np.float32, np.float32]:
    """See `ScanLines.difference`; for one pixel."""
    level = np.float32(pattern)
    if inverted:
        return level - np.float32(inverse), np.sqrt(
            variance[np.int64(pattern)] + variance[np.int64(inverse)]
        )
    above = (level - np.float32(lit)) + (level - np.float32(dark))
    twice = np.float32(2.0) * variance[np.int64(pattern)]
    return above, np.sqrt(twice + twice + variance[np.int64(lit)] + variance[np.int64(dark)])


@compiled
def _compute_differences(
    lit: Greys,
    dark: Greys,
    patterns: Greys,
    inverses: Greys,
    bit: Indices,
    pixels: Indices,
    variance: Floats,
) -> tuple[Floats, Floats]:
    difference, noise = np.empty(pixels.shape, np.float32), np.empty(pixels.shape, np.float32)
    inverted = inverses.size > 0
    for k in range(pixels.shape[0]):
        for n in range(pixels.shape[1]):
            pixel = pixels[k, n]
            index = bit[k] * lit.size + pixel
            inverse = inverses[index] if inverted else patterns[index]
            difference[k, n], noise[k, n] = _difference(
                patterns[index], inverse, lit[pixel], dark[pixel], inverted, variance
            )
    return difference, noise


@compiled
def _fill_share(
    lit: Greys,
    dark: Greys,
    pattern: Greys,
    inverse: Greys,
    variance: Floats,
    min_contrast: np.float32,
    share: Bytes,
) -> None:
    inverted = inverse.size > 0
    other = inverse if inverted else pattern
    for n in range(lit.size):
        light, black = lit[n], dark[n]
        difference, noise = _difference(pattern[n], other[n], light, black, inverted, variance)
        contrast = max(np.float32(light) - np.float32(black), min_contrast)
        relative = np.float32(WHOLE_SHARE) * (abs(difference) + noise) / contrast
        share[n] = min(relative, np.float32(255.0))
