"""Removal of the phase errors that the projector's response (gamma and the like) causes.

For a wave that is not a pure cosine, N steps turn the harmonics jN +- 1 into a phase error that is
itself a wave, of jN times the frequency (Guo, He, Chen 2004 for gamma). It is found from the images
alone. Where a surface is unbroken it is smooth, whatever the phase; so second differences of the
phase along a line are, apart from noise, those of the error: a linear fit. How often each phase
occurs does not matter, as it does when histograms are equalised. A wave too long to repeat in the
image is compared with a finer one instead.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from bodyscan.arrays import Array, Floats, Mask
from bodyscan.geometry.robust import SIGMAS_PER_MEDIAN
from bodyscan.stripes.stripe_map import ResponseShare
from bodyscan.stripes.waves import WaveSeen

MULTIPLES = (1, 2, 3, 4)
"""j above: more are far below the noise; with three steps
and a gamma of 2.2, two are not enough."""

FEWEST_PERIODS = 4
"""Periods of a wave within the stripes; with fewer, the
surface's shape could look like its error."""

LAG = 0.375
"""Turns of the error's lowest wave between the places of a second difference: both waves show."""

SHORTEST_PX = 1.5
LEAST_SHOWN = 0.05
"""Relative to the best-determined wave of the error in second differences."""

MOST_PLACES = 100_000
FEWEST_PLACES = 3_000
STEEP_PX = 4
OUTLYING = 5.0
ROUNDS = 4
SIGNIFICANT = 5.0
"""Sigmas; neighbouring places share their pixels, which makes sigmas too small by about half."""

BINS = 256
ENOUGH_IN_BIN = 50
SHARP = 0.3
"""Length of the mean of a bin's phases as unit vectors: below it they point anywhere."""

MOST_WHOLE_TURNS = 2
MOST_LEFT = 0.1
"""Turns of the finer wave, RMS: if an error leaves more, the images are in another order."""

MOST_ERROR = 0.1
"""Turns: three steps and a gamma of 5 give less."""


@dataclass(frozen=True, eq=False)
class PhaseError:
    """The error of a wave's turn, itself a wave of the turn as read.

    cosines, sines: amplitudes, in turns, at 1, 2, ... times `steps` times its frequency.
    """

    steps: int
    cosines: Array
    sines: Array

    def at(self, turn: Floats) -> Floats:
        """Error in turns at turns of any shape."""
        total = np.zeros_like(turn)
        for multiple, cosine, sine in zip(MULTIPLES, self.cosines, self.sines, strict=False):
            angle = np.float32(2.0 * np.pi * multiple * self.steps) * turn
            total += np.float32(cosine) * np.cos(angle) + np.float32(sine) * np.sin(angle)
        return total


def without_error(wave: WaveSeen, error: PhaseError | None) -> WaveSeen:
    """The wave with its turns corrected."""
    if error is None:
        return wave
    return replace(wave, turn=(wave.turn - error.at(wave.turn)) % np.float32(1.0))


def share_of_error(error: PhaseError | None, wave: WaveSeen, sigma: Floats) -> ResponseShare | None:
    """What the error did to s (stripes), over the pixels with
    a sigma, in any layout of the pixels."""
    known = np.isfinite(sigma)
    if error is None or not known.any():
        return None
    turns = np.sqrt(np.sum(np.square([error.cosines, error.sines])) / 2.0)
    noise = float(np.sqrt(np.mean(np.square(sigma[known]))))
    return ResponseShare(float(turns * wave.wave.period), noise)


def error_of_repeated(wave: WaveSeen, usable: Mask, stripes: int) -> PhaseError | None:
    """The error of a wave that repeats in the image; None if noise explains it or it does not
    repeat.

    usable: (L, P); lines cross the wave.
    """
    if wave.wave.period * FEWEST_PERIODS > stripes:
        return None
    lag = _lag(wave, usable)
    turns = _triples(wave.turn, usable, lag)
    if turns.shape[1] < FEWEST_PLACES:
        return None
    before, behind = (_wrapped(turns[k + 1] - turns[k]) for k in (0, 1))
    steps = wave.wave.steps
    # Pixels cannot resolve shorter waves of the error.
    most = max(1, round(lag / LAG / SHORTEST_PX))
    first, middle, last = (_shapes(turn, steps, most) for turn in turns)
    return _fitted(first - 2.0 * middle + last, (behind - before).astype(float), steps)


def error_against(wave: WaveSeen, finer: WaveSeen, usable: Mask, stripes: int) -> PhaseError | None:
    """The error of a wave whose one period covers all
    stripes, against a finer one taken as right."""
    if wave.wave.period < stripes:
        return None
    ratio = np.float32(wave.wave.period / finer.wave.period)
    turn = wave.turn[usable]
    apart = 2.0j * np.pi * (ratio * turn - finer.turn[usable])
    place = np.minimum((turn * BINS).astype(np.int64), BINS - 1)
    count = np.bincount(place, minlength=BINS)
    arrows = np.exp(apart)
    sums = np.bincount(place, arrows.real, BINS) + 1.0j * np.bincount(place, arrows.imag, BINS)
    clear = (count >= ENOUGH_IN_BIN) & (np.abs(sums) >= SHARP * count)
    if np.count_nonzero(clear) <= 4 * len(MULTIPLES):
        return None
    curve = np.unwrap(np.angle(sums[clear])) / (2.0 * np.pi)
    middle = ((np.arange(BINS) + 0.5) / BINS)[clear]
    shapes = ratio * _shapes(middle, wave.wave.steps)
    weight = np.sqrt(count[clear])[:, None]
    # The curve is known up to whole turns; the error has mean zero.
    whole = np.arange(-MOST_WHOLE_TURNS, MOST_WHOLE_TURNS + 1)
    wanted = curve[:, None] - np.rint(np.mean(curve)) - whole
    found = np.linalg.lstsq(weight * shapes, weight * wanted, rcond=None)[0]
    misfit = np.sum(np.square(weight * (wanted - shapes @ found)), axis=0)
    best, left = found[:, np.argmin(misfit)], float(np.sqrt(misfit.min() / np.sum(weight**2)))
    if left > MOST_LEFT or np.abs(shapes @ best).max() > MOST_ERROR * ratio:
        return None
    return _phase_error(best, wave.wave.steps)


def _lag(wave: WaveSeen, usable: Mask) -> int:
    """Pixels between the places of a second difference."""
    both = usable[:, STEEP_PX:] & usable[:, :-STEEP_PX]
    step = _wrapped(wave.turn[:, STEEP_PX:] - wave.turn[:, :-STEEP_PX])[both]
    slope = float(np.median(np.abs(step))) / STEEP_PX if step.size else 1.0
    return max(1, round(LAG / wave.wave.steps / max(slope, 1e-6)))


def _triples(turn: Floats, usable: Mask, lag: int) -> Floats:
    """Turns (3, M) at three places of a line that are usable, as is everything between them."""
    if turn.shape[1] <= 2 * lag:
        return np.empty((3, 0), np.float32)
    total = np.pad(np.cumsum(usable, axis=1, dtype=np.int32), ((0, 0), (1, 0)))
    whole = total[:, 2 * lag + 1 :] - total[:, : -2 * lag - 1] == 2 * lag + 1
    line, first = np.nonzero(whole)
    every = max(1, len(line) // MOST_PLACES)
    line, first = line[::every], first[::every]
    return np.stack([turn[line, first + k * lag] for k in range(3)])


def _shapes(turn: Floats | Array, steps: int, most: int = len(MULTIPLES)) -> Array:
    """Cosines, then sines, (M, 2 K), of the first K multiples, at most `most`."""
    angle = 2.0 * np.pi * steps * np.multiply.outer(turn, MULTIPLES[:most])
    return np.concatenate([np.cos(angle), np.sin(angle)], axis=1)


def _fitted(shapes: Array, seen: Array, steps: int) -> PhaseError | None:
    """Least squares without outliers: edges of surfaces, and bends."""
    near = np.ones(len(seen), bool)
    for _ in range(ROUNDS):
        found = np.linalg.lstsq(shapes[near], seen[near], rcond=LEAST_SHOWN)[0]
        off = np.abs(seen - shapes @ found)
        near = off <= OUTLYING * SIGMAS_PER_MEDIAN * np.median(off)
    variance = np.var(seen[near] - shapes[near] @ found)
    chi2 = np.sum(np.square(shapes[near] @ found)) / variance / len(found)
    # If too few different phases are seen to determine a wave of the error, it could be anything.
    credible = np.abs(found).max() < MOST_ERROR
    return (
        _phase_error(np.asarray(found, float), steps)
        if credible and chi2 > SIGNIFICANT**2
        else None
    )


def _phase_error(found: Array, steps: int) -> PhaseError:
    return PhaseError(steps, *np.split(found, 2))


def _wrapped(turn: Floats) -> Floats:
    return turn - np.rint(turn)
