"""Stripes decoded from waves: one with a Gray code of its half periods, or several of other periods.

Of several, the finest gives s exactly, except for whole periods. Each s that it leaves open predicts
a phase for the other waves; their distance from it, in sigmas, gives the likelihood of that s. The
same rule applies whether a single period covers all stripes (hierarchical unwrapping) or the waves
only beat (heterodyne). A pixel whose second-best s is nearly as likely gets no order rather than a
guess.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import cv2
import numpy as np

from bodyscan.arrays import Array, Floats, Greys, Indices, Mask
from bodyscan.compiled import compiled
from bodyscan.errors import DecodingFailed
from bodyscan.stripes.gray.bit_words import GRAY
from bodyscan.stripes.gray.decoding import read_words
from bodyscan.stripes.gray.sequence_checks import replace_flashed
from bodyscan.stripes.grey_noise import measure_noise
from bodyscan.stripes.phase.projector_response import (
    MIN_PERIODS,
    correct_wave,
    estimate_error,
    estimate_error_against,
)
from bodyscan.stripes.phase.waves import (
    MeasuredWave,
    balance_images,
    convert_like,
    describe_gains,
    estimate_gains,
    estimate_white_and_black,
    find_lit_part,
    measure_wave,
    measure_wave_noise,
    split_waves,
)
from bodyscan.stripes.scan_lines import ScanLines, transpose
from bodyscan.stripes.stripe_code import Wave
from bodyscan.stripes.stripe_map import StripeMap, assemble_from_pixels
from bodyscan.stripes.usable_pixels import (
    MIN_CONTRAST_TO_NOISE,
    SATURATED,
    check_direction,
    check_illumination,
    find_code_jumps,
    find_half_covered_pixels,
    find_min_contrast,
    find_usable_pixels,
)

CORRELATION_PX = 1.2
"""Distance within which neighbours share noise after `smooth_phase`: the fit keeps all that varies
slowly, so a mean of many pixels is as noisy as before."""
MIN_GAIN = -2.0 * math.log(1e-4)
"""Minimum difference of the second-best order's chi squared: a wrong order has a chance of 1e-4 then,
one flying pixel in ten thousand, which cleaning finds."""
MAX_SIGMAS = 4.5
"""Between two waves at one pixel: one in 150,000 by noise; otherwise the pixel sees two surfaces."""
MIN_PIXELS = 100


def decode_wave(
    images: ScanLines, lit: Greys, phases: Greys, half_periods: int, wave: Wave, stripes: int
) -> StripeMap:
    """Compute the stripe map from one wave and a Gray code of its half periods.

    images: scan lines of the Gray code. lit: (H, W); phases: (steps, H, W), images of the wave.

    Near its own boundaries the Gray code is off by at most one half period, so that the period
    whose phase is nearest to its middle is the right one. DecodingFailed if images disagree.
    """
    images, flash = replace_flashed(images)
    variance = measure_noise(images)
    halves = GRAY.stripes(read_words(GRAY, images, half_periods, variance))
    fine_bit = GRAY.bit_two_wide(len(images.patterns))
    usable, _ = find_usable_pixels(images, halves, variance, half_periods, fine_bit)
    phases = transpose(phases) if images.transposed else phases
    check_wave_images(images, phases, usable)
    measured = measure_wave(phases, wave)
    gains = estimate_gains(phases, measured, images.dark, images.contrast, usable)
    phases, measured = balance_images(phases, measured, images.dark, images.contrast, gains)
    flashed, parts = find_lit_part([phases], [measured], [(images.dark, images.contrast)], usable)
    usable &= ~flashed
    noise = np.sqrt(variance[np.clip(measured.mean, 0, 255).astype(np.uint8)])
    floor = find_min_contrast(phases.dtype) / 2.0
    usable &= measured.amplitude >= np.maximum(floor, MIN_CONTRAST_TO_NOISE * noise)
    coarse = (halves.astype(np.float32) + 0.5) / 2.0
    check_phase(measured.turn, coarse, usable)
    turn = correct_wave(measured, estimate_error(measured, usable, stripes)).turn
    period = np.float32(wave.period)
    s = (turn + np.rint(coarse - turn)) * period
    sigma = measured.sigma(noise)
    s[~usable] = np.nan
    s, sigma = smooth_phase(s, np.where(usable, sigma * period, np.float32(np.nan)))
    result = assemble_from_pixels(images, lit, s, sigma, variance, stripes)
    flash = "; ".join(filter(None, (flash, *describe_gains(gains, wave.period), *parts)))
    return replace(result, correlation_px=(CORRELATION_PX, CORRELATION_PX), flash=flash)


def check_wave_images(images: ScanLines, waves: Greys, usable: Mask) -> None:
    """Raise DecodingFailed if an image of a wave is missing or taken twice: over the image, each is
    about half as bright as the lit one."""
    if not usable.any():
        return
    dark, contrast = images.dark[usable], images.contrast[usable]
    levels = (waves[:, usable].astype(np.float32) - dark) / contrast
    for step, level in enumerate(levels):
        if abs(np.mean(level) - 0.5) > 0.3:
            raise DecodingFailed(
                f"phase image {step} is {np.mean(level):.0%} as bright as lit, not about half",
                remedy="check whether it is missing or was exposed differently",
            )
    strength = float(np.percentile(np.abs(levels - 0.5), 90))
    _check_distinct(levels, strength, "phase images {} and {} look alike")


def _check_distinct(images: Floats, strength: float, message: str) -> None:
    """Raise DecodingFailed if two images (N, M) of a wave differ by a tenth of what they should. Two
    neighbours of N differ by sin(pi / N) on average, times their strength."""
    for first, second in combinations(range(len(images)), 2):
        difference = float(np.mean(np.abs(images[first] - images[second])))
        if difference < 0.1 * strength * np.sin(np.pi / len(images)):
            raise DecodingFailed(
                message.format(first, second),
                remedy="check whether one of the two is missing or was taken twice",
            )


def check_phase(turn: Floats, coarse: Floats, usable: Mask) -> None:
    """Raise DecodingFailed if phases are outside their half periods, or jump between them.

    turn: (L, P) of the wave.
    coarse: (L, P) middles of the half periods, turns.
    """
    change = (np.abs(np.diff(coarse, axis=1)) == 0.5) & usable[:, 1:] & usable[:, :-1]
    line, x = np.nonzero(change)
    if not len(line):
        return
    offset = turn[usable] - coarse[usable]
    outside = float(np.mean(np.abs(offset - np.rint(offset)) > 0.3))  # a right one: 1/4 at most
    pixels = np.stack([x, x + 1])
    before, behind = turn[line, pixels] + np.rint(coarse[line, pixels] - turn[line, pixels])
    wrong = max(outside, float(np.mean(np.abs(behind - before) > 0.6)))
    if wrong > 0.15:
        raise DecodingFailed(
            f"the phase does not match the Gray code at {wrong:.0%} of the pixels",
            remedy="check whether the images are in their order, and `steps`, `period`, `start_deg` "
            "and `shift` right",
        )


def smooth_phase(s: Floats, sigma: Floats) -> tuple[Floats, Floats]:
    """Smooth s (L, P) by a quadratic fitted to 3 x 3 pixels; return it and its standard deviation.

    The fit removes only what changes from pixel to pixel both ways, which a lens blurs away on any
    surface. Where it would change s by more than four sigmas there is an edge: s is kept. Source:
    Savitzky and Golay, Analytical Chemistry 36 (1964), in two dimensions.
    """
    weights = np.array([[-1, 2, -1], [2, 5, 2], [-1, 2, -1]], np.float32) / np.float32(9.0)
    gain = np.float32(np.sqrt(np.sum(np.square(weights))))
    fitted = cv2.filter2D(s, cv2.CV_32F, weights, borderType=cv2.BORDER_CONSTANT)
    fitted[[0, -1]] = np.nan
    fitted[:, [0, -1]] = np.nan
    kept = np.abs(fitted - s) <= 4.0 * sigma
    return np.where(kept, fitted, s), np.where(kept, gain * sigma, sigma)


def decode_waves(
    images: Greys, waves: tuple[Wave, ...], lit: Greys, direction: str, stripes: int
) -> StripeMap:
    """Compute the stripe map from images (F, H, W) of waves of several periods; lit: (H, W).

    Raises DecodingFailed if the images are inconsistent.
    """
    transposed = direction == "horizontal"
    lines = transpose(images) if transposed else images
    each = sorted(zip(waves, split_waves(lines, waves), strict=True), key=lambda one: one[0].period)
    stacks = [stack for _, stack in each]
    measured = [measure_wave(stack, wave) for wave, stack in each]
    brightest = lines.max(axis=0)
    contrast = np.min([2.0 * wave.amplitude for wave in measured], axis=0)
    bright = contrast >= find_min_contrast(lines.dtype)
    variance = measure_wave_noise(measured, stacks, bright & (brightest < SATURATED))
    noise = np.sqrt(variance[np.clip(np.rint(measured[0].mean), 0, 255).astype(np.uint8)])
    bright = bright & (contrast >= np.float32(2.0 * MIN_CONTRAST_TO_NOISE) * noise)
    check_illumination(bright, brightest)
    good = bright & (brightest < SATURATED)
    uneven = _balance_waves(measured, stacks, good)
    flashed, parts = find_lit_part(stacks, measured, _list_references(measured), good)
    good &= ~flashed
    check_several_waves(measured, stacks, good, stripes)
    usable = good & ~find_half_covered_pixels(contrast, bright)
    corrected = _correct_waves(measured, usable, stripes)
    order = find_phase_order(corrected, [wave.sigma(noise) for wave in corrected], usable, stripes)
    check_agreement(order)
    halves = np.floor(2.0 * np.nan_to_num(order.s) / corrected[0].wave.period).astype(np.int32)
    check_direction(halves, order.certain, transposed)
    usable = order.certain & ~find_code_jumps(halves, order.certain)
    s = np.where(usable, order.s, np.float32(np.nan))
    s, sigma = smooth_phase(s, np.where(usable, order.sigma, np.float32(np.nan)))
    lit_all, unlit = (convert_like(grey, lines) for grey in estimate_white_and_black(measured))
    light = ScanLines(lit_all, unlit, lines[:0], None, transposed)
    result = assemble_from_pixels(light, lit, s, sigma, variance, stripes)
    flash = "; ".join((*uneven, *parts))
    return replace(result, correlation_px=(CORRELATION_PX, CORRELATION_PX), flash=flash)


def _balance_waves(waves: list[MeasuredWave], stacks: list[Greys], good: Mask) -> list[str]:
    """Balance the images of waves in place, each by white and black of the others; say which differ.

    The wave with the worst image goes first: by it the others seem wrong too.
    """
    notes = []
    for _ in waves[1:]:
        others = _list_references(waves)
        each = [
            estimate_gains(stack, wave, *reference, good)
            for stack, wave, reference in zip(stacks, waves, others, strict=True)
        ]
        errors = [np.abs(gains - [[1.0], [0.0]]).max() for gains in each]
        if not max(errors):
            break
        k = int(np.argmax(errors))
        stacks[k], waves[k] = balance_images(stacks[k], waves[k], *others[k], each[k])
        notes += describe_gains(each[k], waves[k].wave.period)
    return notes


def _list_references(waves: list[MeasuredWave]) -> list[tuple[Floats, Floats]]:
    """List black and contrast (L, P) for each wave, as the others show them."""
    others = [
        estimate_white_and_black(waves[:k] + waves[k + 1 :] or waves) for k in range(len(waves))
    ]
    return [(black, white - black) for white, black in others]


def _correct_waves(waves: list[MeasuredWave], usable: Mask, stripes: int) -> list[MeasuredWave]:
    """Correct waves, the finest first, for the projector's response."""
    errors = [estimate_error(wave, usable, stripes) for wave in waves]
    corrected = [correct_wave(*each) for each in zip(waves, errors, strict=True)]
    for k, wave in enumerate(corrected):
        if k and errors[k] is None:
            error = estimate_error_against(wave, corrected[0], usable, stripes)
            corrected[k] = correct_wave(wave, error)
    return corrected


def check_several_waves(
    waves: Sequence[MeasuredWave], images: Sequence[Greys], good: Mask, stripes: int
) -> None:
    """Raise DecodingFailed if an image is missing, taken twice or exposed differently: all waves
    have the same mean at each `good` pixel to 15 %, and no two images of a wave are the same."""
    if not good.any():
        return
    finest = waves[0]
    for wave, stack in zip(waves, images, strict=True):
        ratio = float(np.median(wave.mean[good] / finest.mean[good]))
        if abs(ratio - 1.0) > 0.15:
            raise DecodingFailed(
                f"the images of the wave of {wave.wave.period:g} stripes are on average {ratio:.2f} "
                f"times as bright as those of the wave of {finest.wave.period:g}",
                remedy="check whether one of them is missing, or was exposed differently",
            )
        if wave.wave.period * MIN_PERIODS <= stripes:  # on a small subject longer ones may be alike
            message = f"images {{}} and {{}} of the wave of {wave.wave.period:g} stripes look alike"
            strength = float(np.median(wave.amplitude[good]))
            _check_distinct(stack[:, good].astype(np.float32), strength, message)


def check_agreement(order: PhaseOrder) -> None:
    """Raise DecodingFailed if the waves of most pixels disagree, or begin at different s."""
    offset = max(order.offsets, key=abs, default=0.0)
    # The smallest wrong start, 30 degrees, gives 0.083 of the finest period for any whole ratio of
    # the waves' periods except 12 k + 1.
    if order.agreed >= 0.6 and abs(offset) < 0.06:
        return
    what = f"the phases of the waves agree at only {order.agreed:.0%} of the pixels"
    if order.agreed >= 0.6:
        what = f"the waves begin {offset:.2f} of a period apart"
    raise DecodingFailed(
        what,
        remedy="check whether the images are in their order and exposed alike, and `steps`, `period` "
        "or `periods`, `start_deg` (for waves written as sines -90) and `shift` right",
    )


@dataclass(frozen=True, eq=False)
class PhaseOrder:
    """s and its standard deviation (L, P), stripes, and where the order is `certain`.

    agreed: share of the pixels whose waves agree, among those whose order noise leaves decidable.
    offsets: median difference of each other wave from the finest, in turns of the finest.
    """

    s: Floats
    sigma: Floats
    certain: Mask
    agreed: float
    offsets: tuple[float, ...]


def find_phase_order(
    waves: Sequence[MeasuredWave], sigmas: Sequence[Floats], usable: Mask, stripes: int
) -> PhaseOrder:
    """Find s from waves (the finest first) and the sigmas (L, P) of their turns at `usable` pixels
    (L, P)."""
    periods = np.array([wave.wave.period for wave in waves])
    turns = np.stack([wave.turn[usable] for wave in waves])
    errors = np.stack([sigma[usable] for sigma in sigmas])
    some = slice(None, None, max(1, turns.shape[1] // 100_000))
    sample = turns[:, some], errors[:, some].copy()
    # Of waves without error the best order has a chi squared of 0.
    gap = find_best_orders(np.zeros_like(sample[0]), sample[1], periods, float(stripes))[2]
    decidable = gap >= 3.0 * MIN_GAIN
    orders, _, _ = find_best_orders(*sample, periods, float(stripes))
    errors *= _estimate_growth(*sample, periods, orders)[:, None]
    orders, best, second = find_best_orders(turns, errors, periods, float(stripes))
    residual, residual_sigma = _compute_residuals(turns, errors, periods, orders)
    agree = np.all(np.abs(residual) <= MAX_SIGMAS * residual_sigma, axis=0)
    decided = second - best >= MIN_GAIN
    s, sigma = _average_waves(turns, errors, periods, orders, residual)
    inside = (s > MAX_SIGMAS * sigma) & (s < stripes - MAX_SIGMAS * sigma)
    all_s, all_sigma = (np.full(usable.shape, np.nan, np.float32) for _ in range(2))
    all_s[usable], all_sigma[usable] = s, sigma
    certain = np.zeros(usable.shape, bool)
    certain[usable] = agree & decided & inside
    scaled = residual * (periods[1:, None] / periods[0])
    medians = np.median(scaled, axis=1).tolist() if scaled.size else [0.0] * len(scaled)
    judged = (agree & decided)[some]
    # On a dim background most pixels may be too noisy to decide; those do not count.
    judged = judged[decidable] if np.count_nonzero(decidable) >= MIN_PIXELS else judged
    agreed = float(np.mean(judged)) if judged.size else 0.0
    return PhaseOrder(all_s, all_sigma, certain, agreed, tuple(medians))


def _compute_residuals(
    turns: Floats, sigmas: Floats, periods: Array, orders: Indices
) -> tuple[Floats, Floats]:
    """Turns (W - 1, M) by which the other waves differ from where the finest predicts them, and
    their standard deviation."""
    ratio = (periods[0] / periods[1:, None]).astype(np.float32)
    residual = turns[1:] - (turns[0] + orders.astype(np.float32)) * ratio
    return residual - np.rint(residual), np.hypot(sigmas[1:], sigmas[0] * ratio)


def _estimate_growth(turns: Floats, sigmas: Floats, periods: Array, orders: Indices) -> Floats:
    """Factor (W,) by which each wave's sigma must grow to explain the residuals: the remainder of
    the projector's response, and indirect light, are not noise."""
    growth = np.ones(len(periods), np.float32)
    if turns.shape[1] >= MIN_PIXELS:
        residual, residual_sigma = _compute_residuals(turns, sigmas, periods, orders)
        ratio = np.median(np.abs(residual) / residual_sigma, axis=1) / 0.6745
        growth[1:] = np.maximum(ratio, 1.0)
    return growth


def _average_waves(
    turns: Floats, sigmas: Floats, periods: Array, orders: Indices, residual: Floats
) -> tuple[Floats, Floats]:
    """Weighted mean of s from the waves up to twice as long as the finest, and its standard
    deviation (M,); longer ones add more errors than they remove noise."""
    weights = 1.0 / np.square(sigmas * periods[:, None].astype(np.float32))
    weights[periods > 2.0 * periods[0]] = 0.0
    moved = np.sum(weights[1:] * residual * periods[1:, None].astype(np.float32), axis=0)
    total = np.sum(weights, axis=0)
    s = (turns[0] + orders) * periods[0] + moved / total
    return s.astype(np.float32), (1.0 / np.sqrt(total)).astype(np.float32)


@compiled
def find_best_orders(
    turns: Floats, sigmas: Floats, periods: Array, stripes: float
) -> tuple[Indices, Array, Array]:
    """Find the likeliest whole periods of the finest wave at M pixels, and chi squared of these and
    of the second best (M,). turns, sigmas: (W, M)."""
    count = turns.shape[1]
    orders = np.zeros(count, np.int64)
    best, second = np.full(count, np.inf), np.full(count, np.inf)
    ratios = periods[0] / periods
    for pixel in range(count):
        order, turn = 0, np.float64(turns[0, pixel])
        while (turn + order) * periods[0] < stripes:
            cost = 0.0
            for wave in range(1, periods.size):
                residual = turns[wave, pixel] - (turn + order) * ratios[wave]
                residual -= math.floor(residual + 0.5)
                variance = sigmas[wave, pixel] ** 2 + (sigmas[0, pixel] * ratios[wave]) ** 2
                cost += residual * residual / variance
            if cost < best[pixel]:
                second[pixel], best[pixel], orders[pixel] = best[pixel], cost, order
            elif cost < second[pixel]:
                second[pixel] = cost
            order += 1
    return orders, best, second
