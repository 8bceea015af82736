"""The frames of a stripe sequence, laid out so that every row crosses the stripes."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from bodyscan.arrays import Bytes, Floats, Greys, Indices, Mask
from bodyscan.compiled import compiled
from bodyscan.stripes.line_bands import BandLines

Words = NDArray[np.uint16]

WHOLE_SHARE = 128
"""All of the light, in images of its shares."""


@dataclass(frozen=True, eq=False)
class ScanLines:
    """Frames as scan lines: L lines, each of P positions across the stripes.

    lit, dark: (L, P).
    patterns: (F, L, P), the images of the code.
    inverses: (F, L, P), None if none are projected. All of one type, see `Greys`.
    turned: the lines are the camera image's columns (its stripes are horizontal).
    bands: which of its lines they are, if not all.
    """

    lit: Greys
    dark: Greys
    patterns: Greys
    inverses: Greys | None
    turned: bool
    bands: BandLines | None = None

    @staticmethod
    def along_lines(
        lit: Greys, dark: Greys, patterns: Greys, inverses: Greys | None, direction: str
    ) -> ScanLines:
        """From images (H, W) and stacks (F, H, W)."""
        if direction != "horizontal":
            return ScanLines(lit, dark, patterns, inverses, False)
        lit, dark = cv2.transpose(lit), cv2.transpose(dark)
        turned = None if inverses is None else transpose(inverses)
        return ScanLines(lit, dark, transpose(patterns), turned, True)

    @property
    def contrast(self) -> Floats:
        """Lit minus dark, (L, P), grey levels."""
        return cv2.subtract(self.lit, self.dark, dtype=cv2.CV_32F)

    def words(self) -> NDArray[np.uint16]:
        """Code words (L, P), the first pattern being the most significant bit."""
        words = np.zeros(self.lit.shape, np.uint16)
        for bit in range(len(self.patterns)):
            if self.inverses is None:
                words <<= 1
                words |= self.bright(bit)
            else:
                _append_bit(words.ravel(), self.patterns[bit].ravel(), self.inverses[bit].ravel())
        return words

    def bright(self, bit: int) -> Mask:
        """Where a pattern is brighter (L, P) than its inverse, or without one than the middle
        between lit and dark."""
        if self.inverses is not None:
            return np.asarray(self.patterns[bit] > self.inverses[bit])
        if self.lit.dtype != np.uint8:
            return np.asarray(2.0 * self.patterns[bit] > self.lit + self.dark)
        middle = cv2.add(self.lit, self.dark, dtype=cv2.CV_16S)
        return np.asarray(2 * self.patterns[bit].astype(np.int16) > middle)

    def difference(self, bit: Indices, at: Indices, variance: Floats) -> tuple[Floats, Floats]:
        """Pattern minus inverse of bits (N,) at flat pixels (N, K), and its noise, grey levels.

        Pixels below 0 get 0. Without inverses, twice the excess of the pattern over the middle of
        lit and dark.
        """
        patterns, inverses = self.patterns.reshape(-1), self._inverses.reshape(-1)
        return _differences(
            self.lit.ravel(), self.dark.ravel(), patterns, inverses, bit, at, variance
        )

    def direct_share(self, bit: int, variance: Floats) -> Bytes:
        """Share (L, P) of lit minus dark that shows in `difference` of one bit, or as much as its
        noise allows, in 1/WHOLE_SHARE; at most 255."""
        share = np.empty(self.lit.size, np.uint8)
        inverse = self._inverses[bit : bit + 1].reshape(-1)
        frames = (self.lit.ravel(), self.dark.ravel(), self.patterns[bit].ravel(), inverse)
        # With whole grey levels there is at least one wherever there is any light.
        least = np.float32(1.0 if self.lit.dtype == np.uint8 else 0.02)
        _share(*frames, variance, least, share)
        return share.reshape(self.lit.shape)

    @property
    def _inverses(self) -> Greys:
        """Inverses (F, L, P), or (0, L, P) if none are projected."""
        return self.patterns[:0] if self.inverses is None else self.inverses


def transpose(images: Greys) -> Greys:
    """Transpose each image of a stack (F, H, W)."""
    turned = np.empty((len(images), *images.shape[:0:-1]), images.dtype)
    for image, target in zip(images, turned, strict=True):
        cv2.transpose(image, dst=target)
    return turned


@compiled
def _append_bit(words: Words, pattern: Greys, inverse: Greys) -> None:
    """Shift code words (N,) by one bit and set it where the pattern is brighter."""
    for at in range(words.size):
        words[at] = (words[at] << 1) | (pattern[at] > inverse[at])


@compiled
def _difference(
    pattern: float, inverse: float, lit: float, dark: float, inverted: bool, variance: Floats
) -> tuple[np.float32, np.float32]:
    """See `ScanLines.difference`; for one pixel."""
    seen = np.float32(pattern)
    if inverted:
        return seen - np.float32(inverse), np.sqrt(
            variance[np.int64(pattern)] + variance[np.int64(inverse)]
        )
    above = (seen - np.float32(lit)) + (seen - np.float32(dark))
    twice = np.float32(2.0) * variance[np.int64(pattern)]
    return above, np.sqrt(twice + twice + variance[np.int64(lit)] + variance[np.int64(dark)])


@compiled
def _differences(
    lit: Greys,
    dark: Greys,
    patterns: Greys,
    inverses: Greys,
    bit: Indices,
    at: Indices,
    variance: Floats,
) -> tuple[Floats, Floats]:
    difference, noise = np.zeros(at.shape, np.float32), np.zeros(at.shape, np.float32)
    inverted = inverses.size > 0
    for k in range(at.shape[0]):
        for n in range(at.shape[1]):
            pixel = at[k, n]
            if pixel < 0:
                continue
            place = bit[k] * lit.size + pixel
            inverse = inverses[place] if inverted else patterns[place]
            difference[k, n], noise[k, n] = _difference(
                patterns[place], inverse, lit[pixel], dark[pixel], inverted, variance
            )
    return difference, noise


@compiled
def _share(
    lit: Greys,
    dark: Greys,
    pattern: Greys,
    inverse: Greys,
    variance: Floats,
    least: np.float32,
    share: Bytes,
) -> None:
    inverted = inverse.size > 0
    other = inverse if inverted else pattern
    most = np.float32(255.0)
    for at in range(lit.size):
        light, black = lit[at], dark[at]
        difference, noise = _difference(pattern[at], other[at], light, black, inverted, variance)
        contrast = max(np.float32(light) - np.float32(black), least)
        share[at] = min(np.float32(WHOLE_SHARE) * (abs(difference) + noise) / contrast, most)
