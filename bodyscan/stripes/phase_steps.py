"""One wave of light, and a Gray code of its half periods: s from the phase.

Near its own boundaries the Gray code's word is off by at most one, so the middle of its half period
is never half a period from s, and the period whose phase is nearest to it is the right one.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import combinations

import numpy as np

from bodyscan.arrays import Floats, Greys, Mask
from bodyscan.errors import DecodingFailed
from bodyscan.stripes.bit_patterns import read_words
from bodyscan.stripes.bit_words import GRAY
from bodyscan.stripes.grey_noise import noise_variance
from bodyscan.stripes.phase_smoothing import ALIKE_PX, smooth_phase
from bodyscan.stripes.pixel_stripes import pixel_stripe_map
from bodyscan.stripes.projector_response import error_of_repeated, share_of_error, without_error
from bodyscan.stripes.scan_lines import ScanLines, transpose
from bodyscan.stripes.stripe_map import StripeMap
from bodyscan.stripes.usable_pixels import MIN_CONTRAST_TO_NOISE, least_contrast, usable_pixels
from bodyscan.stripes.wave import Wave
from bodyscan.stripes.waves import see_wave

ALIKE = 0.1
MAX_MEAN_ERROR = 0.15
MAX_SHARE_AMISS = 0.15
AFAR = 0.3
"""Share of a period between the phase and the middle of its half period; normally at most 1/4."""

LEAP = 0.6
"""Share of a period, between neighbouring pixels on both sides of a boundary of half periods."""


def decode_phase(
    images: ScanLines, lit: Greys, phases: Greys, half_periods: int, wave: Wave, stripes: int
) -> StripeMap:
    """The stripe map.

    images: scan lines of the Gray code of half periods.
    lit: (H, W) in the camera's layout.
    phases: (steps, H, W), the images of the wave.

    Raises DecodingFailed if the images are inconsistent.
    """
    variance = noise_variance(images)
    halves = GRAY.stripes(read_words(GRAY, images, half_periods, variance))
    fine_bit = GRAY.two_wide(len(images.patterns))
    usable = usable_pixels(images, halves, variance, half_periods, fine_bit)
    phases = transpose(phases) if images.turned else phases
    _check_waves(images, phases, usable)
    seen = see_wave(phases, wave)
    noise = np.sqrt(variance[np.clip(seen.mean, 0, 255).astype(np.uint8)])
    least = least_contrast(phases.dtype) / 2.0
    usable &= seen.amplitude >= np.maximum(least, MIN_CONTRAST_TO_NOISE * noise)
    coarse = (halves.astype(np.float32) + 0.5) / 2.0
    _check_phase(phases, coarse, usable, wave)
    error = error_of_repeated(seen, usable, stripes)
    turn = without_error(seen, error).turn
    period = np.float32(wave.period)
    s = (turn + np.rint(coarse - turn)) * period
    sigma = seen.sigma(noise)
    s[~usable] = np.nan
    s, sigma = smooth_phase(s, np.where(usable, sigma * period, np.float32(np.nan)))
    found = pixel_stripe_map(images, lit, s, sigma, variance, stripes)
    response = share_of_error(error, seen, found.sigma)
    return replace(found, response=response, alike_px=(ALIKE_PX, ALIKE_PX))


def _check_waves(images: ScanLines, waves: Greys, usable: Mask) -> None:
    """Raises DecodingFailed if an image is missing, taken twice or exposed differently.

    Over the image, each is half as bright as the lit one, and so are all together at each pixel.
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
        # Of N images two neighbours differ by sin(pi / N) on average, times their sharpness.
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


def _check_phase(waves: Greys, coarse: Floats, usable: Mask, wave: Wave) -> None:
    """Raises DecodingFailed if phases are outside their half periods, or jump between them."""
    across = (np.abs(np.diff(coarse, axis=1)) == 0.5) & usable[:, 1:] & usable[:, :-1]
    line, place = np.nonzero(across)
    if not len(line):
        return
    pixels = np.stack([place, place + 1])
    leaping, leaping_coarse = waves[:, line, pixels], coarse[line, pixels]
    anywhere, anywhere_coarse = waves[:, None, usable], coarse[None, usable]

    def amiss(order: list[int]) -> float:
        off = see_wave(anywhere[order], wave).turn - anywhere_coarse
        afar = float(np.mean(np.abs(off - np.rint(off)) > AFAR))
        turn = see_wave(leaping[order], wave).turn
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
        else "see whether the images are in their order, and `steps`, `period`, `start_deg` and "
        "`shift` right",
    )


def _mistakes(steps: int) -> Iterator[tuple[str, list[int]]]:
    """Common mistakes in the order of the images, and the order that undoes them."""
    order = list(range(steps))
    for first, second in combinations(order, 2):
        swapped = order.copy()
        swapped[first], swapped[second] = second, first
        yield f"phase images {first} and {second} were exchanged", swapped
    yield "the phase images came in reverse order", order[::-1]
    for start in order[1:]:
        yield f"the phase images began with number {start}", order[-start:] + order[:-start]
