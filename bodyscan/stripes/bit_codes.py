"""Stripes read from patterns of bits: Gray or plain binary code, with inverses or without."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from bodyscan.errors import DecodingFailed
from bodyscan.stripes.albedo_edges import Brightness, without_edges_across
from bodyscan.stripes.boundaries import find_boundaries
from bodyscan.stripes.gray_code import BINARY, GRAY, WordCode
from bodyscan.stripes.grey_noise import noise_variance
from bodyscan.stripes.projector_spec import ProjectorSpec
from bodyscan.stripes.scan_lines import ScanLines
from bodyscan.stripes.sequence import check_codes, check_exposure
from bodyscan.stripes.stripe_coordinates import interpolate_stripes
from bodyscan.stripes.stripe_map import StripeMap, stripe_map
from bodyscan.stripes.usable_pixels import usable_pixels
from bodyscan.stripes.wanted_stripes import WantedStripes

Images = NDArray[np.uint8]


def word_code(spec: ProjectorSpec) -> WordCode:
    """How this projector writes its words in bits."""
    return BINARY if spec.code == "binary" else GRAY


def light(spec: ProjectorSpec, s: NDArray[np.float64]) -> NDArray[np.float64]:
    """(bits, N): light of the patterns at s (N,), 0 or 1."""
    words_per_stripe = 2.0 / spec.period_stripes if spec.code == "phase-shift" else 1.0
    words = word_code(spec).words(np.floor(s * words_per_stripe).astype(np.int64))
    shift = np.arange(spec.bits)[::-1, None]
    return np.asarray(words >> shift & 1, float)


def read(
    spec: ProjectorSpec,
    lit: Images,
    dark: Images | None,
    coded: Images,
    wanted: WantedStripes | None = None,
) -> StripeMap:
    """See `codes.read_code`."""
    images = bit_lines(spec, lit, dark, coded)
    words = checked_words(spec, images)
    code = word_code(spec)
    codes = code.stripes(words)
    variance = noise_variance(images)
    usable = usable_pixels(images, codes, variance, spec.stripes, code.two_wide(spec.bits))
    beyond = None
    if wanted is not None:
        usable, beyond = wanted.split(codes, usable, turned=images.turned)
    brightness = Brightness.of(images, variance, usable)
    boundaries = find_boundaries(images, brightness, codes, usable, variance, code.finest_run)
    sigma_px = np.hypot(boundaries.sigma_px, code.doubt_px)
    boundaries = replace(boundaries, sigma_px=sigma_px)
    s, sigma = interpolate_stripes(boundaries, codes, usable)
    s, sigma = without_edges_across(s, sigma, brightness, boundaries.blur2)
    return stripe_map(images, lit, s, sigma, boundaries, spec.stripes, beyond)


def bit_lines(spec: ProjectorSpec, lit: Images, dark: Images | None, coded: Images) -> ScanLines:
    """The patterns, and their inverses if there are any, as scan lines.

    Without a dark frame it is taken from the patterns and their inverses: every stripe is dark in
    one of each two. Raises DecodingFailed if there are no inverses either.
    """
    patterns, inverses = coded[: spec.bits], None
    if spec.has_inverses:
        inverses = coded[spec.bits : 2 * spec.bits]
    if dark is None:
        if inverses is None:
            raise DecodingFailed(
                "neither a dark frame nor inverse patterns show what black is",
                remedy="take a dark frame",
            )
        dark = np.minimum(patterns, inverses).min(axis=0)
    return ScanLines.along_lines(lit, dark, patterns, inverses, spec.direction)


def checked_words(spec: ProjectorSpec, images: ScanLines) -> NDArray[np.uint16]:
    """(L, P) code words. Raises DecodingFailed if the frames do not add up."""
    check_exposure(images)
    words = images.words()
    check_codes(images, words, word_code(spec), spec.words)
    return words
