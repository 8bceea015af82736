"""The frames of a stripe sequence, laid out so that every image row crosses the stripes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import NDArray

from bodyscan.capture.indirect_light import mostly_direct
from bodyscan.capture.views import StripeMap

if TYPE_CHECKING:
    from bodyscan.capture.boundaries import Boundaries

Bytes = NDArray[np.uint8]
Mask = NDArray[np.bool_]

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
            words <<= 1
            words |= self.bright(bit)
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
        """Pattern minus inverse of bits (N,) at flat pixels (N,), and its noise, grey levels.

        Without inverses, twice what the pattern is above the middle of lit and dark.
        """
        place = bit * self.lit.size + at
        pattern = self.patterns.ravel()[place]
        if self.inverses is not None:
            return _against(pattern, self.inverses.ravel()[place], variance)
        return _above_middle(pattern, self.lit.ravel()[at], self.dark.ravel()[at], variance)

    def difference_image(
        self, bit: int, variance: NDArray[np.float32]
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """`difference` of one bit at all pixels, (L, P)."""
        if self.inverses is not None:
            return _against(self.patterns[bit], self.inverses[bit], variance)
        return _above_middle(self.patterns[bit], self.lit, self.dark, variance)

    def usable(
        self, codes: NDArray[np.int32], variance: NDArray[np.float32], stripes: int, fine_bit: int
    ) -> Mask:
        """(L, P): pixels whose stripes `codes` can be relied on.

        Not low contrast, saturation, codes that were not projected, pixels that the surface's rim
        covers only in part, pixels beside a jump of the code by more than one (a mixed pixel at a
        depth jump is one), and pixels that other surfaces light more than the projector does.
        variance: (256,) of each grey level.  fine_bit: see `mostly_direct`.
        """
        noise = np.sqrt(variance)[cv2.max(self.lit, self.dark)]
        contrast = self.contrast
        usable = contrast >= np.maximum(MIN_CONTRAST, MIN_CONTRAST_TO_NOISE * noise)
        usable &= ~half_covered(contrast, usable)
        usable &= (self.lit < SATURATED) & (codes < stripes)
        usable &= ~beside_jumps(codes, usable)
        return usable & mostly_direct(self, usable, fine_bit, variance)

    def stripe_map(
        self,
        lit: Bytes,
        s: NDArray[np.float32],
        sigma: NDArray[np.float32],
        boundaries: Boundaries,
        stripes: int,
    ) -> StripeMap:
        """Back to the camera's own layout."""
        contrast = self.contrast
        pixels = np.stack([boundaries.position, boundaries.line_position], axis=-1)
        if self.turned:
            s, sigma, contrast = (cv2.transpose(image) for image in (s, sigma, contrast))
            pixels = pixels[:, ::-1]
        return StripeMap(
            s=s,
            sigma=sigma,
            lit=lit,
            contrast=contrast,
            boundary_index=boundaries.index,
            boundary_pixels=np.ascontiguousarray(pixels, float),
            boundary_sigma_px=boundaries.sigma_px.astype(np.float32),
            stripes=stripes,
        )


def transposed(images: Bytes) -> Bytes:
    """Each image of a stack (F, H, W) transposed."""
    return np.stack([cv2.transpose(image) for image in images])


def _against(
    pattern: Bytes, inverse: Bytes, variance: NDArray[np.float32]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    noise = np.sqrt(variance[pattern] + variance[inverse])
    return np.subtract(pattern, inverse, dtype=np.float32), noise


def _above_middle(
    pattern: Bytes, lit: Bytes, dark: Bytes, variance: NDArray[np.float32]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    difference = 2.0 * pattern.astype(np.float32) - lit - dark
    return difference, np.sqrt(4.0 * variance[pattern] + variance[lit] + variance[dark])


def half_covered(contrast: NDArray[np.float32], lit: Mask) -> Mask:
    """(L, P): pixels beside one that is not lit and much darker than their brightest neighbour.

    They straddle the rim of the surface, and tell s of its part of them, not of their middle.
    """
    around = np.ones((3, 3), np.uint8)
    at_rim = cv2.erode(lit.astype(np.uint8), around, borderValue=1) == 0
    return at_rim & (contrast < WHOLLY_COVERED * cv2.dilate(contrast, around))


def beside_jumps(codes: NDArray[np.int32], usable: Mask) -> Mask:
    """(L, P): pixels whose code differs from a usable neighbour's by more than one."""
    jumps = np.zeros(codes.shape, bool)
    across = (np.abs(np.diff(codes, axis=1)) > 1) & usable[:, 1:] & usable[:, :-1]
    jumps[:, 1:] |= across
    jumps[:, :-1] |= across
    along = (np.abs(np.diff(codes, axis=0)) > 1) & usable[1:] & usable[:-1]
    jumps[1:] |= along
    jumps[:-1] |= along
    return jumps
