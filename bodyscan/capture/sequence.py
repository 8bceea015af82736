"""Whether the frames of a stripe sequence add up, and if not, which frame is to blame."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from bodyscan.capture.gray_code import stripe_from_gray
from bodyscan.capture.stripe_images import SATURATED, StripeImages
from bodyscan.errors import DecodingFailed

Codes = NDArray[np.uint16]

STEP = 3
"""Only every third line and place is looked at where the whole picture is meant."""

MIN_CONTRAST = 4
MIN_SHARE_LIT = 1e-3
MAX_SHARE_SATURATED = 0.5
MIN_DIFFERENCE = 0.06
NOISE_GREY = 4
MAX_SUM_ERROR = 0.15
MAX_SHARE_BEYOND = 0.05
MIN_FLIPS = 50
WRONG_WAY = 2.0
MIN_SHARE_IN_STEP = 0.6
CONVINCING = 0.8
MAX_PAIRS = 100_000


def check_frames(
    lit: NDArray[np.uint8],
    dark: NDArray[np.uint8] | None,
    patterns: NDArray[np.uint8],
    inverses: NDArray[np.uint8],
    bits: int,
) -> None:
    """Raises DecodingFailed if there are too few or too many frames, or of different sizes."""
    for name, frames in (("patterns", patterns), ("inverses", inverses)):
        if len(frames) != bits:
            raise DecodingFailed(
                f"{len(frames)} {name}, but the code has {bits} bits",
                remedy="give one pattern and one inverse for each bit, or correct `stripes`",
            )
        if frames.shape[1:] != lit.shape:
            raise DecodingFailed(f"{name} of {frames.shape[1:]} px, lit frame of {lit.shape} px")
    if dark is not None and dark.shape != lit.shape:
        raise DecodingFailed(f"dark frame of {dark.shape} px, lit frame of {lit.shape} px")


def check_exposure(images: StripeImages) -> None:
    """Raises DecodingFailed for frames that are black, overexposed, or do not add up in light.

    Each pattern and its inverse together are as bright as the lit and the dark frame together,
    and most pixels are lit in only one of them.
    """
    lit, dark = (frame[::STEP, ::STEP].astype(np.int16) for frame in (images.lit, images.dark))
    seen = lit - dark >= MIN_CONTRAST
    if np.mean(dark - lit >= MIN_CONTRAST) > max(float(np.mean(seen)), MIN_SHARE_LIT):
        raise DecodingFailed(
            "the dark frame is brighter than the lit frame",
            remedy="see whether the names of the two are exchanged in the rig file",
        )
    if np.mean(seen) < MIN_SHARE_LIT:
        raise DecodingFailed(
            f"the projector lights only {np.mean(seen):.2%} of the picture",
            remedy="see whether the projector is on, and whether lit and dark frames differ",
        )
    saturated = np.mean(lit[seen] >= SATURATED)
    if saturated > MAX_SHARE_SATURATED:
        raise DecodingFailed(
            f"{saturated:.0%} of the lit pixels are saturated", remedy="expose for a shorter time"
        )
    bright = seen & (lit < SATURATED)
    bright &= lit - dark >= np.median((lit - dark)[bright])
    contrast = (lit - dark)[bright].astype(np.float32)
    both = (lit + dark)[bright]
    for bit in range(len(images.patterns)):
        pattern = images.patterns[bit, ::STEP, ::STEP][bright].astype(np.int16)
        inverse = images.inverses[bit, ::STEP, ::STEP][bright].astype(np.int16)
        if np.median(np.abs(pattern - inverse) / contrast) < MIN_DIFFERENCE:
            raise DecodingFailed(
                f"pattern and inverse of bit {bit} look alike",
                remedy="see whether one of the two frames is missing or was taken twice",
            )
        excess = np.maximum(np.abs(pattern + inverse - both) - NOISE_GREY, 0)
        error = np.mean(np.minimum(excess / contrast, 1.0))
        if error > MAX_SUM_ERROR:
            raise DecodingFailed(
                f"pattern and inverse of bit {bit} do not add up to the lit frame "
                f"(off by {error:.0%} of its contrast)",
                remedy="see whether one of the two frames is missing, belongs to another bit or "
                "was exposed differently",
            )


def check_codes(images: StripeImages, gray: Codes, stripes: int) -> None:
    """Raises DecodingFailed if neighbouring pixels do not lie in neighbouring stripes.

    gray: (L, P) code words as read. Where just one bit differs between two pixels, their stripes
    must be neighbours, whichever bit it is. An exchange of the coarsest pattern and its inverse
    turns the whole order round; it shows only in codes beyond the last stripe, and not at all if
    the stripes are a power of two.
    """
    bits = len(images.patterns)
    contrast = images.contrast
    lit = contrast >= MIN_CONTRAST
    # Darker pixels are misread too often by themselves to tell anything.
    good = lit & (contrast >= np.median(contrast[::STEP, ::STEP][lit[::STEP, ::STEP]]))
    one, other = _single_flips(gray, good)
    _check_direction(images, gray, good)
    words = gray[::STEP, ::STEP][good[::STEP, ::STEP]]
    in_step, beyond = _in_step(one, other, bits), _beyond(words, stripes)
    failing = [bit for bit, share in in_step.items() if share < MIN_SHARE_IN_STEP]
    if not failing and beyond <= MAX_SHARE_BEYOND:
        return
    found = [f"{beyond:.0%} of the codes lie beyond the last stripe"] if beyond > 0.01 else []
    if failing:
        names = ", ".join(str(bit) for bit in failing)
        found.append(f"where bit {names} flips, stripes do not follow each other")
    cause = next(_causes(one, other, words, bits, stripes), None)
    raise DecodingFailed(
        "the patterns do not make a stripe code: " + "; ".join(found or ["no order in them"]),
        remedy=f"it would fit if {cause}" if cause else "see whether frames are in their order",
    )


def _check_direction(images: StripeImages, gray: Codes, good: NDArray[np.bool_]) -> None:
    """Raises DecodingFailed if the stripes change from line to line rather than along lines."""
    flips = [
        np.count_nonzero((np.diff(gray, axis=axis) != 0) & _both(good, axis)) for axis in (0, 1)
    ]
    if flips[0] > WRONG_WAY * flips[1]:
        seen, said = ("vertical", "horizontal") if images.turned else ("horizontal", "vertical")
        raise DecodingFailed(
            f"the stripes run {seen}ly in the picture, not {said}ly",
            remedy=f"write `direction: {seen}` in the rig file if this camera stands so",
        )


def _both(good: NDArray[np.bool_], axis: int) -> NDArray[np.bool_]:
    """Whether neighbours along the axis are both good."""
    return good[1:] & good[:-1] if axis == 0 else good[:, 1:] & good[:, :-1]


def _single_flips(gray: Codes, good: NDArray[np.bool_]) -> tuple[Codes, Codes]:
    """Code words (N,) of neighbours along lines that differ in exactly one bit."""
    difference = gray[:, 1:] ^ gray[:, :-1]
    single = (difference != 0) & (difference & (difference - 1) == 0)
    single &= _both(good, 1)
    at = np.flatnonzero(single)
    at = at[:: max(1, len(at) // MAX_PAIRS)]
    line, place = np.divmod(at, single.shape[1])
    return gray[line, place], gray[line, place + 1]


def _in_step(one: Codes, other: Codes, bits: int) -> dict[int, float]:
    """For each bit that flips often enough: how often the stripes then are neighbours."""
    step = np.abs(stripe_from_gray(one) - stripe_from_gray(other))
    bit = bits - np.frexp((one ^ other).astype(np.float64))[1]
    flips = np.bincount(bit, minlength=bits)
    neighbours = np.bincount(bit, step == 1, minlength=bits)
    return {k: neighbours[k] / flips[k] for k in range(bits) if flips[k] >= MIN_FLIPS}


def _beyond(words: Codes, stripes: int) -> float:
    """Share of code words that no stripe has."""
    return float(np.mean(stripe_from_gray(words) >= stripes)) if words.size else 0.0


def _causes(one: Codes, other: Codes, words: Codes, bits: int, stripes: int) -> Iterator[str]:
    """What, undone, would make the code whole; the simplest first."""
    for cause, undo in _mistakes(bits):
        in_step = _in_step(undo(one), undo(other), bits)
        whole = bool(in_step) and min(in_step.values()) > CONVINCING
        if whole and _beyond(undo(words), stripes) <= MAX_SHARE_BEYOND:
            yield cause


def _mistakes(bits: int) -> Iterator[tuple[str, Callable[[Codes], Codes]]]:
    """Common mistakes with the frames, and how code words are changed to undo them."""
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
    """Words whose bit k is bit order[k] of the given ones; 0 the most significant."""
    bits = len(order)
    result = np.zeros_like(words)
    for target, source in enumerate(order):
        result |= ((words >> (bits - 1 - source)) & 1) << (bits - 1 - target)
    return result
