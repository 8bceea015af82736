"""Stripes decoded from patterns of bits: Gray or plain binary code, with inverses or without."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from bodyscan.arrays import Floats, Greys
from bodyscan.errors import DecodingFailed
from bodyscan.stripes.albedo_edges import Brightness, without_edges_across
from bodyscan.stripes.bit_words import WordCode
from bodyscan.stripes.boundaries import find_boundaries
from bodyscan.stripes.boundary_scatter import scatter
from bodyscan.stripes.code_lines import fill_from_codes
from bodyscan.stripes.grey_noise import noise_variance
from bodyscan.stripes.scan_lines import ScanLines
from bodyscan.stripes.sequence_checks import check_codes, check_exposure
from bodyscan.stripes.stripe_coordinates import interpolate_stripes
from bodyscan.stripes.stripe_limits import StripeLimits
from bodyscan.stripes.stripe_map import StripeMap, stripe_map
from bodyscan.stripes.usable_pixels import shown_pixels


def decode_bits(
    code: WordCode, images: ScanLines, lit: Greys, stripes: int, limits: StripeLimits | None
) -> StripeMap:
    """The stripe map of `bit_lines`.  lit: (H, W) as the camera has it.

    Raises DecodingFailed if the images do not add up.
    """
    variance = noise_variance(images)
    codes = code.stripes(read_words(code, images, stripes, variance))
    fine_bit = code.two_wide(len(images.patterns))
    usable, shown = shown_pixels(images, codes, variance, stripes, fine_bit)
    beyond = None
    if limits is not None:
        usable, beyond = limits.split(codes, usable, turned=images.turned)
        shown, _ = limits.split(codes, shown, turned=images.turned)
    brightness = Brightness.of(images, variance, usable)
    boundaries = find_boundaries(
        images, brightness, codes, usable, variance, code.finest_run, code.first
    )
    sigma_px = np.hypot(boundaries.sigma_px, code.doubt_px)
    boundaries = replace(boundaries, sigma_px=sigma_px)
    boundaries = replace(boundaries, sigma_px=scatter(boundaries) * sigma_px)
    s, sigma = interpolate_stripes(boundaries, codes, usable)
    if code.single:  # of others, codes at boundaries are misread by any number
        fill_from_codes(s, sigma, codes, shown)
    s, sigma = without_edges_across(s, sigma, brightness, boundaries.blur2)
    return stripe_map(images, lit, s, sigma, boundaries, stripes, beyond)


def bit_lines(
    lit: Greys, dark: Greys | None, patterns: Greys, inverses: Greys | None, direction: str
) -> ScanLines:
    """The patterns (bits, H, W), and their inverses if there are any, as scan lines.

    Without a dark frame it is taken from the patterns and their inverses: every stripe is dark in
    one of each two. Raises DecodingFailed if there are no inverses either.
    """
    if dark is None:
        if inverses is None:
            raise DecodingFailed(
                "neither a dark frame nor inverse patterns show what black is",
                remedy="take a dark frame",
            )
        dark = np.minimum(patterns, inverses).min(axis=0)
    return ScanLines.along_lines(lit, dark, patterns, inverses, direction)


def read_words(
    code: WordCode, images: ScanLines, count: int, variance: Floats
) -> NDArray[np.uint16]:
    """(L, P) code words, of which there are `count`. Raises DecodingFailed if the frames do not
    add up.  variance: (256,) of each grey level."""
    check_exposure(images)
    words = images.words()
    check_codes(images, words, code, count, variance)
    return words
