"""Waves of light, shifted by a part of their period from image to image: s from their phase.

Image n of N shows 1/2 + 1/2 cos(phi - 2 pi n / N) with phi = 2 pi s / period, so that

    phi = atan2(sum I_n sin(2 pi n / N), sum I_n cos(2 pi n / N)),

whatever the surface's brightness. A Gray code of half periods says which period it is: its
word is off by one near its own boundaries at most, so its middle is never as much as half a
period from s, and the period whose phase is nearest to it is the right one.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import combinations

import numpy as np

from bodyscan.arrays import Bytes, Floats, Mask
from bodyscan.errors import DecodingFailed
from bodyscan.stripes.bit_patterns import read_words
from bodyscan.stripes.bit_words import GRAY
from bodyscan.stripes.grey_noise import noise_variance
from bodyscan.stripes.pixel_stripes import pixel_stripe_map
from bodyscan.stripes.scan_lines import ScanLines, transpose
from bodyscan.stripes.stripe_map import StripeMap
from bodyscan.stripes.usable_pixels import MIN_CONTRAST_TO_NOISE, usable_pixels

MIN_AMPLITUDE = 2.0
LEAST_SIGMA = 5e-4
"""Of a period: what light that is not quite a wave, and rounding, leave."""

ALIKE = 0.1
MAX_MEAN_ERROR = 0.15
MAX_SHARE_AMISS = 0.15
AFAR = 0.3
"""Of a period, between the phase and the middle of its half period; 1/4 if nothing is amiss."""

LEAP = 0.6
"""Of a period, between neighbouring pixels on both sides of two half periods' boundary."""


def decode_phase(
    images: ScanLines, lit: Bytes, waves: Bytes, half_periods: int, period: int, stripes: int
) -> StripeMap:
    """The stripe map.  images: scan lines of the Gray code of half periods.  lit: (H, W) as the
    camera has it.  waves: (steps, H, W).  period: in stripes.

    Raises DecodingFailed if the images do not add up.
    """
    variance = noise_variance(images)
    halves = GRAY.stripes(read_words(GRAY, images, half_periods, variance))
    fine_bit = GRAY.two_wide(len(images.patterns))
    usable = usable_pixels(images, halves, variance, half_periods, fine_bit)
    waves = transpose(waves) if images.turned else waves
    _check_waves(images, waves, usable)
    turn, amplitude, middle = _wave(waves)
    noise = np.sqrt(variance[np.clip(middle, 0, 255).astype(np.uint8)])
    usable &= amplitude >= np.maximum(MIN_AMPLITUDE, MIN_CONTRAST_TO_NOISE * noise)
    coarse = (halves.astype(np.float32) + 0.5) / 2.0
    _check_phase(waves, coarse, usable)
    s = (turn + np.rint(coarse - turn)) * np.float32(period)
    sigma = np.hypot(noise / amplitude / np.sqrt(2.0 * len(waves)) / np.pi, LEAST_SIGMA)
    s[~usable] = np.nan
    sigma = np.where(usable, sigma * period, np.nan).astype(np.float32)
    return pixel_stripe_map(images, lit, s, sigma, variance, stripes)


def _wave(waves: Bytes) -> tuple[Floats, Floats, Floats]:
    """Phase in turns (0 to 1), amplitude and mean (grey levels) of waves (N, L, P)."""
    angle = 2.0 * np.pi * np.arange(len(waves)) / len(waves)
    sine, cosine, middle = (
        np.einsum("nlp,n->lp", waves, weight.astype(np.float32))
        for weight in (np.sin(angle), np.cos(angle), np.full(len(waves), 1.0 / len(waves)))
    )
    amplitude = np.maximum(np.hypot(sine, cosine) * np.float32(2.0 / len(waves)), 1e-3)
    return np.arctan2(sine, cosine) / np.float32(2.0 * np.pi) % np.float32(1.0), amplitude, middle


def _check_waves(images: ScanLines, waves: Bytes, usable: Mask) -> None:
    """Raises DecodingFailed if an image is missing, taken twice or exposed otherwise.

    Each is, over the picture, half as bright as lit, and so are all together at each pixel.
    """
    if not usable.any():
        return
    dark, contrast = images.dark[usable], images.contrast[usable]
    seen = (waves[:, usable].astype(np.float32) - dark) / contrast
    for step, wave in enumerate(seen):
        if abs(np.mean(wave) - 0.5) > 2.0 * MAX_MEAN_ERROR:
            raise DecodingFailed(
                f"phase image {step} is {np.mean(wave):.0%} as bright as lit, not about half",
                remedy="see whether it is missing or was exposed differently",
            )
    for first, second in combinations(range(len(seen)), 2):
        # Of N images two neighbours differ by sin(pi / N) in the mean, times how sharp they are.
        strength = np.percentile(np.abs(seen - 0.5), 90)
        apart = np.mean(np.abs(seen[first] - seen[second]))
        if apart < ALIKE * strength * np.sin(np.pi / len(seen)):
            raise DecodingFailed(
                f"phase images {first} and {second} look alike",
                remedy="see whether one of the two is missing or was taken twice",
            )
    error = np.median(np.abs(seen.mean(axis=0) - 0.5))
    if error > MAX_MEAN_ERROR:
        raise DecodingFailed(
            f"the phase images' mean is not the middle of lit and dark (off by {error:.0%})",
            remedy="see whether all of them were exposed as the lit image was",
        )


def _check_phase(waves: Bytes, coarse: Floats, usable: Mask) -> None:
    """Raises DecodingFailed if phases do not lie in their half periods, or leap between them."""
    across = (np.abs(np.diff(coarse, axis=1)) == 0.5) & usable[:, 1:] & usable[:, :-1]
    line, place = np.nonzero(across)
    if not len(line):
        return
    pixels = np.stack([place, place + 1])
    leaping, leaping_coarse = waves[:, line, pixels], coarse[line, pixels]
    anywhere, anywhere_coarse = waves[:, None, usable], coarse[None, usable]

    def amiss(order: list[int]) -> float:
        off = _wave(anywhere[order])[0] - anywhere_coarse
        afar = float(np.mean(np.abs(off - np.rint(off)) > AFAR))
        turn = _wave(leaping[order])[0]
        before, behind = turn + np.rint(leaping_coarse - turn)
        return max(afar, float(np.mean(np.abs(behind - before) > LEAP)))

    found = amiss(list(range(len(waves))))
    if found <= MAX_SHARE_AMISS:
        return
    causes = (c for c, order in _mistakes(len(waves)) if amiss(order) <= MAX_SHARE_AMISS)
    cause = next(causes, None)
    raise DecodingFailed(
        f"the phase does not go with the Gray code at {found:.0%} of the pixels",
        remedy=f"it would fit if {cause}"
        if cause
        else "see whether the images are in their order, and `steps` and `period` right",
    )


def _mistakes(steps: int) -> Iterator[tuple[str, list[int]]]:
    """Common mistakes with the order of the images, and the order that undoes them."""
    order = list(range(steps))
    for first, second in combinations(order, 2):
        swapped = order.copy()
        swapped[first], swapped[second] = second, first
        yield f"phase images {first} and {second} were exchanged", swapped
    yield "the phase images came in reverse order", order[::-1]
    for start in order[1:]:
        yield f"the phase images began with number {start}", order[-start:] + order[:-start]
