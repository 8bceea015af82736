"""Whether the frames of a stripe sequence are consistent, and if not, which frame is to blame."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from functools import partial
from itertools import combinations, islice
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from bodyscan.arrays import Floats, Greys, Indices, Mask
from bodyscan.compiled import compiled
from bodyscan.errors import DecodingFailed, WrongDirection
from bodyscan.stripes.bit_clarity import FINE_BITS, LitPairs, check_pairs, check_seen
from bodyscan.stripes.bit_words import WordCode
from bodyscan.stripes.clear_changes import clear_changes
from bodyscan.stripes.scan_lines import ScanLines
from bodyscan.stripes.usable_pixels import SATURATED

Codes = NDArray[np.uint16]

SAMPLES = 50_000
"""About how many pixels are examined to represent the whole image."""

MIN_CONTRAST = 4
MIN_SHARE_LIT = 1e-3
MAX_SHARE_SATURATED = 0.5
NOISE_GREY = 4
MAX_SUM_ERROR = 0.15
MAX_SHARE_BEYOND = 0.05
MIN_FLIPS = 50
WRONG_WAY = 2.0
MIN_SHARE_CLEAR = 0.5
"""Least share in step of one-bit changes that are free of noise. Wrong frames leave hardly any in
step; in a right sequence light that varied between frames, and rims, put up to a third of a coarse
bit's changes out of it."""
TREND_PX, TREND = 16, 3
"""Stripes gained over so many pixels without a jump: more than misread ones give."""
MIN_SHARE_IN_STEP, MIN_SHARE_WITHOUT_INVERSES = 0.6, 0.75
MAX_SHARE_FOLDED = 0.15
MOST_CAUSES = 3
CONVINCING = 0.8
ENOUGH = 200_000
"""Lines are added until they hold so many pixels, to compare neighbours along them."""


def check_exposure(images: ScanLines) -> None:
    """Raises DecodingFailed for frames that are black or overexposed.

    The sum of a pattern and its inverse is not checked: cameras and projectors are non-linear, so
    blurred patterns look brighter than sharp ones. Without an inverse, a pattern must nowhere be
    brighter than lit or darker than dark, or its threshold would be wrong.
    """
    step = _step(images)
    lit, dark = (frame[::step, ::step].astype(np.int16) for frame in (images.lit, images.dark))
    contrast = lit - dark
    seen = contrast >= MIN_CONTRAST
    if np.mean(contrast <= -MIN_CONTRAST) > max(float(np.mean(seen)), MIN_SHARE_LIT):
        raise DecodingFailed(
            "the dark frame is brighter than the lit frame",
            remedy="see whether the names of the two are exchanged in the rig file",
        )
    check_illumination(seen, lit)
    if images.inverses is not None:
        return
    bright = seen & (lit < SATURATED)
    bright &= contrast >= np.median(contrast[bright])
    line, place = np.nonzero(bright)
    at = step * (line * images.lit.shape[1] + place)
    frames = (images.lit.ravel(), images.dark.ravel())
    for bit, pattern in enumerate(images.patterns):
        _check_range(bit, _out_of_range(*frames, pattern.ravel(), at))


def _step(images: ScanLines) -> int:
    """Step from one examined line or place to the next."""
    return max(1, round(math.sqrt(images.lit.size / SAMPLES)))


def check_illumination(seen: Mask, lit: NDArray[Any]) -> None:
    """Raises DecodingFailed if the projector lights next to nothing, or most of it too brightly.

    seen: pixels that are lit.
    lit: how bright they are then, grey levels.
    """
    if np.mean(seen) < MIN_SHARE_LIT:
        raise DecodingFailed(
            f"the projector lights only {np.mean(seen):.2%} of the picture",
            remedy="see whether the projector is on, and whether lit and dark frames differ or one is "
            "missing, so that those behind it moved up",
        )
    saturated = np.mean(lit[seen] >= SATURATED)
    if saturated > MAX_SHARE_SATURATED:
        raise DecodingFailed(
            f"{saturated:.0%} of the lit pixels are saturated", remedy="expose for a shorter time"
        )


def _check_range(bit: int, error: float) -> None:
    """Raises DecodingFailed for too large an error. error: see `_out_of_range`."""
    if error > MAX_SUM_ERROR:
        raise DecodingFailed(
            f"the pattern of bit {bit} is brighter than the lit frame or darker than the dark one "
            f"(by {error:.0%} of their contrast)",
            remedy="see whether it was exposed as they were",
        )


@compiled
def _out_of_range(lit: Greys, dark: Greys, pattern: Greys, at: Indices) -> float:
    """Share of its contrast by which a pattern is brighter than the lit frame or darker than the
    dark one, at flat pixels (N,)."""
    error = 0.0
    for pixel in at:
        light, black, seen = float(lit[pixel]), float(dark[pixel]), float(pattern[pixel])
        excess = max(max(seen - light, black - seen) - NOISE_GREY, 0.0)
        error += min(excess / (light - black), 1.0)
    return error / at.size


def check_codes(
    images: ScanLines, words: Codes, code: WordCode, stripes: int, variance: Floats
) -> None:
    """Raises DecodingFailed if patterns and inverses are not of one bit, or neighbouring pixels are
    not in neighbouring stripes.

    words: (L, P) code words as read.
    variance: (256,) of each grey level.

    If just one bit of a Gray code differs between two pixels, their stripes must be neighbours,
    whichever bit it is; bits that noise may have flipped are excluded. A missing pattern may go
    unnoticed; then stripes count up and down along a line, which they must not. Exchanging the
    coarsest pattern and its inverse reverses the whole order; it shows only in codes beyond the
    last stripe, and not at all if all codes are in use.
    """
    bits = len(images.patterns)
    contrast = cv2.subtract(images.lit, images.dark)
    step = _step(images)
    some = slice(None, None, step)
    sampled = contrast[some, some]
    # Darker pixels are misread too often to say anything.
    good = contrast >= np.median(sampled[sampled >= MIN_CONTRAST])
    some = slice(None, None, 2 * step)
    shown, pairs = good[some, some], None
    seen = words[some, some][shown]
    if images.inverses is not None:
        patterns, inverses = images.patterns[:, some, some], images.inverses[:, some, some]
        pairs = LitPairs.of(patterns[:, shown], inverses[:, shown], variance)
        check_seen(pairs)
        seen = seen[pairs.coarse_clear]
    # Noise flips the finest bits both along and across lines.
    check_direction(words >> max(min(FINE_BITS, bits - FINE_BITS), 0), good, images.turned)
    if images.inverses is None or not code.single:
        lines = slice(None, None, max(1, words.size // ENOUGH))
        one, other = _changes(words[lines], good[lines], code)
        in_step = _in_step(one, other, code, bits)
        least = MIN_SHARE_IN_STEP if images.inverses is not None else MIN_SHARE_WITHOUT_INVERSES
    else:
        one, other, doubt = clear_changes(images, words, good, variance)
        kept = ~doubt
        in_step, least = _in_step(one & kept, other & kept, code, bits), MIN_SHARE_CLEAR
        one, other = one[doubt == 0], other[doubt == 0]
    failing = [bit for bit, share in in_step.items() if share < least]
    beyond = _beyond(seen, code, stripes)
    wrong = bool(failing) or beyond > MAX_SHARE_BEYOND
    tried = _causes(one, other, seen, code, bits, stripes) if wrong else ()
    causes = list(islice(tried, MOST_CAUSES))
    if pairs is not None and not causes:
        check_pairs(pairs)
    if not wrong:
        _check_folds(code.stripes(words[some]), good[some])
        return
    found = [f"{beyond:.0%} of the codes lie beyond the last stripe"] if beyond > 0.01 else []
    if failing:
        names = ", ".join(str(bit) for bit in failing)
        found.append(f"where bit {names} flips, stripes do not follow each other")
    raise DecodingFailed(
        "the patterns do not make a stripe code: " + "; ".join(found or ["no order in them"]),
        remedy="it would fit if " + ", or if ".join(causes)
        if causes
        else "see whether frames are in their order, whether the first bit is missing among them, and "
        "whether `stripes` and `first_code` are right",
    )


def _check_folds(stripes: NDArray[np.int32], good: Mask) -> None:
    """Raises DecodingFailed if stripes (L, P) count up and down: some pattern then shows no
    stripes.

    Along a line of any camera they count one way on everything that both camera and projector see.
    """
    leaps = np.cumsum(np.abs(np.diff(stripes, axis=1)) > 1, axis=1)
    step = stripes[:, TREND_PX + 1 :] - stripes[:, 1:-TREND_PX]
    whole = leaps[:, TREND_PX:] == leaps[:, :-TREND_PX]
    told = whole & (np.abs(step) >= TREND) & good[:, TREND_PX + 1 :] & good[:, 1:-TREND_PX]
    up, down = np.count_nonzero(step[told] > 0), np.count_nonzero(step[told] < 0)
    if min(up, down) > max(MAX_SHARE_FOLDED * (up + down), MIN_FLIPS):
        raise DecodingFailed(
            "the patterns do not make a stripe code: stripes count up and down in turn",
            remedy="see whether the pattern of bit 0 is missing or another one's stands in for it",
        )


def check_direction(numbers: NDArray[Any], good: Mask, turned: bool) -> None:
    """Raises WrongDirection if stripes change from line to line rather than along lines.

    numbers: (L, P) code words or stripes.
    turned: see `ScanLines`.
    """
    flips = [
        np.count_nonzero((np.diff(numbers, axis=axis) != 0) & _both(good, axis)) for axis in (0, 1)
    ]
    if flips[0] > WRONG_WAY * flips[1]:
        seen, said = ("vertical", "horizontal") if turned else ("horizontal", "vertical")
        raise WrongDirection(
            f"the stripes run {seen}ly in the picture, not {said}ly",
            remedy=f"write `direction: {seen}` in the rig file if this camera stands so; with "
            "`crossing`, see first whether its frames and the others are exchanged",
        )


def _both(good: Mask, axis: int) -> Mask:
    """Whether neighbours along the axis are both good."""
    return good[1:] & good[:-1] if axis == 0 else good[:, 1:] & good[:, :-1]


def _changes(words: Codes, good: Mask, code: WordCode) -> tuple[Codes, Codes]:
    """Code words (N,) of neighbours along lines that differ, for a Gray code in just one bit."""
    difference = words[:, 1:] ^ words[:, :-1]
    changes = (difference != 0) & _both(good, 1)
    if code.single:
        changes &= difference & (difference - 1) == 0
    line, place = np.nonzero(changes)
    return words[line, place], words[line, place + 1]


def _in_step(one: Codes, other: Codes, code: WordCode, bits: int) -> dict[int, float]:
    """For each bit that flips often enough (the coarsest, if several do): the share of flips
    between neighbouring stripes."""
    step = np.abs(code.stripes(one) - code.stripes(other))
    bit = bits - np.frexp((one ^ other).astype(np.float64))[1]
    flips = np.bincount(bit, minlength=bits)
    neighbours = np.bincount(bit, step == 1, minlength=bits)
    return {k: neighbours[k] / flips[k] for k in range(bits) if flips[k] >= MIN_FLIPS}


def _beyond(words: Codes, code: WordCode, stripes: int) -> float:
    """Share of code words that belong to no stripe."""
    if not words.size:
        return 0.0
    found = code.stripes(words)
    return float(np.mean((found < 0) | (found >= stripes)))


def _causes(
    one: Codes, other: Codes, words: Codes, code: WordCode, bits: int, stripes: int
) -> Iterator[str]:
    """Mistakes that, undone, would make the code consistent; the simplest first."""
    for cause, undo in _mistakes(bits):
        in_step = _in_step(undo(one), undo(other), code, bits)
        whole = bool(in_step) and min(in_step.values()) > CONVINCING
        if whole and _beyond(undo(words), code, stripes) <= MAX_SHARE_BEYOND:
            yield cause


def _mistakes(bits: int) -> Iterator[tuple[str, Callable[[Codes], Codes]]]:
    """Common mistakes with the frames, and how to change code words to undo them."""
    for bit in range(bits):
        mask = np.uint16(1 << (bits - 1 - bit))
        yield f"pattern and inverse of bit {bit} were exchanged", partial(np.bitwise_xor, mask)
    everything = np.uint16((1 << bits) - 1)
    yield "all patterns and inverses were exchanged", partial(np.bitwise_xor, everything)
    in_order = list(range(bits))
    yield "the bits came in reverse order", partial(_reordered, in_order[::-1])
    for first, second in combinations(range(bits), 2):
        order = in_order.copy()
        order[first], order[second] = second, first
        yield f"bits {first} and {second} were exchanged", partial(_reordered, order)


def _reordered(order: list[int], words: Codes) -> Codes:
    """Words whose bit k is bit order[k] of the given ones; 0 is the most significant."""
    bits = len(order)
    result = np.zeros_like(words)
    for target, source in enumerate(order):
        result |= ((words >> (bits - 1 - source)) & 1) << (bits - 1 - target)
    return result
