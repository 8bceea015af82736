"""The frames of a stripe sequence, laid out so that every image row crosses the stripes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from numpy.typing import NDArray

from bodyscan.capture.indirect_light import WHOLE_SHARE, mostly_direct
from bodyscan.capture.views import StripeMap
from bodyscan.compiled import compiled

if TYPE_CHECKING:
    from bodyscan.capture.boundaries import Boundaries

Bytes = NDArray[np.uint8]
Mask = NDArray[np.bool_]
Ints = NDArray[np.int64]
Image = NDArray[np.float32]
Words = NDArray[np.uint16]

SATURATED = 254
MIN_CONTRAST = 4.0
MIN_CONTRAST_TO_NOISE = 5.0
WHOLLY_COVERED = 0.7


@dataclass(frozen=True, eq=False)
class ScanLines:
    """Frames as scan lines: L lines, each of P positions across the stripes.

    lit, dark: (L, P) uint8.  patterns: (F, L, P) uint8, the images of the code.
    inverses: (F, L, P) uint8, None where none are thrown.
    turned: the lines are the camera image's columns (its stripes are horizontal).
    """

    lit: Bytes
    dark: Bytes
    patterns: Bytes
    inverses: Bytes | None
    turned: bool

    @staticmethod
    def along_lines(
        lit: Bytes, dark: Bytes, patterns: Bytes, inverses: Bytes | None, direction: str
    ) -> ScanLines:
        """From images (H, W) and stacks (F, H, W)."""
        if direction != "horizontal":
            return ScanLines(lit, dark, patterns, inverses, False)
        lit, dark = cv2.transpose(lit), cv2.transpose(dark)
        turned = None if inverses is None else transposed(inverses)
        return ScanLines(lit, dark, transposed(patterns), turned, True)

    @property
    def contrast(self) -> NDArray[np.float32]:
        """Lit minus dark, (L, P), grey levels."""
        return cv2.subtract(self.lit, self.dark, dtype=cv2.CV_32F)

    def words(self) -> NDArray[np.uint16]:
        """(L, P) code words, the first pattern the most significant bit."""
        words = np.zeros(self.lit.shape, np.uint16)
        for bit in range(len(self.patterns)):
            if self.inverses is None:
                words <<= 1
                words |= self.bright(bit)
            else:
                _append_bit(words.ravel(), self.patterns[bit].ravel(), self.inverses[bit].ravel())
        return words

    def bright(self, bit: int) -> Mask:
        """(L, P): where a pattern is brighter than its inverse, or than the middle between lit and
        dark if there is no inverse."""
        if self.inverses is not None:
            return np.asarray(self.patterns[bit] > self.inverses[bit])
        middle = cv2.add(self.lit, self.dark, dtype=cv2.CV_16S)
        return np.asarray(2 * self.patterns[bit].astype(np.int16) > middle)

    def difference(
        self, bit: NDArray[np.int64], at: NDArray[np.int64], variance: NDArray[np.float32]
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Pattern minus inverse of bits (N,) at flat pixels (N, K), and its noise, grey levels.

        Pixels below 0 get 0. Without inverses, twice what the pattern is above the middle of lit
        and dark.
        """
        patterns, inverses = self.patterns.reshape(-1), self._inverses.reshape(-1)
        return _differences(
            self.lit.ravel(), self.dark.ravel(), patterns, inverses, bit, at, variance
        )

    def direct_share(self, bit: int, variance: NDArray[np.float32]) -> Bytes:
        """(L, P): what part of lit minus dark shows in `difference` of one bit, or as much as its
        noise allows, in 1/WHOLE_SHARE; at most 255."""
        share = np.empty(self.lit.size, np.uint8)
        inverse = self._inverses[bit : bit + 1].reshape(-1)
        frames = (self.lit.ravel(), self.dark.ravel(), self.patterns[bit].ravel(), inverse)
        _share(*frames, variance, share)
        return share.reshape(self.lit.shape)

    @property
    def _inverses(self) -> Bytes:
        """(F, L, P), or (0, L, P) where none are thrown."""
        return self.patterns[:0] if self.inverses is None else self.inverses

    def usable(
        self, codes: NDArray[np.int32], variance: NDArray[np.float32], stripes: int, fine_bit: int
    ) -> Mask:
        """(L, P): pixels whose stripes `codes` can be relied on.

        Not low contrast, saturation, codes that were not projected, pixels that the surface's rim
        covers only in part, pixels beside a jump of the code by more than one (a mixed pixel at a
        depth jump is one), and pixels that other surfaces light more than the projector does.
        variance: (256,) of each grey level.  fine_bit: see `mostly_direct`.
        """
        contrast = cv2.subtract(self.lit, self.dark)
        least = np.maximum(MIN_CONTRAST, MIN_CONTRAST_TO_NOISE * np.sqrt(variance))
        least = np.minimum(np.ceil(least), 255).astype(np.uint8)
        bright = contrast >= cv2.LUT(cv2.max(self.lit, self.dark), least)
        bright &= ~half_covered(contrast, bright)
        usable = bright & (self.lit < SATURATED) & (codes < stripes)
        usable &= ~beside_jumps(codes, usable)
        return usable & mostly_direct(self, usable, fine_bit, variance)

    def stripe_map(
        self,
        lit: Bytes,
        s: NDArray[np.float32],
        sigma: NDArray[np.float32],
        boundaries: Boundaries,
        stripes: int,
        beyond: Mask | None = None,
    ) -> StripeMap:
        """Back to the camera's own layout."""
        pixels = np.stack([boundaries.position, boundaries.line_position], axis=-1)
        if self.turned:
            s, sigma = cv2.transpose(s), cv2.transpose(sigma)
            pixels = pixels[:, ::-1]
            beyond = None if beyond is None else beyond.T
        return StripeMap(
            s=s,
            sigma=sigma,
            lit=lit,
            boundary_index=boundaries.index,
            boundary_pixels=np.ascontiguousarray(pixels, float),
            boundary_sigma_px=boundaries.sigma_px.astype(np.float32),
            stripes=stripes,
            beyond=beyond,
        )


def transposed(images: Bytes) -> Bytes:
    """Each image of a stack (F, H, W) transposed."""
    turned = np.empty((len(images), *images.shape[:0:-1]), np.uint8)
    for image, target in zip(images, turned, strict=True):
        cv2.transpose(image, dst=target)
    return turned


@compiled
def _append_bit(words: Words, pattern: Bytes, inverse: Bytes) -> None:
    """Makes room for one bit in code words (N,) and sets it where the pattern is brighter."""
    for at in range(words.size):
        words[at] = (words[at] << 1) | (pattern[at] > inverse[at])


@compiled
def _difference(
    pattern: int, inverse: int, lit: int, dark: int, inverted: bool, variance: Image
) -> tuple[np.float32, np.float32]:
    """See `ScanLines.difference`; of one pixel."""
    seen = np.float32(pattern)
    if inverted:
        return seen - np.float32(inverse), np.sqrt(variance[pattern] + variance[inverse])
    above = (seen - np.float32(lit)) + (seen - np.float32(dark))
    twice = variance[pattern] + variance[pattern]
    return above, np.sqrt(twice + twice + variance[lit] + variance[dark])


@compiled
def _differences(
    lit: Bytes, dark: Bytes, patterns: Bytes, inverses: Bytes, bit: Ints, at: Ints, variance: Image
) -> tuple[Image, Image]:
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
    lit: Bytes, dark: Bytes, pattern: Bytes, inverse: Bytes, variance: Image, share: Bytes
) -> None:
    inverted = inverse.size > 0
    other = inverse if inverted else pattern
    most = np.float32(255.0)
    for at in range(lit.size):
        light, black = lit[at], dark[at]
        difference, noise = _difference(pattern[at], other[at], light, black, inverted, variance)
        contrast = max(np.float32(light) - np.float32(black), np.float32(1.0))
        share[at] = min(np.float32(WHOLE_SHARE) * (abs(difference) + noise) / contrast, most)


def half_covered(contrast: NDArray[Any], lit: Mask) -> Mask:
    """(L, P): pixels beside one that is not lit and much darker than their brightest neighbour.

    They straddle the rim of the surface, and tell s of its part of them, not of their middle.
    """
    around = np.ones((3, 3), np.uint8)
    at_rim = cv2.erode(lit.view(np.uint8), around, borderValue=1) == 0
    return at_rim & (contrast < np.float32(WHOLLY_COVERED) * cv2.dilate(contrast, around))


def beside_jumps(codes: NDArray[np.int32], usable: Mask) -> Mask:
    """(L, P): pixels whose code differs from a usable neighbour's by more than one."""
    jumps = np.zeros(codes.shape, bool)
    _mark_jumps(codes, usable, jumps)
    return jumps


@compiled
def _mark_jumps(codes: NDArray[np.int32], usable: Mask, jumps: Mask) -> None:
    # Without a branch inside: on a noisy image a processor guesses wrong every other time.
    lines, places = codes.shape
    for line in range(lines):
        jump = _leaps(codes[line, 1:], codes[line, :-1], usable[line, 1:], usable[line, :-1])
        for place in range(places - 1):
            jumps[line, place] |= jump[place]
        for place in range(places - 1):
            jumps[line, place + 1] |= jump[place]
        if line + 1 == lines:
            break
        jump = _leaps(codes[line + 1], codes[line], usable[line + 1], usable[line])
        for place in range(places):
            jumps[line, place] |= jump[place]
            jumps[line + 1, place] |= jump[place]


@compiled
def _leaps(
    one: NDArray[np.int32], other: NDArray[np.int32], usable: Mask, usable_too: Mask
) -> Mask:
    """(P,) whether two rows' codes, both usable, differ by more than one."""
    leap = np.empty(one.size, np.bool_)
    for place in range(one.size):
        leap[place] = (abs(one[place] - other[place]) > 1) & usable[place] & usable_too[place]
    return leap
