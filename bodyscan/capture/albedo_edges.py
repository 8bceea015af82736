"""Stripe boundaries that fall on an edge of the surface's own brightness, put right.

A pixel gathers light around its middle x with a Gaussian weight of variance blur^2 (lens and
pixel). On an edge between black and white the white side gives more of it: the light's centre of
mass is x + blur^2 grad(ln a), a being the picture of the surface, and what a pixel says of the
stripes holds there. So boundaries are moved by that much: by up to 0.6 px on a printed board.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from bodyscan.capture.stripe_images import ScanLines

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]

USUAL_BLUR2 = 0.45
LARGEST_BLUR2 = 2.0
STEEP = 0.5
STEEP_TO_NOISE = 5.0
ENOUGH = 100
UNEXPLAINED = 0.3
SIGNIFICANCE = 2.5
MAX_SLOPE = 1.0
GENTLE_PX = 3
"""Half the window over which shading is taken to change evenly."""
LEAST_PIXELS = 12
LEAST_SPREAD = 0.5
MAX_SHIFT_PX = 0.6


@dataclass(frozen=True, eq=False)
class Brightness:
    """How bright the surface is, as scan lines of pixels.

    logarithm: (L, P) of lit minus dark.  noise2: (L, P) its variance.  across: (L, P) its gradient
    from line to line, 1/px, brought near `shading_across` where noise may explain the difference.
    shading: (L, P) the gradient along the line of the gentle part, of many pixels around.
    """

    logarithm: NDArray[np.float32]
    noise2: NDArray[np.float32]
    across: NDArray[np.float32]
    shading: NDArray[np.float32]

    @staticmethod
    def of(images: ScanLines, variance: NDArray[np.float32], usable: Mask) -> Brightness:
        """variance: (256,) of each grey level.  usable: (L, P) pixels on a lit surface."""
        contrast = np.maximum(images.contrast, 1.0)
        logarithm = np.log(contrast)
        noise2 = (variance[images.lit] + variance[images.dark]) / contrast**2
        along, across = gentle_gradient(logarithm, usable)
        difference = (logarithm[2:] - logarithm[:-2]) / 2 - across[1:-1]
        across[1:-1] += _significant(difference, (noise2[2:] + noise2[:-2]) / 4)
        return Brightness(logarithm, noise2, across, along)

    def at(self, place: NDArray[np.int64]) -> BrightnessEdges:
        """Between the pixels at flat places `place` (N,) and those behind them."""
        before, behind, across, shading, noise2 = (
            image.ravel()[where].astype(np.float64)
            for image, where in (
                (self.logarithm, place),
                (self.logarithm, place + 1),
                (self.across, place),
                (self.shading, place),
                (self.noise2, place),
            )
        )
        along = shading + _significant(behind - before - shading, 2.0 * noise2)
        middle = (before + behind) / 2
        return BrightnessEdges(
            before=np.exp(middle - along / 2),
            behind=np.exp(middle + along / 2),
            along=along,
            across=across,
            sigma=np.sqrt(2.0 * noise2),
        )


@dataclass(frozen=True, eq=False)
class BrightnessEdges:
    """The surface's brightness where N stripe boundaries pass between two pixels of a scan line.

    before, behind: (N,) grey levels (lit minus dark) of both, brought together where noise may
    explain that they differ.  along, across: (N,) grad(ln a), 1/px, along the line and from line
    to line, likewise.  sigma: (N,) the noise of `along`.
    """

    before: Floats
    behind: Floats
    along: Floats
    across: Floats
    sigma: Floats

    def blur2(self, position: Floats, joined: Mask) -> float:
        """blur^2, px^2, that makes boundaries next to edges line up with their neighbours.

        position: (N,) px along the scan line.  joined: (N - 1,) whether the next boundary is the
        next of the same run. Where there are not edges enough to tell, a usual value: that of a
        lens of 0.6 px and a pixel.
        """
        middle = np.flatnonzero(joined[:-1] & joined[1:]) + 1
        bend = position[middle] - (position[middle - 1] + position[middle + 1]) / 2
        steepness = self.along[middle] - (self.along[middle - 1] + self.along[middle + 1]) / 2
        steep = np.abs(steepness) > np.maximum(STEEP, STEEP_TO_NOISE * self.sigma[middle])
        if steep.sum() < ENOUGH:
            return USUAL_BLUR2
        return float(np.clip(-np.median(bend[steep] / steepness[steep]), 0.0, LARGEST_BLUR2))

    def doubt(self, blur2: float) -> Floats:
        """Standard deviation (N,) px of the shift blur2 * (along, across)."""
        noise = np.minimum(self.sigma, np.abs(self.along))
        return blur2 * np.hypot(UNEXPLAINED * np.hypot(self.along, self.across), noise)


def without_edges_across(
    s: NDArray[np.float32], sigma: NDArray[np.float32], brightness: Brightness, blur2: float
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """s and sigma (L, P) with the pull of edges that run along the scan lines taken out of s.

    A pixel tells s at its light's centre of mass, which lies off the line by blur2 * across.
    """
    slope = np.zeros_like(s)
    slope[1:-1] = (s[2:] - s[:-2]) / 2
    # At the end of the surface only the change on the inner side is known.
    one_sided = np.diff(s, axis=0)
    for target, change in ((slope[1:], one_sided), (slope[:-1], one_sided)):
        missing = np.isnan(target)
        target[missing] = change[missing]
    slope[~(np.abs(slope) < MAX_SLOPE)] = 0.0
    shift = np.clip(blur2 * brightness.across, -MAX_SHIFT_PX, MAX_SHIFT_PX)
    pull = slope * shift
    return s - pull, np.hypot(sigma, 2.0 * UNEXPLAINED * pull)


def gentle_gradient(
    image: NDArray[np.float32], usable: Mask
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Gradient along and across the lines (L, P), 1/px: least squares over the usable pixels of a
    small window; 0 where there are too few."""
    offset = np.arange(-GENTLE_PX, GENTLE_PX + 1, dtype=np.float32)
    flat = np.ones_like(offset)
    inside = usable.astype(np.float32)
    weighted = np.where(usable, image, np.float32(0.0))

    def moment(of: NDArray[np.float32], along: int, across: int) -> NDArray[Any]:
        kernels = (offset**power if power else flat for power in (along, across))
        return cv2.sepFilter2D(of, cv2.CV_32F, *kernels, borderType=cv2.BORDER_CONSTANT)

    count = moment(inside, 0, 0)
    enough = count > LEAST_PIXELS - 0.5
    count = np.where(enough, count, np.float32(1.0))
    x, y = moment(inside, 1, 0) / count, moment(inside, 0, 1) / count
    mean = moment(weighted, 0, 0) / count
    xx = moment(inside, 2, 0) / count - x * x
    yy = moment(inside, 0, 2) / count - y * y
    xy = moment(inside, 1, 1) / count - x * y
    xv, yv = moment(weighted, 1, 0) / count - x * mean, moment(weighted, 0, 1) / count - y * mean
    enough &= xx * yy - xy * xy > LEAST_SPREAD
    area = np.where(enough, xx * yy - xy * xy, np.float32(np.inf))
    return (yy * xv - xy * yv) / area, (xx * yv - xy * xv) / area


def _significant(gradient: NDArray[Any], variance: NDArray[Any]) -> NDArray[Any]:
    """Gradients, those that noise may explain brought near zero."""
    return gradient * gradient**2 / (gradient**2 + SIGNIFICANCE**2 * variance + 1e-12)
