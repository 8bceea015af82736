"""Stripe maps of codes that give s at each pixel by itself: light section and phase shift."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bodyscan.arrays import Floats, Greys
from bodyscan.stripes.albedo_edges import Brightness, without_edges_across
from bodyscan.stripes.boundaries import LEAST_SIGMA_PX, Boundaries, continues_to_next
from bodyscan.stripes.scan_lines import ScanLines
from bodyscan.stripes.stripe_coordinates import interpolate_stripes
from bodyscan.stripes.stripe_map import StripeMap, stripe_map

LARGEST_STEP = 1.5
"""Greatest change of s, in stripes, between neighbouring pixels of one surface."""


def pixel_stripe_map(
    images: ScanLines,
    lit: Greys,
    s: Floats,
    sigma: Floats,
    variance: Floats,
    stripes: int,
    *,
    codes: NDArray[np.int32] | None = None,
) -> StripeMap:
    """The map of s and its standard deviation (L, P), NaN where a pixel cannot be used.

    variance: (256,) of each grey level.
    codes: (L, P) stripes; if given, boundaries around a pixel replace its s where they know it
        better.

    Edges of the surface's brightness pull s as they pull boundaries (see `albedo_edges`); that is
    corrected first. Boundaries are where s passes a whole number between two pixels of a line.
    """
    brightness = Brightness.of(images, variance, np.isfinite(s))
    raw = whole_numbers(s, sigma, 0.0)
    edges = brightness.at(raw.line * s.shape[1] + raw.before)
    blur2 = edges.blur2(raw.position, raw.joined)
    s, sigma = without_edges_along(s, sigma, brightness, blur2)
    s, sigma = without_edges_across(s, sigma, brightness, blur2)
    s[(s < 0) | (s > stripes)] = np.nan
    sigma[np.isnan(s)] = np.nan
    boundaries = whole_numbers(s, sigma, blur2)
    if codes is not None:
        between, doubt = interpolate_stripes(boundaries, codes, np.isfinite(s))
        better = doubt < sigma
        s, sigma = np.where(better, between, s), np.where(better, doubt, sigma)
    return stripe_map(images, lit, s, sigma, boundaries, stripes)


def whole_numbers(s: Floats, sigma: Floats, blur2: float) -> Boundaries:
    """Boundaries where s passes a whole number between two neighbours on a line, interpolated
    linearly."""
    here, there = s[:, :-1], s[:, 1:]
    step = there - here
    whole = np.rint((here + there) / 2)
    passed = (np.minimum(here, there) < whole) & (whole <= np.maximum(here, there))
    line, before = np.nonzero(passed & (np.abs(step) < LARGEST_STEP))
    slope = step[line, before].astype(np.float64)
    index = whole[line, before].astype(np.int64)
    share = (index - here[line, before]) / slope
    doubt = np.hypot((1.0 - share) * sigma[line, before], share * sigma[line, before + 1])
    position = before + share
    return Boundaries(
        line=line,
        before=before,
        position=position,
        line_position=line.astype(np.float64),
        sigma_px=np.hypot(doubt / np.abs(slope), LEAST_SIGMA_PX),
        index=index,
        joined=continues_to_next(line, before, position, index, np.isfinite(s)),
        blur2=blur2,
    )


def without_edges_along(
    s: Floats, sigma: Floats, brightness: Brightness, blur2: float
) -> tuple[Floats, Floats]:
    """Remove from s (L, P) the pull of edges that cross the scan lines; returns s and its sigma."""
    lines, places = s.shape
    at = np.arange(lines * places - 1)
    step = np.append(brightness.at(at).along, 0.0).reshape(lines, places).astype(np.float32)
    turned = Brightness(brightness.logarithm.T, brightness.noise2.T, _middle(step).T, step.T)
    freed, doubt = without_edges_across(s.T, sigma.T, turned, blur2)
    return np.ascontiguousarray(freed.T), np.ascontiguousarray(doubt.T)


def _middle(step: Floats) -> Floats:
    """Gradient at pixels, from that between each and the next on its line."""
    gradient = np.zeros_like(step)
    gradient[:, 1:-1] = (step[:, 1:-1] + step[:, :-2]) / 2
    return gradient
