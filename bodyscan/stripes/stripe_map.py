"""The stripe map of one pair's images of one shot, and its assembly from what decoders find."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from bodyscan.arrays import Array, Bytes, Floats, Greys, Indices, Mask, round_to_grey
from bodyscan.stripes.albedo_edges import Brightness, correct_across_lines
from bodyscan.stripes.boundaries import MIN_SIGMA_PX, Boundaries, join_runs
from bodyscan.stripes.scan_lines import ScanLines
from bodyscan.stripes.stripe_coordinates import interpolate_stripes


@dataclass(frozen=True, eq=False)
class StripeMap:
    """The stripe coordinate of every lit pixel, and the stripe boundaries between them.

    s, sigma: (height, width) float32, in [0, S], and its standard deviation, stripes; NaN where
        there is none.
    lit: (height, width) uint8, the fully lit image (grey).
    boundary_index: (N,) int64: boundary i lies between stripes i - 1 and i, that is s = i.
    boundary_pixels: (N, 2) float64, its position, px, sub-pixel.
    boundary_sigma_px: (N,) float32, standard deviation across the stripe, px.
    stripes: S, the number of stripes projected.
    beyond: (height, width) bool, lit by a stripe that lies deeper than wanted, where s is NaN (see
        `StripeLimits`); None if all stripes were wanted.
    crossing, crossing_fault: the map of the stripes that run the other way, or why there is none.
    correlation_px: distance along rows and along columns within which pixels share noise.
    saturated: share of the pixels lit by wanted stripes that are white; 0 if not counted.
    nonlinearity: see `measure_nonlinearity`; 0 if not measured.
    flash: which frames other light reached, see `replace_flashed`; "" if none.
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
    crossing_fault: str = ""
    correlation_px: tuple[float, float] = (0.0, 0.0)
    saturated: float = 0.0
    nonlinearity: float = 0.0
    flash: str = ""

    @property
    def faults(self) -> tuple[str, ...]:
        """What was wrong with the images and could be left out."""
        crossing = "stripes of the first direction alone are used, not those of `crossing`: "
        found = (
            self.flash,
            crossing + self.crossing_fault if self.crossing_fault else "",
            self.crossing.flash if self.crossing else "",
        )
        return tuple(fault for fault in found if fault)


def assemble_map(
    images: ScanLines,
    lit: Greys,
    s: Floats,
    sigma: Floats,
    boundaries: Boundaries,
    stripes: int,
    beyond: Mask | None = None,
) -> StripeMap:
    """Transpose results along scan lines back into the camera's own layout."""
    if images.transposed:
        s, sigma = cv2.transpose(s), cv2.transpose(sigma)
        beyond = None if beyond is None else beyond.T
    axes = boundaries.position, boundaries.line_position
    return StripeMap(
        s=s,
        sigma=sigma,
        lit=round_to_grey(lit),
        boundary_index=boundaries.index,
        boundary_pixels=np.stack(axes[::-1] if images.transposed else axes, axis=-1),
        boundary_sigma_px=boundaries.sigma_px.astype(np.float32),
        stripes=stripes,
        beyond=beyond,
    )


def assemble_from_pixels(
    images: ScanLines,
    lit: Greys,
    s: Floats,
    sigma: Floats,
    variance: Floats,
    stripes: int,
    *,
    codes: NDArray[np.int32] | None = None,
) -> StripeMap:
    """Make the map from s and its standard deviation (L, P) at each pixel, NaN where there is none.

    variance: (256,) of each grey level.
    codes: (L, P) stripes; if given, s between boundaries is used where its sigma is less.

    Shifts by edges of the surface's brightness are corrected first (see `albedo_edges`).
    """
    brightness = Brightness.from_images(images, variance, np.isfinite(s))
    raw = find_whole_numbers(s, sigma, 0.0)
    edges = brightness.at_boundaries(raw.line * s.shape[1] + raw.before)
    blur2 = edges.estimate_blur2(raw.position, raw.joined)
    s, sigma = _correct_along_lines(s, sigma, brightness, blur2)
    s, sigma = correct_across_lines(s, sigma, brightness, blur2)
    s[(s < 0) | (s > stripes)] = np.nan
    sigma[np.isnan(s)] = np.nan
    boundaries = find_whole_numbers(s, sigma, blur2)
    if codes is not None:
        between, between_sigma = interpolate_stripes(boundaries, codes, np.isfinite(s))
        better = between_sigma < sigma
        s, sigma = np.where(better, between, s), np.where(better, between_sigma, sigma)
    return assemble_map(images, lit, s, sigma, boundaries, stripes)


def find_whole_numbers(s: Floats, sigma: Floats, blur2: float) -> Boundaries:
    """Find boundaries where s passes a whole number between two neighbours on a line, interpolated
    linearly; a step of 1.5 stripes or more leads to another surface."""
    here, there = s[:, :-1], s[:, 1:]
    step = there - here
    whole = np.rint((here + there) / 2)
    passed = (np.minimum(here, there) < whole) & (whole <= np.maximum(here, there))
    line, before = np.nonzero(passed & (np.abs(step) < 1.5))
    slope = step[line, before].astype(np.float64)
    index = whole[line, before].astype(np.int64)
    share = (index - here[line, before]) / slope
    error = np.hypot((1.0 - share) * sigma[line, before], share * sigma[line, before + 1])
    position = before + share
    return Boundaries(
        line=line,
        before=before,
        position=position,
        line_position=line.astype(np.float64),
        sigma_px=np.hypot(error / np.abs(slope), MIN_SIGMA_PX),
        index=index,
        joined=join_runs(line, before, position, index, np.isfinite(s)),
        blur2=blur2,
    )


def _correct_along_lines(
    s: Floats, sigma: Floats, brightness: Brightness, blur2: float
) -> tuple[Floats, Floats]:
    """Correct s (L, P) for edges that cross the scan lines; returns s and its standard deviation."""
    lines, width = s.shape
    along = brightness.at_boundaries(np.arange(lines * width - 1)).along
    step = np.append(along, 0.0).reshape(lines, width).astype(np.float32)
    gradient = np.zeros_like(step)
    gradient[:, 1:-1] = (step[:, 1:-1] + step[:, :-2]) / 2
    transposed = Brightness(brightness.logarithm.T, brightness.noise2.T, gradient.T, step.T)
    s, sigma = correct_across_lines(s.T, sigma.T, transposed, blur2)
    return np.ascontiguousarray(s.T), np.ascontiguousarray(sigma.T)
