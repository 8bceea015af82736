"""Codes whose images number the stripes directly: a line of light, and the stripe-index image.

A line of light is swept over the scene, one image per stripe. At a pixel with stripe coordinate s the
light comes and goes over the images. The part of it that comes in images i and later is, whatever the
line's width and blur sigma,

    (1 + erf((s - i) / (sqrt(2) sigma))) / 2.

With z_i = (s - i) / sigma from the inverse of that, for the boundaries k and k + 1 on both sides of
the brightest image k, s = k + z_k / (z_k - z_(k+1)). Sigma drops out; a parabola through the
logarithms of three images would require a Gaussian line. If stripes are much wider than the blur,
that determines little in their middle, and s comes from the boundaries on both sides.

A laser's one line, which is not swept, is sought along each row that crosses it: its middle, where
s = 0, is its light's centre of gravity.

In a stripe-index image luminance n, 1 to 254, is the number of stripe n - 1 here (s lies between
n - 1 and n); 0 and 255 mean none.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from bodyscan.arrays import Floats, Greys, Mask
from bodyscan.errors import DecodingFailed
from bodyscan.geometry.robust import estimate_robust_scale
from bodyscan.stripes.boundaries import MIN_SIGMA_PX, Boundaries
from bodyscan.stripes.scan_lines import ScanLines
from bodyscan.stripes.stripe_coordinates import interpolate_stripes
from bodyscan.stripes.stripe_map import (
    StripeMap,
    assemble_from_pixels,
    assemble_map,
    find_whole_numbers,
)
from bodyscan.stripes.usable_pixels import (
    MIN_CONTRAST,
    MIN_CONTRAST_TO_NOISE,
    SATURATED,
    check_direction,
    check_illumination,
    find_code_jumps,
    find_half_covered_pixels,
)

Numbers = NDArray[np.signedinteger]

REACH = 3
"""Images before and after the brightest in which its light may be seen."""
SAMPLES = 15
"""Images from which the base level and its noise are measured."""
MAX_SHARE = 0.99
UNIFORM_SIGMA = 12.0**-0.5
"""Standard deviation of a position known to be within one pixel, or of s within one stripe."""


def decode_sweep(lit: Greys, frames: Greys, direction: str) -> StripeMap:
    """Compute the stripe map of a swept line from images (stripes, H, W), most dark at a pixel.

    lit: (H, W). Raises DecodingFailed if the images are inconsistent.
    """
    stripes = len(frames)
    lines, flashed = _blank_flashed(ScanLines.from_images(lit, lit, frames, None, direction))
    sweep = _Sweep.from_frames(lines.patterns)
    base_noise2 = sweep.base_noise2(lines.patterns)
    rise = sweep.noise_rise(lines.lit, base_noise2)
    noise = np.sqrt(base_noise2 + rise * sweep.height)
    bright = sweep.height >= np.maximum(MIN_CONTRAST, MIN_CONTRAST_TO_NOISE * noise)
    check_illumination(bright, np.where(bright, sweep.height + sweep.base, 0))
    usable = bright & (sweep.height + sweep.base < SATURATED)
    for number in flashed:
        usable &= np.abs(sweep.peak - number) > REACH
    check_order(sweep.peak, usable, lines.transposed, stripes)
    # A second peak of 0.3 of the first may be light by way of another surface, or a second surface.
    usable &= sweep.second < np.maximum(0.3 * sweep.height, MIN_CONTRAST_TO_NOISE * noise)
    usable &= (sweep.peak > 0) & (sweep.peak < stripes - 1)
    usable &= ~find_half_covered_pixels(sweep.total, bright) & ~find_code_jumps(sweep.peak, usable)
    s, sigma = sweep.coordinates(base_noise2, rise)
    s[~usable] = np.nan
    sigma[~usable] = np.nan
    grey = np.arange(256, dtype=np.float32)
    variance = base_noise2 + rise * np.maximum(grey - np.median(sweep.base), 0.0)
    whole = np.clip(sweep.total + sweep.base, 0, 255).astype(np.uint8)
    images = ScanLines(whole, sweep.base.astype(np.uint8), lines.patterns, None, lines.transposed)
    variance = variance.astype(np.float32)
    found = assemble_from_pixels(images, lit, s, sigma, variance, stripes, codes=sweep.peak)
    named = ", ".join(map(str, flashed))
    flash = (
        f"other light reached the image of stripe {named}, as of a flash or a lamp: it is not used"
    )
    return replace(found, flash=flash if flashed else "")


def _blank_flashed(lines: ScanLines) -> tuple[ScanLines, list[int]]:
    """Replace images that other light reached by what is seen without the line; also return which. Away
    from its line such an image is brighter than others; where the line fills half of what is lit, those
    before and after are as bright. Raises DecodingFailed for one that is brighter than lit."""
    every = max(1, len(lines.patterns) // SAMPLES)
    reached = lines.lit >= np.median(lines.lit)
    level = np.array([np.median(frame[reached]) for frame in lines.patterns], float)
    if level.max() > np.median(lines.lit[reached]) + MIN_CONTRAST:
        raise DecodingFailed(
            f"the image of stripe {level.argmax()} is brighter than lit all over",
            remedy="check whether the two are exchanged, or other light reached it",
        )
    level = np.pad(level - np.median(level), 1)
    neighbour = np.maximum(level[2:], level[:-2])
    flashed = np.flatnonzero((level[1:-1] > MIN_CONTRAST) & (neighbour < 0.5 * level[1:-1]))
    if not flashed.size:
        return lines, []
    patterns = lines.patterns.copy()
    patterns[flashed] = np.median(patterns[::every], axis=0).astype(patterns.dtype)
    return replace(lines, patterns=patterns), flashed.tolist()


def decode_line(lit: Greys, frame: Greys, direction: str) -> StripeMap:
    """Compute the stripe map of one line of light: its middle is boundary 0, with s = 0 at its pixel.

    lit: (H, W), the scene without the line, or the image of the line if there is no other.
    frame: (1, H, W), the image of the line.

    Raises DecodingFailed if fewer than 20 rows show one line.
    """
    lines = ScanLines.from_images(lit, lit, frame, None, direction)
    light = lines.patterns[0].astype(np.float32)
    room = lines.lit * np.float32(not np.array_equal(lit, frame[0]))
    visible = room >= MIN_CONTRAST
    if visible.any():  # the room may have been darker while the line was on
        light -= room * np.median(light[visible] / room[visible])
    light -= np.median(light, axis=1, keepdims=True)
    noise = estimate_robust_scale(light, UNIFORM_SIGMA)
    peak, height = light.argmax(axis=1), light.max(axis=1)
    bright = height >= max(MIN_CONTRAST, 2.0 * MIN_CONTRAST_TO_NOISE * noise)
    half = np.count_nonzero(2.0 * light >= height[:, None], axis=1)
    # A bell ends 1.5 times its width at half its height from its middle.
    reach = int(np.ceil(1.5 * np.median(half[bright]))) if bright.any() else 0
    line = np.flatnonzero(bright & (peak >= reach) & (peak + reach < light.shape[1]))
    step = np.arange(-reach, reach + 1)
    at = peak[line, None] + step
    bell, surface = (np.take_along_axis(one[line], at, axis=1) for one in (light, room))
    rest = light[line]
    np.put_along_axis(rest, at, 0.0, axis=1)
    # As in a sweep, a second peak may be a reflection. An edge of brightness shifts the middle.
    alone = rest.max(axis=1) < np.maximum(0.3 * height[line], MIN_CONTRAST_TO_NOISE * noise)
    even = surface.min(axis=1) >= 0.7 * surface.max(axis=1) - MIN_CONTRAST_TO_NOISE * noise
    kept = alone & even
    if np.count_nonzero(kept) < 20:
        raise DecodingFailed(
            f"one line of light is seen in {np.count_nonzero(kept)} of {len(peak)} "
            f"{'columns' if lines.transposed else 'rows'}",
            remedy="check that the laser is on, and `direction`; if the room is not dark, take `lit` "
            "under the same light without the line",
        )
    line, bell = line[kept], bell[kept]
    total = bell.sum(axis=1)
    position = peak[line] + bell @ step / total
    sigma = noise * np.sqrt(np.sum(step**2)) / total
    # A laser's speckle makes its line rougher than noise does.
    rough = estimate_robust_scale(np.diff(position, 2)[np.diff(line, 2) == 0]) / 6.0**0.5
    sigma = np.hypot(sigma * max(1.0, rough / np.median(sigma)), MIN_SIGMA_PX)
    pixel = np.rint(position).astype(np.int64)
    s, sigmas = np.full((2, *light.shape), np.nan, np.float32)
    s[line, pixel], sigmas[line, pixel] = 0.0, sigma
    index = np.zeros_like(line)
    rest_of = line.astype(np.float64), sigma, index, index[1:] > 0, 0.0
    return assemble_map(lines, lit, s, sigmas, Boundaries(line, pixel, position, *rest_of), 1)


class _Sweep:
    """The sweep at each pixel (L, P), grey levels.

    base: without the line. peak: number of the brightest image.
    window: (2 REACH + 1, L, P) the images around it, above the base; height, total: the brightest
        of them, and all.
    second: the brightest of the other images.
    """

    def __init__(self, base: Floats, peak: NDArray[np.int32], window: Floats, second: Floats):
        self.base, self.peak, self.window, self.second = base, peak, window, second
        self.height, self.total = window[REACH], window.sum(axis=0)

    @staticmethod
    def from_frames(frames: Greys) -> _Sweep:
        """Measure the sweep in frames (F, L, P)."""
        base = np.median(frames[:: max(1, len(frames) // SAMPLES)], axis=0).astype(np.float32)
        peak = frames.argmax(axis=0).astype(np.int32)
        image = peak + np.arange(-REACH, REACH + 1)[:, None, None]
        inside = (image >= 0) & (image < len(frames))
        window = np.take_along_axis(frames, np.where(inside, image, 0), axis=0).astype(np.float32)
        second = np.zeros(base.shape, frames.dtype)
        for number, frame in enumerate(frames):
            np.maximum(second, np.where(np.abs(peak - number) > REACH, frame, 0), out=second)
        return _Sweep(base, peak, np.where(inside, window - base, np.float32(0.0)), second - base)

    def coordinates(self, base_noise2: float, rise: float) -> tuple[Floats, Floats]:
        """Compute s and its standard deviation; rise: see `noise_rise`."""
        total = np.maximum(self.total, 1.0)
        z, dz = [], []
        for first in (REACH, REACH + 1):
            later, images = self.window[first:].sum(axis=0), len(self.window) - first
            part = np.clip(later / total, 1.0 - MAX_SHARE, MAX_SHARE)
            noise2 = (1.0 - part) ** 2 * (images * base_noise2 + rise * np.maximum(later, 0.0))
            noise2 += part**2 * (first * base_noise2 + rise * np.maximum(total - later, 0.0))
            z.append(ndtri(part))
            dz.append(np.sqrt(2.0 * np.pi * noise2) * np.exp(z[-1] ** 2 / 2.0) / total)
        width = np.maximum(z[0] - z[1], 1e-3)
        share = z[0] / width
        sigma = np.hypot((1.0 - share) * dz[0], share * dz[1]) / width
        # If all light is in one image, s is known to be in that stripe, and not where.
        sharp = np.minimum(z[0], -z[1]) > 0.999 * ndtri(MAX_SHARE)
        sigma = np.hypot(sigma, np.where(sharp, UNIFORM_SIGMA, 0.003)).astype(np.float32)
        s = (self.peak + share).astype(np.float32)
        return s, sigma

    def base_noise2(self, frames: Greys) -> float:
        """Measure the variance of an image away from the line."""
        every = max(1, len(frames) // SAMPLES)
        residuals = [
            (frames[number].astype(np.float32) - self.base)[np.abs(self.peak - number) > REACH]
            for number in range(0, len(frames), every)
        ]
        stray = np.abs(np.concatenate(residuals))
        # Grey levels are whole numbers, and so would be their median; the mean is not.
        return float(max(np.mean(np.minimum(stray, 8.0)) ** 2 * np.pi / 2.0, 0.15))

    def noise_rise(self, lit: Greys, base_noise2: float) -> float:
        """Measure how much the variance rises with each grey level of light: the window adds up
        to the lit image, except for the noise of both."""
        above = lit - self.base
        bright = (above > 20) & (lit < SATURATED) & (self.total > 20)
        if np.count_nonzero(bright) < 200:
            return 0.0
        above, total = above[bright], self.total[bright]
        share = np.median(total / above)
        stray = np.abs(total - share * above)
        order = np.array_split(np.argsort(above), 8)
        variance = np.array([np.median(stray[band]) / 0.6745 for band in order]) ** 2
        level = np.array([above[band].mean() for band in order])
        base = (2 * REACH + 1 + share**2) * base_noise2
        return float(np.clip(np.median((variance - base) / (share + share**2) / level), 0.0, 0.2))


def decode_index(lit: Greys, numbers: Greys, direction: str, stripes: int) -> StripeMap:
    """Compute the stripe map of a stripe-index image; lit: (H, W), numbers: (1, H, W).

    Boundaries lie somewhere between two pixels. Along a line of them s is interpolated; pixels
    between no two boundaries get their stripe's middle. Raises DecodingFailed for disorder.
    """
    black = np.zeros_like(lit)
    images = ScanLines.from_images(lit, black, numbers, None, direction)
    index = images.patterns[0]
    numbered = ~np.isin(index, (0, 255))
    check_illumination(numbered, np.zeros_like(index))
    codes = index.astype(np.int32) - 1
    beyond = np.mean(codes[numbered] >= stripes)
    if beyond > 0.01:
        raise DecodingFailed(
            f"{beyond:.0%} of the pixels have a stripe number above {stripes}",
            remedy="correct `stripes` in the rig file, or give the stripe-index image itself",
        )
    check_order(np.where(numbered, codes, 0), numbered, images.transposed, 256)
    usable = numbered & (codes < stripes)
    usable &= ~find_code_jumps(codes, usable)
    middle = np.where(usable, codes + np.float32(0.5), np.float32(np.nan))
    # Of a mean of two pixels the standard deviation is less by the root of 2.
    boundaries = find_whole_numbers(middle, np.full_like(middle, 2.0**0.5 * UNIFORM_SIGMA), 0.0)
    s, sigma = interpolate_stripes(boundaries, codes, usable)
    alone = usable & np.isnan(s)
    s[alone], sigma[alone] = middle[alone], UNIFORM_SIGMA
    return assemble_map(images, lit, s, sigma, boundaries, stripes)


def check_order(numbers: Numbers, good: Mask, transposed: bool, stripes: int) -> None:
    """Raise DecodingFailed if neighbouring pixels are not in neighbouring stripes.

    numbers: (L, P) stripe of each pixel, 0 to stripes - 1, where it is `good`.
    """
    check_direction(numbers, good, transposed)
    line, x = np.nonzero((np.diff(numbers, axis=1) != 0) & good[:, 1:] & good[:, :-1])
    first, second = numbers[line, x], numbers[line, x + 1]
    if len(first) < 20:
        return
    step = np.abs(first - second)
    in_step = np.mean(step == 1)
    both, counted = np.concatenate([first, second]), np.tile(step == 1, 2)
    count = np.bincount(both, minlength=stripes)
    share = np.bincount(both[counted], minlength=stripes) / np.maximum(count, 1)
    if in_step < 0.6:
        raise DecodingFailed(
            "where the stripe changes, neighbouring pixels show neighbouring stripes in "
            f"{in_step:.0%} of the cases only",
            remedy="check whether the images are in their order",
        )
    # Rims are out of step as well, but not for all changes of two stripes.
    wrong = np.flatnonzero((count >= max(20, 0.5 * np.median(count[count > 0]))) & (share < 0.2))
    if len(wrong) >= 2:
        raise DecodingFailed(
            f"the lines of stripes {', '.join(map(str, wrong[:10]))} are not next to those of their "
            "neighbours",
            remedy="check whether these images are exchanged or moved",
        )
    across = np.bincount((first + second)[step == 2] // 2, minlength=stripes)
    missing = np.flatnonzero((across >= 20) & (count < 0.05 * across))
    if len(missing):
        raise DecodingFailed(
            f"the image of stripe {', '.join(map(str, missing[:10]))} shows no line, though those "
            "before and after it do",
            remedy="check whether it is missing, or another was taken twice",
        )
