"""Where a Gray code changes in one bit along a scan line, with noise ruled out in the others."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from bodyscan.arrays import Floats, Greys, Indices, Mask
from bodyscan.compiled import compiled
from bodyscan.stripes.bit_clarity import CLEAR, FINE_BITS
from bodyscan.stripes.scan_lines import ScanLines

Words = NDArray[np.uint16]

MOST_OF_A_BIT = 2000
ENOUGH = 600_000
"""Lines are added until they hold so many pixels."""
BESIDE_PX = 4
RIM = 2.0
"""Brightness ratio of the two sides of a change that means a rim, behind which another surface may
show any stripe, or the edge of a print; changes there say nothing of the order of frames."""
EVERY = 61
"""Lines are taken this far apart, then those beside them,
so that a few represent the whole image."""


def clear_changes(
    images: ScanLines, words: Words, good: Mask, variance: Floats
) -> tuple[Words, Words, Words]:
    """Code words (N,) of good neighbours that differ in one bit, and a mask of finer bits to
    ignore.

    Noise may have flipped those; every coarser one is clear in both pixels, and so is the bit next
    finer than the one that flips. Only a sample is taken of each bit.

    words, good: (L, P).
    variance: (256,) of each grey level.
    """
    assert images.inverses is not None
    bits = len(images.patterns)
    found = np.empty((bits * MOST_OF_A_BIT, 3), np.uint16)
    lines = np.concatenate([np.arange(first, len(words), EVERY) for first in range(EVERY)])
    lines = lines[: 1 + ENOUGH // words.shape[1]]
    bright = cv2.subtract(images.lit, images.dark)
    frames = images.patterns, images.inverses
    count = _collect(words, good, bright, lines, *frames, CLEAR**2 * variance, found)
    one, other, doubt = np.ascontiguousarray(found[:count].T)
    return one, other, doubt


@compiled
def _collect(
    words: Words,
    good: Mask,
    bright: Greys,
    lines: Indices,
    patterns: Greys,
    inverses: Greys,
    least2: Floats,
    found: Words,
) -> int:
    bits, count = len(patterns), 0
    taken = np.zeros(bits, np.int64)
    for line in lines:
        for place in range(words.shape[1] - 1):
            flip = words[line, place] ^ words[line, place + 1]
            if flip == 0 or flip & (flip - 1) or not (good[line, place] and good[line, place + 1]):
                continue
            at = 0  # of the bit that flips, counted from the finest
            while flip >> (at + 1):
                at += 1
            if at == 0 or taken[at] == MOST_OF_A_BIT:
                continue
            end = 0  # bits below that one are ignored
            for bit in range(bits):
                height = bits - 1 - bit
                if height == at or height < end:
                    continue
                for beside in (place, place + 1):
                    seen, other = patterns[bit, line, beside], inverses[bit, line, beside]
                    step = np.float32(seen) - np.float32(other)
                    if step * step < least2[np.int64(seen)] + least2[np.int64(other)]:
                        end = max(end, height + 1)
            if end >= at or _is_rim(bright[line], place):
                continue
            if at >= FINE_BITS and not _lasts(
                words, patterns[bits - 1 - at], inverses[bits - 1 - at], least2, line, place, flip
            ):
                continue
            taken[at] += 1
            found[count, 0], found[count, 1] = words[line, place], words[line, place + 1]
            found[count, 2] = (1 << end) - 1
            count += 1
    return count


@compiled
def _is_rim(bright: Greys, place: int) -> bool:
    """Whether brightness changes too from `place` to the next along a line (P,)."""
    before = np.float32(bright[max(place - BESIDE_PX, 0)])
    after = np.float32(bright[min(place + 1 + BESIDE_PX, len(bright) - 1)])
    return bool(max(before, after) > RIM * min(before, after))


@compiled
def _lasts(
    words: Words,
    pattern: Greys,
    inverse: Greys,
    least2: Floats,
    line: int,
    place: int,
    flip: int,
) -> bool:
    """Whether a coarse bit is clear a little off its flip and unchanged since: where it is weak
    throughout, noise flips it to and fro."""
    for far, near in ((place - BESIDE_PX, place), (place + 1 + BESIDE_PX, place + 1)):
        if not 0 <= far < words.shape[1] or (words[line, far] ^ words[line, near]) & flip:
            return False
        seen, other = pattern[line, far], inverse[line, far]
        step = np.float32(seen) - np.float32(other)
        if step * step < least2[np.int64(seen)] + least2[np.int64(other)]:
            return False
    return True
