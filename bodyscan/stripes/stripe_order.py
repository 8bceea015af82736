"""Whether the stripes of neighbouring pixels are consecutive, for codes that number them
directly."""

from __future__ import annotations

from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from bodyscan.arrays import Mask
from bodyscan.errors import DecodingFailed
from bodyscan.stripes.sequence_checks import check_direction

Numbers = NDArray[np.signedinteger]

ENOUGH = 20
MIN_SHARE_IN_STEP = 0.6
DOUBTFUL = 0.8
OUT = 0.6
MOST_TRIED = 12
SELDOM = 0.05


def check_order(numbers: Numbers, good: Mask, turned: bool, stripes: int) -> None:
    """Raises DecodingFailed if neighbouring pixels are not in neighbouring stripes.

    numbers: (L, P) stripe of each pixel, 0 to stripes - 1, where it is `good`.
    """
    check_direction(numbers, good, turned)
    one, other = _changes(numbers, good)
    if len(one) < ENOUGH:
        return
    in_step = np.mean(np.abs(one - other) == 1)
    if in_step < MIN_SHARE_IN_STEP:
        raise DecodingFailed(
            f"where the stripe changes, neighbouring pixels show neighbouring stripes in {in_step:.0%}"
            " of the cases only",
            remedy="see whether the images are in their order",
        )
    gone = _gone(one, other, stripes)
    if len(gone):
        raise DecodingFailed(
            f"the image of stripe {', '.join(map(str, gone[:10]))} shows no line of its own, "
            "though those before and behind it do",
            remedy="see whether it is missing, or another was taken twice",
        )
    out = _out_of_step(one, other, stripes)
    exchanged = _exchanged(one, other, stripes, out)
    if exchanged:
        raise DecodingFailed(
            "the images do not make a sweep: neighbouring pixels do not show neighbouring stripes",
            remedy="it would fit if those of stripes {} and {} were exchanged".format(*exchanged),
        )


def _changes(numbers: Numbers, good: Mask) -> tuple[Numbers, Numbers]:
    """Stripes (N,) of neighbours along lines that differ."""
    line, place = np.nonzero((np.diff(numbers, axis=1) != 0) & good[:, 1:] & good[:, :-1])
    return numbers[line, place], numbers[line, place + 1]


def _gone(one: Numbers, other: Numbers, stripes: int) -> NDArray[np.intp]:
    """Stripes that no pixel shows, while many neighbours show those before and after."""
    shown = np.bincount(one, minlength=stripes) + np.bincount(other, minlength=stripes)
    leaps = np.abs(one - other) == 2
    across = np.bincount((one[leaps] + other[leaps]) // 2, minlength=stripes)
    return np.flatnonzero((across >= ENOUGH) & (shown < SELDOM * across))


def _in_step(
    one: Numbers, other: Numbers, stripes: int
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """How often each stripe has a neighbour, and how often that is one more or one less."""
    both, step = np.concatenate([one, other]), np.abs(one - other) == 1
    count = np.bincount(both, minlength=stripes)
    return count, np.bincount(both[np.tile(step, 2)], minlength=stripes)


def _out_of_step(one: Numbers, other: Numbers, stripes: int) -> list[int]:
    """Stripes whose neighbours are out of step, the worst first."""
    count, right = _in_step(one, other, stripes)
    share = right / np.maximum(count, 1)
    out = np.flatnonzero((count >= ENOUGH) & (share < DOUBTFUL))
    return [int(stripe) for stripe in out[np.argsort(share[out], kind="stable")]][:MOST_TRIED]


def _exchanged(
    one: Numbers, other: Numbers, stripes: int, out: list[int]
) -> tuple[int, int] | None:
    """Two stripes that are out of step as they are and in step when exchanged.

    A surface's rim is out of step as well, but not with the same two stripes everywhere.
    """
    for first, second in combinations(sorted(out), 2):
        pair, swapped = [first, second], np.arange(stripes)
        swapped[pair] = pair[::-1]
        count, right = _in_step(one, other, stripes)
        after = _in_step(swapped[one], swapped[other], stripes)[1]
        seen = count[pair].sum()
        if right[pair].sum() < OUT * seen and after[pair].sum() > DOUBTFUL * seen:
            return first, second
    return None
