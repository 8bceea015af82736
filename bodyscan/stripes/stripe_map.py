"""Which stripe is where in the images of one pair in one shot."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from bodyscan.arrays import Array, Bytes, Floats, Greys, Indices, Mask, whole_grey
from bodyscan.stripes.boundaries import Boundaries
from bodyscan.stripes.scan_lines import ScanLines


@dataclass(frozen=True)
class ResponseShare:
    """What the projector's response did to s before it was removed, and what noise still does.

    response_rms, noise_rms: stripes, over the pixels that have s.
    """

    response_rms: float
    noise_rms: float

    def __str__(self) -> str:
        total = self.response_rms**2 + self.noise_rms**2
        return (
            f"the projector's response moved s by {self.response_rms:.2g} stripes RMS and was taken"
            f" out ({self.response_rms**2 / total:.0%} of the variance, noise of"
            f" {self.noise_rms:.2g} stripes being the rest)"
        )


@dataclass(frozen=True, eq=False)
class StripeMap:
    """The stripe coordinate of every lit pixel, and the stripe boundaries between them.

    s: (height, width) float32, in [0, S]; NaN where there is none; (0, 0) if only boundaries were
        wanted.
    sigma: (height, width) float32, standard deviation of s, in stripes; NaN likewise.
    lit: (height, width) uint8, the fully lit image (grey).
    boundary_index: (N,) int64: boundary i lies between stripes i - 1 and i, that is s = i.
    boundary_pixels: (N, 2) float64, where it was seen, px, sub-pixel.
    boundary_sigma_px: (N,) float32, standard deviation across the stripe, px.
    stripes: S, the number of stripes projected.
    beyond: (height, width) bool, lit by a stripe that lies deeper than wanted, where s is NaN (see
        `StripeLimits`); None if all stripes were wanted.
    crossing: the map of the stripes that run the other way, if such were projected.
    alike_px: distance along rows and along columns within which pixels share noise, as they lie between
        the same boundaries; 0 if each has its own.
    crossing_fault: why there is none although they were, else "".
    response: what the projector's response did, for codes that measure it; None if noise explains
        it.
    """

    s: Floats
    sigma: Floats
    lit: Bytes
    boundary_index: Indices
    boundary_pixels: Array
    boundary_sigma_px: Floats
    stripes: int
    beyond: Mask | None = None
    crossing: StripeMap | None = None
    response: ResponseShare | None = None
    crossing_fault: str = ""
    alike_px: tuple[float, float] = (0.0, 0.0)


def stripe_map(
    images: ScanLines,
    lit: Greys,
    s: Floats,
    sigma: Floats,
    boundaries: Boundaries,
    stripes: int,
    beyond: Mask | None = None,
) -> StripeMap:
    """Bring what was read along scan lines back into the camera's own layout."""
    if images.turned:
        s, sigma = cv2.transpose(s), cv2.transpose(sigma)
        beyond = None if beyond is None else beyond.T
    found = boundary_map(images, lit, boundaries, stripes)
    return replace(found, s=s, sigma=sigma, beyond=beyond)


def boundary_map(images: ScanLines, lit: Greys, boundaries: Boundaries, stripes: int) -> StripeMap:
    """The boundaries alone, in the camera's own layout."""
    across, kept = boundaries.line_position, np.ones(len(boundaries.line), bool)
    if images.bands is not None:
        across, kept = images.bands.places(boundaries.line, across)
    places = (across, boundaries.position) if images.turned else (boundaries.position, across)
    nothing = np.empty((0, 0), np.float32)
    return StripeMap(
        s=nothing,
        sigma=nothing,
        lit=whole_grey(lit),
        boundary_index=boundaries.index[kept],
        boundary_pixels=np.stack(places, axis=-1)[kept],
        boundary_sigma_px=boundaries.sigma_px[kept].astype(np.float32),
        stripes=stripes,
    )
