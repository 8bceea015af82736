"""Waves of several periods without another code: s from their phases, black and white from their
means and amplitudes."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from bodyscan.arrays import Floats, Greys, Mask
from bodyscan.errors import DecodingFailed
from bodyscan.stripes.phase_order import PhaseOrder, phase_order
from bodyscan.stripes.phase_smoothing import ALIKE_PX, smooth_phase
from bodyscan.stripes.pixel_stripes import pixel_stripe_map
from bodyscan.stripes.projector_response import (
    FEWEST_PERIODS,
    PhaseError,
    error_against,
    error_of_repeated,
    share_of_error,
    without_error,
)
from bodyscan.stripes.scan_lines import ScanLines, transpose
from bodyscan.stripes.sequence_checks import check_direction, check_illumination
from bodyscan.stripes.stripe_map import StripeMap
from bodyscan.stripes.usable_pixels import (
    MIN_CONTRAST_TO_NOISE,
    SATURATED,
    beside_jumps,
    half_covered_pixels,
    least_contrast,
)
from bodyscan.stripes.wave import Shift, Wave
from bodyscan.stripes.wave_noise import wave_variance
from bodyscan.stripes.waves import WaveSeen, in_type, see_wave, split_waves, white_and_black

MOST_DIFFERENT = 0.15
"""Share of the mean brightness, between two waves: lamps and sensors drift by less."""

ALIKE = 0.1
MIN_SHARE_AGREED = 0.6
MOST_APART = 0.06
"""Share of the finest period, between waves overall; the smallest wrong start, 30 degrees, gives
0.083 of it for any whole ratio of their periods except 12 k + 1."""

LINES_TRIED = 20
"""Thousands of pixels, enough to try each of some sixty mistakes."""

AS_GOOD = 1.3
MOST_CAUSES = 2
WHOLE = 1e-6
NEAREST_TRIED, SHARE_TRIED = 4, 0.1
"""Periods are tried that differ from the given one by so much, or by this share of it."""
STARTS = range(30, 360, 30)
"""Degrees, for waves that are written as sines, or begin in the middle of a step."""


def decode_waves(
    images: Greys, waves: tuple[Wave, ...], lit: Greys, direction: str, stripes: int
) -> StripeMap:
    """The stripe map.

    images: (F, H, W), those of each wave in the order of `waves`.
    lit: (H, W).

    Raises DecodingFailed if the images are inconsistent.
    """
    turned = direction == "horizontal"
    lines = transpose(images) if turned else images
    read = _Reading.of(lines, waves, stripes)
    check_illumination(read.shown, read.brightest)
    _check_images(read, stripes)
    if not _in_order(read.order):
        raise _disorder(lines, waves, stripes, read)
    halves = np.floor(2.0 * np.nan_to_num(read.order.s) / read.finest.wave.period).astype(np.int32)
    check_direction(halves, read.order.certain, turned)
    usable = read.order.certain & ~beside_jumps(halves, read.order.certain)
    s = np.where(usable, read.order.s, np.float32(np.nan))
    sigma = np.where(usable, read.order.sigma, np.float32(np.nan))
    s, sigma = smooth_phase(s, sigma)
    light = ScanLines(read.white, read.black, lines[:0], None, turned)
    found = pixel_stripe_map(light, lit, s, sigma, read.variance, stripes)
    response = share_of_error(read.errors[0], read.finest, found.sigma)
    return replace(found, response=response, alike_px=(ALIKE_PX, ALIKE_PX))


@dataclass(frozen=True, eq=False)
class _Reading:
    """What waves show along scan lines (L, P).

    waves: the finest first, with their errors removed.
    images: of each wave.
    errors: of each wave.
    shown: clearly lit.
    brightest: of all images.
    variance: (256,) of each grey level.
    """

    waves: list[WaveSeen]
    images: list[Greys]
    errors: list[PhaseError | None]
    shown: Mask
    brightest: Greys
    white: Greys
    black: Greys
    variance: Floats
    order: PhaseOrder

    @property
    def finest(self) -> WaveSeen:
        return self.waves[0]

    @staticmethod
    def of(lines: Greys, waves: tuple[Wave, ...], stripes: int) -> _Reading:
        stacks = split_waves(lines, waves)
        both = sorted(zip(waves, stacks, strict=True), key=lambda each: each[0].period)
        seen, images = [see_wave(stack, wave) for wave, stack in both], [one for _, one in both]
        brightest = lines.max(axis=0)
        white, black = white_and_black(seen)
        contrast = np.min([2.0 * wave.amplitude for wave in seen], axis=0)
        bright = contrast >= least_contrast(lines.dtype)
        variance = wave_variance(seen, images, bright & (brightest < SATURATED))
        noise = np.sqrt(variance[np.clip(np.rint(seen[0].mean), 0, 255).astype(np.uint8)])
        shown = bright & (contrast >= np.float32(2.0 * MIN_CONTRAST_TO_NOISE) * noise)
        usable = shown & (brightest < SATURATED)
        usable &= ~half_covered_pixels(contrast, shown)
        errors = [error_of_repeated(wave, usable, stripes) for wave in seen]
        right = [without_error(wave, error) for wave, error in zip(seen, errors, strict=True)]
        for place in range(1, len(right)):
            if errors[place] is None:
                errors[place] = error_against(right[place], right[0], usable, stripes)
                right[place] = without_error(right[place], errors[place])
        order = phase_order(right, [wave.sigma(noise) for wave in right], usable, stripes)
        light = in_type(white, lines), in_type(black, lines)
        return _Reading(right, images, errors, shown, brightest, *light, variance, order)


def _check_images(read: _Reading, stripes: int) -> None:
    """Raises DecodingFailed if an image is missing, taken twice or exposed differently.

    All waves have the same mean at each pixel, and no two images of a wave are the same.
    """
    shown = read.shown & (read.brightest < SATURATED)
    if not shown.any():
        return
    for one, images in zip(read.waves, read.images, strict=True):
        ratio = float(np.median(one.mean[shown] / read.finest.mean[shown]))
        if abs(ratio - 1.0) > MOST_DIFFERENT:
            raise DecodingFailed(
                f"the images of the wave of {one.wave.period:g} stripes are on the mean {ratio:.2f} "
                f"times as bright as those of the wave of {read.finest.wave.period:g}",
                remedy="see whether one of them is missing, or was exposed differently",
            )
        if one.wave.period * FEWEST_PERIODS > stripes:
            continue  # on a small subject two images of such a wave may be alike
        strength = float(np.median(one.amplitude[shown]))
        for first, second in combinations(range(len(images)), 2):
            apart = images[first][shown].astype(np.float32) - images[second][shown]
            if np.mean(np.abs(apart)) < ALIKE * strength * np.sin(np.pi / len(images)):
                raise DecodingFailed(
                    f"images {first} and {second} of the wave of {one.wave.period:g} stripes look "
                    "alike",
                    remedy="see whether one of the two is missing or was taken twice",
                )


def _in_order(order: PhaseOrder) -> bool:
    """Whether the waves of most pixels agree, and not by being off alike."""
    return order.agreed >= MIN_SHARE_AGREED and max(map(abs, order.apart), default=0.0) < MOST_APART


def _disorder(
    lines: Greys, waves: tuple[Wave, ...], stripes: int, read: _Reading
) -> DecodingFailed:
    """The error to raise if the waves of most pixels do not agree."""
    rows = np.flatnonzero(read.shown.sum(axis=1) > 0)
    some = lines[:, rows[:: max(1, len(rows) // LINES_TRIED)]]
    tried = (
        (cause, _Reading.of(some[order], changed, stripes).order)
        for cause, order, changed in _mistakes(waves, stripes)
    )
    fitting = [(order.misfit, cause) for cause, order in tried if _in_order(order)]
    best = min((misfit for misfit, _ in fitting), default=0.0)
    # A mistake that mirrors all stripes fits as well as one that does not: report both.
    causes = [cause for misfit, cause in fitting if misfit <= AS_GOOD * best][:MOST_CAUSES]
    found = f"the phases of the waves go together at {read.order.agreed:.0%} of the pixels only"
    if read.order.agreed >= MIN_SHARE_AGREED:
        found = f"the waves begin {max(read.order.apart, key=abs):.2f} of a period apart"
    return DecodingFailed(
        found,
        remedy="it would fit if " + ", or if ".join(causes)
        if causes
        else "see whether the images are in their order, and `steps`, `period` or `periods`, "
        "`start_deg` and `shift` right",
    )


def _mistakes(
    waves: tuple[Wave, ...], stripes: int
) -> Iterator[tuple[str, list[int], tuple[Wave, ...]]]:
    """Common mistakes with images and keys: what, and the order and the waves that undo it."""
    ends = np.cumsum([0, *(wave.steps for wave in waves)])
    everything = list(range(int(ends[-1])))
    for place, wave in enumerate(waves):
        own = everything[ends[place] : ends[place + 1]]
        for what, order in _orders(wave.steps):
            changed = everything.copy()
            changed[ends[place] : ends[place + 1]] = [own[k] for k in order]
            yield f"of the wave of {wave.period:g} stripes {what}", changed, waves
    other: Shift = "backward" if waves[0].shift == "forward" else "forward"
    for start in STARTS:
        moved = tuple(replace(wave, start=wave.start + math.radians(start)) for wave in waves)
        degrees = (math.degrees(moved[0].start) + 180.0) % 360.0 - 180.0
        yield f"`start_deg` were {degrees:g}", everything, moved
        back = tuple(replace(wave, shift=other) for wave in moved)
        yield f"`shift` were {other} and `start_deg` {degrees:g}", everything, back
    for one, two in combinations(range(len(waves)), 2):
        if waves[one].steps == waves[two].steps:
            order = everything.copy()
            here, there = (slice(ends[k], ends[k + 1]) for k in (one, two))
            order[here], order[there] = everything[there], everything[here]
            names = f"{waves[one].period:g} and {waves[two].period:g} stripes"
            yield f"the images of the waves of {names} were exchanged", order, waves
    for place, wave in enumerate(waves):
        for what, period in _other_periods(wave.period, stripes):
            other_wave = replace(wave, period=period)
            yield what, everything, (*waves[:place], other_wave, *waves[place + 1 :])


def _other_periods(period: float, stripes: int) -> Iterator[tuple[str, float]]:
    """Periods near the given one, twice and half of it, as people write them: whole numbers of
    periods in all stripes, or of stripes in a period."""
    for key, given in (("periods", stripes / period), ("period", period)):
        whole = round(given)
        if whole < 2 or abs(given - whole) > WHOLE * given:
            continue
        reach = max(NEAREST_TRIED, round(SHARE_TRIED * whole))
        near = range(max(2, whole - reach), min(whole + reach, stripes // 2) + 1)
        twice = 2 * whole if 2 * whole <= stripes // 2 else whole
        half = whole // 2 if whole % 2 == 0 and whole > 2 else whole
        for other in dict.fromkeys((*near, twice, half)):
            if other != whole:
                length = stripes / other if key == "periods" else float(other)
                yield f"`{key}` had {other} in place of {whole}", length


def _orders(steps: int) -> Iterator[tuple[str, list[int]]]:
    """Common mistakes in the order of one wave's images, and the order that undoes them."""
    order = list(range(steps))
    reverse = [0, *order[:0:-1]]
    yield "the images came in reverse order", reverse
    for first in order[1:]:
        yield f"the images began with number {first}", order[-first:] + order[:-first]
    for first, second in combinations(order, 2):
        swapped = order.copy()
        swapped[first], swapped[second] = second, first
        if swapped != reverse:
            yield f"images {first} and {second} were exchanged", swapped
