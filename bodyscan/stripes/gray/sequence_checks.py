"""Checks that the frames of a sequence of bits are consistent."""

from __future__ import annotations

import math
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from bodyscan.arrays import Floats, Greys, Indices, Mask
from bodyscan.errors import DecodingFailed
from bodyscan.geometry.robust import SIGMAS_PER_MEDIAN
from bodyscan.stripes.gray.bit_words import WordCode
from bodyscan.stripes.scan_lines import ScanLines
from bodyscan.stripes.usable_pixels import SATURATED, check_direction, check_illumination

Codes = NDArray[np.uint16]

MIN_CONTRAST = 4
FINE_BITS = 3
"""The finest bits, which blur and noise may hide."""
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
    shares, levels, _ = _sample_shares(images)
    for bit, share in enumerate(shares["pattern"]):
        outside = np.maximum(np.abs(share - 0.5) - 0.5 - 4.0 / levels, 0.0)  # 4: noise
        error = float(np.mean(np.minimum(outside, 1.0)))
        # What is added moves boundaries by as much, in pixels, where light blurs by one.
        has_boundaries = 0.05 < float(np.mean(share > 0.5)) < 0.95
        every = np.ones(share.shape, bool)
        added = abs(_measure_added_light(share, share > 0.5, every)) if has_boundaries else 0.0
        if error > 0.15 or added > 0.1:
            raise DecodingFailed(
                f"the pattern of bit {bit} is brighter than the lit frame or darker than the dark "
                f"one (by {max(error, added):.0%} of their contrast)",
                remedy="check whether it was exposed as they were, and whether a flash or a lamp shone",
            )


def _sample_shares(images: ScanLines, more: int = 1) -> tuple[dict[str, Floats], Floats, Indices]:
    """Brightness (bits, N) of each "pattern" and "inverse", 0 as dark, 1 as lit, at some of the
    brighter half of the pixels, their contrast (N,), grey levels, and the blocks that they lie in,
    of 32 x 32. more: times the 50,000 pixels that are enough for the picture as a whole."""
    step = max(1, round(math.sqrt(images.lit.size / (50_000 * more))))
    some = (..., slice(None, None, step), slice(None, None, step))
    contrast = images.lit[some].astype(np.float32) - images.dark[some]
    bright = (contrast >= MIN_CONTRAST) & (images.lit[some] < SATURATED)
    bright &= contrast >= np.median(contrast[bright]) if bright.any() else False
    black, contrast = images.dark[some][bright].astype(np.float32), contrast[bright]
    frames = {"pattern": images.patterns, "inverse": images.inverses}
    taken = {name: stack for name, stack in frames.items() if stack is not None}
    shares = {name: (stack[some][:, bright] - black) / contrast for name, stack in taken.items()}
    line, x = (32 * at // n for at, n in zip(np.nonzero(bright), bright.shape, strict=True))
    return shares, contrast, 32 * line + x


def measure_nonlinearity(images: ScanLines) -> float:
    """Measure by how much half of the light is brighter than halfway between dark and lit, as a share
    of their contrast: 0 if grey levels are proportional to light, 0.46 with a video gamma of 2.2.

    Where pattern and inverse are equal each has half of the light: at the boundaries of the coarse
    bits, which blur widens. Median over the brighter half of the pixels; 0 without inverses.
    """
    if images.inverses is None:
        return 0.0
    shares, contrast, _ = _sample_shares(images)
    pattern, inverse = shares["pattern"][:5], shares["inverse"][:5]
    equal = (np.abs(pattern - inverse) < 0.2) & (contrast >= 20.0)
    found = (pattern + inverse - 1.0)[equal]
    return float(np.median(found)) if len(found) >= MIN_CHANGES else 0.0


def check_words(
    images: ScanLines, words: Codes, code: WordCode, stripes: int, variance: Floats
) -> None:
    """Raise DecodingFailed if frames are exchanged, lost or moved.

    words: (L, P) code words as read.
    variance: (256,) of each grey level.

    Where a code word changes from one pixel to the next, the stripes must be neighbours. An exchange
    of the coarsest pattern and its inverse shows only in codes beyond the last stripe.
    """
    fault = _find_fault(images, words, code, stripes, variance)
    if fault:
        raise DecodingFailed(
            f"frames do not form a valid code: swapped, missing or out of order ({fault})",
            remedy="check that frames are in their order, that none is missing or taken twice, that "
            "pattern and inverse lists are not exchanged, and that `stripes` and `first_code` are "
            "right; if the stripes are finer than camera or projector can show, project half as many",
        )


def _find_fault(
    images: ScanLines, words: Codes, code: WordCode, stripes: int, variance: Floats
) -> str:
    """Describe how the frames disagree, "" if they do not; raises WrongDirection."""
    bits, step = len(images.patterns), max(1, round(math.sqrt(images.lit.size / 50_000)))
    contrast = cv2.subtract(images.lit, images.dark)
    sample = contrast[::step, ::step]
    # Darker pixels are misread too often to be evidence.
    good = contrast >= np.median(sample[sample >= MIN_CONTRAST])
    some = (slice(None, None, 2 * step), slice(None, None, 2 * step))
    used = words[some][good[some]]
    if images.inverses is not None:
        pattern = images.patterns[:, *some][:, good[some]]
        inverse = images.inverses[:, *some][:, good[some]]
        if fault := _compare_pairs(pattern, inverse, variance):
            return fault
        used = used[_find_clear(pattern, inverse, variance)[: max(bits - FINE_BITS, 1)].all(axis=0)]
    # Noise flips the finest bits both along and across lines.
    coarse = words >> max(min(FINE_BITS, bits - FINE_BITS), 0)
    check_direction(coarse, good, images.transposed)
    shares = _share_in_step(images, words, good, code, variance)
    # In a right sequence light that varied between frames, and rims, put up to half of a coarse
    # bit's changes out of step, even where they are clear of noise.
    min_share = 0.75 if images.inverses is None else 0.5 if code.single else 0.6
    worst = min(shares, key=lambda bit: shares[bit], default=0)
    if shares and shares[worst] < min_share:
        return _find_repeated(images) or (
            f"where bit {worst} changes, only {shares[worst]:.0%} of neighbouring pixels are in "
            "neighbouring stripes"
        )
    numbers = code.stripes(used)
    beyond = float(np.mean((numbers < 0) | (numbers >= stripes))) if numbers.size else 0.0
    if beyond > 0.05:
        return f"{beyond:.0%} of the codes lie beyond the last stripe"
    if code.single and (repeated := _find_repeated(images)):
        return repeated
    opposite = _measure_folds(code.stripes(words[:: 2 * step]), good[:: 2 * step])
    if opposite > 0.15:
        return f"{opposite:.0%} of the pixels count stripes the other way, as without bit 0"
    return ""


def _find_repeated(images: ScanLines) -> str:
    """Describe two images of the code that are one image; "" if all differ. No two change at the same
    places in a Gray code; those that hardly change may be equal."""
    kinds, _, _ = _sample_shares(images)
    names = [f"{kind} of bit {bit}" for kind, shares in kinds.items() for bit in range(len(shares))]
    shares = np.concatenate(list(kinds.values()))[:, ::5]
    white, black = np.mean(shares > 0.75, axis=1), np.mean(shares < 0.25, axis=1)
    changing = np.flatnonzero(np.minimum(white, black) > 0.2)
    for k, one in enumerate(changing):
        for other in changing[k + 1 :]:
            if np.mean(np.abs(shares[one] - shares[other])) < 0.05:  # others differ by half
                return f"the {names[one]} and the {names[other]} are the same image"
    return ""


def replace_flashed(images: ScanLines) -> tuple[ScanLines, str]:
    """Make frames that some other light reached from their inverses, or inverses from their patterns;
    returns the images and which frames those are, "" if none.

    What is added to one frame of the two moves their boundaries, by as many hundredths of a pixel as of
    the contrast where light blurs by one. What a projector's optics do to fine stripes is done to both.
    """
    if images.inverses is None:
        return images, ""
    frames, found = {"pattern": images.patterns, "inverse": images.inverses}, []
    kinds, contrast, blocks = _sample_shares(images, 2)
    for bit in range(len(images.patterns) if contrast.size else 0):
        shares = {name: share[bit] for name, share in kinds.items()}
        white = shares["pattern"] > shares["inverse"]
        sum_errors = shares["pattern"] + shares["inverse"] - 1.0
        everywhere, typical = np.ones(len(blocks), bool), 0.0
        for part in (everywhere, _find_brighter_part(sum_errors, blocks)):
            added = float(np.median(sum_errors[part])) - typical if part.any() else 0.0
            light = {}
            for name, share in shares.items():
                colour = share > 0.5 if part.all() else white ^ (name == "inverse")
                light[name] = abs(_measure_added_light(share, colour, part))
            sound, flashed = sorted(light, key=lambda name: light[name])
            if abs(added) > 0.05 and light[sound] < 0.25 * abs(added) < light[flashed]:
                break
            typical = float(np.median(sum_errors))
        else:
            continue
        stack = frames[flashed] = frames[flashed].copy()
        grey = images.lit.astype(np.float32) + images.dark - frames[sound][bit]
        grey += typical * images.contrast
        stack[bit] = np.clip(grey, 0.0, 255.0).astype(stack.dtype)
        where = "all over" if part.all() else f"in {np.mean(part):.0%} of the picture"
        found.append(
            f"the {flashed} of bit {bit} is {abs(added):.0%} of the contrast "
            f"{'brighter' if added > 0.0 else 'darker'} than lit and dark image allow, {where}, as "
            f"with a flash or a lamp, and is made from its {sound}"
        )
    return replace(images, patterns=frames["pattern"], inverses=frames["inverse"]), "; ".join(found)


def _find_brighter_part(sum_errors: Floats, blocks: Indices) -> Mask:
    """Find the pixels (N,) in blocks where pattern and inverse together are brighter than elsewhere. Of
    people who move and skin that flickers the brightest hundredth has 0.05 of the contrast, and of a
    board 0.01; 0.08 moves boundaries by a twelfth of a pixel where light blurs by one."""
    count = np.maximum(np.bincount(blocks, minlength=32 * 32), 1)
    mean, square = (np.bincount(blocks, sum_errors**k, 32 * 32) / count for k in (1, 2))
    offset = mean - np.median(mean[blocks])
    # In dim blocks noise is larger; at the rims of what moves a few pixels alone are brighter, by much.
    noise = np.sqrt(np.maximum(square - mean**2, 0.0) / count)
    sigma = SIGMAS_PER_MEDIAN * float(np.median(np.abs(offset[blocks])))
    part = (offset > np.maximum(0.08, 5.0 * np.hypot(sigma, noise)))[blocks]
    enough = np.mean(part) >= 0.01 and np.median(sum_errors[part]) - np.median(sum_errors) >= 0.08
    return part & bool(enough)


def _measure_added_light(share: Floats, white: Mask, part: Mask) -> float:
    """Light that both what is white and what is black in a part of a frame (N,) has beyond 1 and 0, or
    beyond what it has elsewhere: the lesser. A projector or an exposure that flickers changes what is
    white alone; blur makes one brighter and the other darker: both give 0."""
    if not part.any():
        return 0.0
    white_share = float(np.mean(white[part]))  # medians of both, were they told apart by brightness
    levels = np.quantile(share[part], ((1.0 - white_share) / 2.0, 1.0 - white_share / 2.0))
    elsewhere = [share[~part & colour] for colour in (~white, white)]
    expected = np.array([np.median(one) if one.size else k for k, one in enumerate(elsewhere)])
    offsets = (levels - expected)[[white_share < 0.95, white_share > 0.05]]
    same_sign = bool(np.all(offsets > 0.0) or np.all(offsets < 0.0))
    return float(offsets[np.argmin(np.abs(offsets))]) if same_sign else 0.0


def _find_clear(patterns: Greys, inverses: Greys, variance: Floats) -> Mask:
    """Where noise alone cannot have decided a bit, for patterns and inverses of any equal shape."""
    noise2 = sum(variance[level.astype(np.uint8, copy=False)] for level in (patterns, inverses))
    difference = patterns.astype(np.float32) - inverses
    return np.asarray(np.square(difference) >= 4.0**2 * noise2)  # 4 sigmas


def _compare_pairs(patterns: Greys, inverses: Greys, variance: Floats) -> str:
    """Describe the coarsest pattern (bits, N) that looks like its inverse; "" if none does.

    Blur, indirect light and noise weaken fine patterns more than coarse ones: where a fine bit is
    clear, so is every coarser one, except at its boundaries. A pattern paired with another bit's
    inverse is as bright as that over half of the image.
    """
    bits, contrast = len(patterns), np.abs(patterns.astype(np.float32) - inverses)
    if contrast.shape[1] < 200:
        return ""
    clear, strong = (_find_clear(patterns, inverses, k * variance) for k in (1.0, 4.0))
    for bit in range(bits):
        if np.mean(contrast[bit] == 0.0) > 0.9 or (
            bit < bits - FINE_BITS and np.mean(clear[bit]) < 0.02
        ):
            return f"pattern and inverse of bit {bit} look alike"
        # Blurred stripes of the finest bit are a quarter as strong or less in a seventh of their
        # width (2 asin(1/4) / pi), next to their boundaries; coarser ones in half as much.
        finer = contrast[bit + 1 :].max(axis=0, initial=0.0)[strong[bit + 1 :].any(axis=0)]
        weak = contrast[bit][strong[bit + 1 :].any(axis=0)] < 0.25 * finer
        # Of the few that are clear in a dim picture noise chose those in which this bit is weak.
        share = np.mean(weak) if weak.size >= max(200, 0.1 * contrast.shape[1]) else 0.0
        if share > (0.35 if bit >= bits - FINE_BITS else 0.15):
            return f"bit {bit} is faint where finer ones are clear, in {share:.0%} of pixels"
    return ""


def _share_in_step(
    images: ScanLines, words: Codes, good: Mask, code: WordCode, variance: Floats
) -> dict[int, float]:
    """Compute for each bit the share of its changes along lines that lead to a neighbouring stripe.

    A change belongs to the coarsest bit that differs; bits with fewer than 50 changes are left out.
    In Gray code with inverses only changes count off rims, where the coarser bits and the next finer
    one are clear of noise. Finer bits are 0 next to a change and are taken for it where noise decides.
    """
    bits, contrast = len(images.patterns), images.contrast
    some = slice(None, None, 1 + words.size // 600_000)
    difference = words[some, 1:] ^ words[some, :-1]
    change = (difference != 0) & good[some, 1:] & good[some, :-1]
    if code.single:
        change &= difference & (difference - 1) == 0
    line, x = np.nonzero(change)
    bit = bits - np.frexp(difference[line, x].astype(np.float64))[1]
    shares = {}
    for k in range(bits):
        changes = np.flatnonzero(bit == k)
        changes = changes[:: 1 + len(changes) // 1000]
        pixels = line[changes] * some.step, x[changes] + np.array([[0], [1]])
        neighbours, masks = words[pixels], np.zeros(len(changes), np.uint16)
        if code.single and images.inverses is not None:
            pattern, inverse = images.patterns[:, *pixels], images.inverses[:, *pixels]
            clear = np.asarray(_find_clear(pattern, inverse, variance).all(axis=1))
            clear[k] = k < bits - 1  # any two words that differ in the finest bit are neighbours
            # Where the brightness doubles, the change may be a rim.
            sides = x[changes] + np.array([[-4], [5]])
            light = contrast[pixels[0], np.clip(sides, 0, words.shape[1] - 1)]
            known = clear[: k + 2].all(axis=0) & (light.max(axis=0) <= 2.0 * light.min(axis=0))
            finer = np.cumprod(clear[k + 1 :], axis=0).sum(axis=0)
            masks = ((1 << (bits - 1 - k - finer)) - 1).astype(np.uint16)
            neighbours, masks = neighbours[:, known], masks[known]
        if len(masks) >= MIN_CHANGES:
            first, second = code.stripes(neighbours & ~masks)
            shares[k] = float(np.mean(np.abs(first - second) == 1))
    return shares


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
