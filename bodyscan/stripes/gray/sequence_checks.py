"""Checks that the frames of a sequence of bits are consistent."""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from bodyscan.arrays import Floats, Greys, Mask
from bodyscan.errors import DecodingFailed
from bodyscan.stripes.gray.bit_words import WordCode
from bodyscan.stripes.scan_lines import ScanLines
from bodyscan.stripes.usable_pixels import SATURATED, check_direction, check_illumination

Codes = NDArray[np.uint16]

MIN_CONTRAST = 4
FINE_BITS = 3
"""The finest bits, which blur and noise may hide."""
CLEAR_SIGMAS = 4.0
"""Sigmas of pattern minus inverse beyond which noise alone cannot have decided a bit."""
MIN_CHANGES = 50


def check_exposure(images: ScanLines) -> None:
    """Raise DecodingFailed for frames that are black or overexposed, or, without inverses, for a
    pattern brighter than lit or darker than dark, whose threshold would be wrong."""
    step = max(1, round(math.sqrt(images.lit.size / 50_000)))  # that many pixels are enough
    some = (slice(None, None, step), slice(None, None, step))
    lit, dark = images.lit[some].astype(np.int16), images.dark[some].astype(np.int16)
    contrast = lit - dark
    bright = contrast >= MIN_CONTRAST
    if np.mean(contrast <= -MIN_CONTRAST) > max(float(np.mean(bright)), 1e-3):
        raise DecodingFailed(
            "the dark frame is brighter than the lit frame",
            remedy="check whether the names of the two are exchanged in the rig file",
        )
    check_illumination(bright, lit)
    if images.inverses is not None:
        return
    bright &= lit < SATURATED
    bright &= contrast >= np.median(contrast[bright])
    light, black = (image[some][bright].astype(float) for image in (images.lit, images.dark))
    for bit, pattern in enumerate(images.patterns):
        level = pattern[some][bright].astype(float)
        outside = np.maximum(np.maximum(level - light, black - level) - 4.0, 0.0)  # 4: noise
        error = float(np.mean(np.minimum(outside / (light - black), 1.0)))
        if error > 0.15:
            raise DecodingFailed(
                f"the pattern of bit {bit} is brighter than the lit frame or darker than the dark "
                f"one (by {error:.0%} of their contrast)",
                remedy="check whether it was exposed as they were",
            )


def check_words(
    images: ScanLines, words: Codes, code: WordCode, stripes: int, variance: Floats
) -> None:
    """Raise DecodingFailed if frames are exchanged, lost or moved.

    words: (L, P) code words as read.
    variance: (256,) of each grey level.

    Where a code word changes from one pixel to the next, the stripes must be neighbours. An exchange
    of the coarsest pattern and its inverse shows only in codes beyond the last stripe.
    """
    bits, step = len(images.patterns), max(1, round(math.sqrt(images.lit.size / 50_000)))
    contrast = cv2.subtract(images.lit, images.dark)
    sample = contrast[::step, ::step]
    # Darker pixels are misread too often to be evidence.
    good = contrast >= np.median(sample[sample >= MIN_CONTRAST])
    some = (slice(None, None, 2 * step), slice(None, None, 2 * step))
    used = words[some][good[some]]
    if images.inverses is not None:
        patterns, inverses = images.patterns[:, *some], images.inverses[:, *some]
        used = used[_check_pairs(patterns[:, good[some]], inverses[:, good[some]], variance)]
    # Noise flips the finest bits both along and across lines.
    coarse = words >> max(min(FINE_BITS, bits - FINE_BITS), 0)
    check_direction(coarse, good, images.transposed)
    shares = _share_in_step(images, words, good, code, variance)
    # In a right sequence light that varied between frames, and rims, put up to half of a coarse
    # bit's changes out of step, even where they are clear of noise.
    min_share = 0.75 if images.inverses is None else 0.5 if code.single else 0.6
    worst = min(shares, key=lambda bit: shares[bit], default=0)
    numbers, fault = code.stripes(used), ""
    beyond = float(np.mean((numbers < 0) | (numbers >= stripes))) if numbers.size else 0.0
    if shares and shares[worst] < min_share:
        fault = f"where bit {worst} changes, only {shares[worst]:.0%} of neighbouring pixels"
        fault += " are in neighbouring stripes"
    elif beyond > 0.05:
        fault = f"{beyond:.0%} of the codes lie beyond the last stripe"
    else:
        opposite = _measure_folds(code.stripes(words[:: 2 * step]), good[:: 2 * step])
        if opposite > 0.15:
            fault = f"{opposite:.0%} of the pixels count stripes the other way, as without bit 0"
    if fault:
        raise DecodingFailed(
            f"the patterns do not make a stripe code: frames are exchanged, lost or moved ({fault})",
            remedy="check that frames are in their order, that none is missing or taken twice, that "
            "pattern and inverse lists are not exchanged, and that `stripes` and `first_code` are "
            "right",
        )


def _check_pairs(patterns: Greys, inverses: Greys, variance: Floats) -> Mask:
    """Raise DecodingFailed if a pattern (bits, N) and its inverse are not of one bit, or not visible.

    Blur, indirect light and noise weaken fine patterns more than coarse ones: where a fine bit is
    clear, so is every coarser one, except at its boundaries. A pattern paired with another bit's
    inverse is as bright as that over half of the image.

    Returns where noise decided none but the finest bits, (N,).
    """
    bits = len(patterns)
    contrast = np.abs(patterns.astype(np.float32) - inverses)
    levels = (each.astype(np.uint8, copy=False) for each in (patterns, inverses))
    sigma = np.sqrt(sum(variance[level] for level in levels))
    clear = contrast >= CLEAR_SIGMAS * sigma
    shares = clear.mean(axis=1) if contrast.shape[1] >= 200 else ()
    for bit, share in enumerate(shares):
        blurred = bit >= bits - FINE_BITS and _is_even_grey(patterns, inverses, bit)
        if share < 0.02 and not blurred:
            raise DecodingFailed(
                f"pattern and inverse of bit {bit} look alike: they differ in {share:.1%} of the lit "
                "pixels",
                remedy="check whether one of the two is missing or was taken twice; if the stripes "
                "are finer than camera or projector can show, leave the finest bit out (half the "
                "stripes)",
            )
    if contrast.shape[1] >= 200:
        _check_finest(patterns, inverses, contrast)
    finer, strong, wrong = contrast[-1], contrast[-1] >= 8.0 * sigma[-1], ""
    for bit in range(bits - 2, -1, -1):
        # Blurred stripes of the finest bit are a quarter as strong or less in a seventh of their
        # width (2 asin(1/4) / pi), next to their boundaries; coarser ones in half as much.
        weak = contrast[bit][strong] < 0.25 * finer[strong]
        max_share = 0.35 if bit >= bits - FINE_BITS else 0.15
        if weak.size >= 200 and np.mean(weak) > max_share:
            wrong = f"bit {bit} ({np.mean(weak):.0%} of the pixels)"
        finer = np.maximum(finer, contrast[bit])
        strong = strong | (contrast[bit] >= 8.0 * sigma[bit])
    if wrong:  # the coarsest: frames behind it may have moved up
        raise DecodingFailed(
            f"pattern and inverse look alike where finer ones differ clearly: {wrong}",
            remedy="check whether a frame is missing, so that those behind it moved up, or stands in "
            "another's place",
        )
    return np.asarray(clear[: max(bits - FINE_BITS, 1)].all(axis=0))


def _check_finest(patterns: Greys, inverses: Greys, contrast: Floats) -> None:
    """Raise DecodingFailed if the finest pattern is brighter or darker than its inverse nearly
    everywhere, and a coarser one is not."""
    coarse = max(len(patterns) - 1 - FINE_BITS, 0)
    bright, coarse_bright = (np.mean(patterns[bit] > inverses[bit]) for bit in (-1, coarse))
    distinct = np.median(contrast[-1]) > 0.25 * np.median(contrast.max(axis=0))
    if distinct and abs(coarse_bright - 0.5) < 0.35 <= abs(bright - 0.5):
        raise DecodingFailed(
            f"the finest pattern is {'brighter' if bright > 0.5 else 'darker'} than its inverse "
            "nearly everywhere",
            remedy="check whether one of the two is missing, or another image stands in for it",
        )


def _is_even_grey(patterns: Greys, inverses: Greys, bit: int) -> bool:
    """Whether a pattern is an even grey between the darkest and the brightest that each pixel
    sees: too fine for projector or lens. A pattern used as its own inverse is not, or exactly
    equal to it."""
    if np.mean(patterns[bit] == inverses[bit]) > 0.9:
        return False
    low = np.minimum(patterns, inverses).min(axis=0).astype(np.float32)
    high = np.maximum(patterns, inverses).max(axis=0)
    level = (patterns[bit] - low) / np.maximum(high - low, 1.0)
    first, middle, third = np.percentile(level, [25, 50, 75])
    return bool(third - first < 0.3 < middle < 1.0)


def _share_in_step(
    images: ScanLines, words: Codes, good: Mask, code: WordCode, variance: Floats
) -> dict[int, float]:
    """Compute for each bit the share of its changes along lines that lead to a neighbouring stripe.

    A change belongs to the coarsest bit that differs; bits with fewer than 50 changes are left out.
    In Gray code with inverses only changes that are clear of noise count.
    """
    bits = len(images.patterns)
    some = slice(None, None, 1 + words.size // 600_000)
    difference = words[some, 1:] ^ words[some, :-1]
    change = (difference != 0) & good[some, 1:] & good[some, :-1]
    if code.single:
        change &= difference & (difference - 1) == 0
    line, x = np.nonzero(change)
    bit = bits - np.frexp(difference[line, x].astype(np.float64))[1]
    line *= some.step
    shares = {}
    for k in range(bits):
        changes = np.flatnonzero(bit == k)
        changes = changes[:: 1 + len(changes) // 1000]
        here, masks = (line[changes], x[changes]), np.zeros(len(changes), np.uint16)
        if code.single and images.inverses is not None:
            clear, masks = _find_clear_changes(images, words, *here, k, variance)
            here, masks = (here[0][clear], here[1][clear]), masks[clear]
        if len(masks) >= MIN_CHANGES:
            first, second = words[here] & ~masks, words[here[0], here[1] + 1] & ~masks
            steps = np.abs(code.stripes(first) - code.stripes(second))
            shares[k] = float(np.mean(steps == 1))
    return shares


def _find_clear_changes(
    images: ScanLines,
    words: Codes,
    line: NDArray[np.intp],
    x: NDArray[np.intp],
    bit: int,
    variance: Floats,
) -> tuple[Mask, Codes]:
    """Find changes of a bit between pixels (N,) and the next ones that are clear of noise and rims.

    Every coarser bit and the next finer one must be clear in both pixels; a coarse bit also clear
    and unchanged 4 px to either side. Where the brightness doubles, the change may be a rim. Also
    returns masks (N,) of the finer bits that noise may have flipped.
    """
    patterns, inverses = images.patterns, images.inverses
    assert inverses is not None
    bits, last = len(patterns), words.shape[1] - 1

    def is_clear(k: int, at: NDArray[np.intp]) -> Mask:
        pattern, inverse = patterns[k][line, at], inverses[k][line, at]
        noise = variance[pattern.astype(np.uint8)] + variance[inverse.astype(np.uint8)]
        step = pattern.astype(np.float32) - inverse.astype(np.float32)
        return np.asarray(np.square(step) >= CLEAR_SIGMAS**2 * noise)

    left, right = np.maximum(x - 4, 0), np.minimum(x + 5, last)
    sides = [
        np.maximum(images.lit[line, k].astype(np.float32) - images.dark[line, k], 0.0)
        for k in (left, right)
    ]
    clear = np.maximum(*sides) <= 2.0 * np.minimum(*sides)
    masks = np.zeros(len(line), np.uint16)
    for k in range(bits):
        if k != bit:
            unclear = ~(is_clear(k, x) & is_clear(k, x + 1))
            if k <= bit + 1:
                clear &= ~unclear
            else:
                masks = np.where(unclear & (masks == 0), np.uint16((1 << (bits - k)) - 1), masks)
    if bit == bits - 1:
        clear[:] = False  # any two words that differ in the finest bit are neighbours
    elif bit < bits - FINE_BITS:
        mask = np.uint16(1 << (bits - 1 - bit))
        clear &= (x >= 4) & (x + 5 <= last) & is_clear(bit, left) & is_clear(bit, right)
        for near, far in ((x, left), (x + 1, right)):
            clear &= (words[line, near] ^ words[line, far]) & mask == 0
    return clear, masks


def _measure_folds(stripes: NDArray[np.int32], good: Mask) -> float:
    """Share of the pixels along whose lines stripes (L, P) count against the others' direction."""
    reach = 16
    jumps = np.cumsum(np.abs(np.diff(stripes, axis=1)) > 1, axis=1)
    gain = stripes[:, reach + 1 :] - stripes[:, 1:-reach]
    whole = jumps[:, reach:] == jumps[:, :-reach]
    # More than two stripes over 16 pixels without a jump: more than misread pixels give.
    known = whole & (np.abs(gain) >= 3) & good[:, reach + 1 :] & good[:, 1:-reach]
    up, down = np.count_nonzero(gain[known] > 0), np.count_nonzero(gain[known] < 0)
    return min(up, down) / (up + down) if min(up, down) > MIN_CHANGES else 0.0
