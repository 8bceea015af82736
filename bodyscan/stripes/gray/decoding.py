"""Stripes decoded from patterns of bits: Gray or plain binary code, with or without inverses."""

from __future__ import annotations

import math
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from bodyscan.arrays import Floats, Greys, Mask
from bodyscan.compiled import compiled
from bodyscan.errors import DecodingFailed
from bodyscan.stripes.albedo_edges import Brightness, correct_across_lines
from bodyscan.stripes.boundaries import find_boundaries
from bodyscan.stripes.gray.bit_words import WordCode
from bodyscan.stripes.gray.sequence_checks import (
    check_exposure,
    check_words,
    measure_nonlinearity,
    replace_flashed,
)
from bodyscan.stripes.grey_noise import measure_noise
from bodyscan.stripes.scan_lines import ScanLines
from bodyscan.stripes.stripe_coordinates import (
    estimate_scatter,
    interpolate_stripes,
    measure_correlation,
)
from bodyscan.stripes.stripe_limits import StripeLimits
from bodyscan.stripes.stripe_map import StripeMap, assemble_map
from bodyscan.stripes.usable_pixels import MIN_CONTRAST, SATURATED, find_usable_pixels


def decode_bits(
    code: WordCode, images: ScanLines, lit: Greys, stripes: int, limits: StripeLimits | None
) -> StripeMap:
    """Compute the stripe map from images laid out by `lay_out`; lit: (H, W) in the camera's layout.

    Raises DecodingFailed if the images are inconsistent.
    """
    images, flash = replace_flashed(images)
    variance = measure_noise(images)
    codes = code.stripes(read_words(code, images, stripes, variance))
    fine_bit = code.bit_two_wide(len(images.patterns))
    usable, coded = find_usable_pixels(images, codes, variance, stripes, fine_bit)
    # Where the light ends blur moves boundaries, and what is scattered beyond keeps the last code. The
    # outermost stripe may be dark, and blur is hardly wider than one.
    inside = (codes >= 2) & (codes < stripes - 2)
    usable, coded = usable & inside, coded & inside
    white = cv2.subtract(images.lit, images.dark) >= np.float32(MIN_CONTRAST)
    white &= (images.lit >= SATURATED) & (codes >= 0) & (codes < stripes)
    beyond = None
    if limits is not None:
        if white.any():
            white, _ = limits.split(codes, white, transposed=images.transposed)
        usable, beyond = limits.split(codes, usable, transposed=images.transposed)
        coded, _ = limits.split(codes, coded, transposed=images.transposed)
    brightness = Brightness.from_images(images, variance, usable)
    boundaries = find_boundaries(images, brightness, codes, usable, variance, code.first)
    sigma_px = np.hypot(boundaries.sigma_px, code.blur_sigma_px)
    boundaries = replace(boundaries, sigma_px=sigma_px)
    boundaries = replace(boundaries, sigma_px=estimate_scatter(boundaries) * sigma_px)
    s, sigma = interpolate_stripes(boundaries, codes, usable)
    if code.single:  # in other codes words at boundaries may be wrong by any number
        fill_from_codes(s, sigma, codes, coded)
    s, sigma = correct_across_lines(s, sigma, brightness, boundaries.blur2)
    result = assemble_map(images, lit, s, sigma, boundaries, stripes, beyond)
    along = measure_correlation(boundaries)
    observed = int(np.count_nonzero(white) + np.count_nonzero(coded))
    return replace(
        result,
        correlation_px=(0.0, along) if images.transposed else (along, 0.0),
        saturated=int(np.count_nonzero(white)) / max(observed, 1),
        nonlinearity=measure_nonlinearity(images),
        flash=flash,
    )


def lay_out(
    lit: Greys, dark: Greys | None, patterns: Greys, inverses: Greys | None, direction: str
) -> ScanLines:
    """Lay out patterns (bits, H, W), and inverses if any, as scan lines.

    A missing dark frame is made from the patterns and their inverses, and so are both lit and dark
    if they were exposed differently. Raises DecodingFailed if there are neither inverses nor dark.
    """
    if dark is None:
        if inverses is None:
            raise DecodingFailed(
                "neither a dark frame nor inverse patterns show what black is",
                remedy="take a dark frame",
            )
        dark = np.minimum(patterns, inverses).min(axis=0)
    if inverses is not None and not _is_equally_exposed(lit, dark, patterns, inverses):
        lit = np.maximum(patterns, inverses).max(axis=0)
        dark = np.minimum(patterns, inverses).min(axis=0)
    return ScanLines.from_images(lit, dark, patterns, inverses, direction)


def _is_equally_exposed(lit: Greys, dark: Greys, patterns: Greys, inverses: Greys) -> bool:
    """Whether coarse patterns and inverses are as bright as lit and as dark as the dark frame.
    Automatic exposure makes them differ; beyond a quarter of the contrast boundaries would move by a
    tenth of a pixel. Patterns finer than the first three may be blurred."""
    step = max(1, math.isqrt(lit.size // 20_000))
    some = (slice(None, None, step), slice(None, None, step))
    light, black = lit[some].astype(np.float32), dark[some].astype(np.float32)
    contrast = light - black
    bright = contrast >= MIN_CONTRAST
    if not bright.any():
        return True
    bright &= contrast >= np.median(contrast[bright])
    errors = []
    for bit in range(min(3, len(patterns))):
        pattern, inverse = patterns[bit][some][bright], inverses[bit][some][bright]
        error = np.abs(np.maximum(pattern, inverse) - light[bright])
        error += np.abs(np.minimum(pattern, inverse) - black[bright])
        # Noise may make two frames differ by 8 grey levels.
        errors.append(float(np.mean(np.maximum(error - 8, 0.0) / contrast[bright])))
    return min(errors) < 0.25


def read_words(
    code: WordCode, images: ScanLines, count: int, variance: Floats
) -> NDArray[np.uint16]:
    """Read the code words (L, P), of which there are `count`; variance: (256,) of each grey level.

    Raises DecodingFailed if the frames are inconsistent.
    """
    check_exposure(images)
    words = images.words()
    check_words(images, words, code, count, variance)
    return words


@compiled
def fill_from_codes(s: Floats, sigma: Floats, codes: NDArray[np.int32], coded: Mask) -> None:
    """Write s and its standard deviation (L, P) into `coded` pixels that have none, from a line
    fitted to the codes of the pixels around.

    Where stripes are so narrow or blurred that codes jump by two or three, runs of boundaries
    break; codes are still right to about a stripe. A pixel a stripe off the line gets none.
    """
    for row in range(codes.shape[0]):
        for x in range(codes.shape[1]):
            if coded[row, x] and math.isnan(s[row, x]):
                offset, error = _fit_codes(codes[row], coded[row], x)
                if error > 0.0:
                    s[row, x], sigma[row, x] = codes[row, x] + 0.5 + offset, error


@compiled
def _fit_codes(codes: NDArray[np.int32], coded: Mask, middle: int) -> tuple[float, float]:
    """Fit a line to the codes (P,) within 4 pixels: its offset from the pixel's code, and sigma. Sigma
    is 0 without a line, or without a jump that would break a run of boundaries."""
    first, last = max(middle - 4, 0), min(middle + 4, codes.size - 1)
    jumps, last_code = False, 0
    count, before, x1, y1, x2, xy, y2 = 0, 0, 0.0, 0.0, 0.0, 0.0, 0.0
    for k in range(first, last + 1):
        if coded[k]:
            jumps |= count > 0 and abs(codes[k] - last_code) > 1
            last_code = codes[k]
            x, y = float(k - middle), float(codes[k] - codes[middle])
            count, before = count + 1, before + (k < middle)
            x1, y1, x2, xy, y2 = x1 + x, y1 + y, x2 + x * x, xy + x * y, y2 + y * y
    # Extrapolation at a rim is unreliable.
    if not jumps or count < 6 or before < 2 or count - before - 1 < 2:
        return 0.0, 0.0
    variance_x = x2 - x1 * x1 / count
    covariance = xy - x1 * y1 / count
    slope = covariance / variance_x
    rms = math.sqrt(max(y2 - y1 * y1 / count - slope * covariance, 0.0) / (count - 2))
    offset = (y1 - slope * x1) / count
    # In stripes wider than 3 px neighbours have the same code; a wrong finest bit is off by one
    # stripe, the next by up to three.
    if abs(slope) < 0.35 or rms > 1.2 or abs(offset) >= 1.0:
        return 0.0, 0.0
    near = 0
    for k in range(first, last + 1):
        line = offset + slope * (k - middle)
        near += coded[k] and abs(codes[k] - codes[middle] - line) < 1.0
    # Correct codes are within 0.5 of the line, misread ones hardly farther; of two surfaces one
    # behind the other half are not.
    if near < 2.0 / 3.0 * count:
        return 0.0, 0.0
    rounding = 12.0**-0.5
    return offset, max(rms, rounding) * math.sqrt(1.0 / count + (x1 / count) ** 2 / variance_x)
