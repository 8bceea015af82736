"""Correction of the phase errors that the projector's response (gamma and the like) causes.

For a wave that is not a pure cosine, N steps turn the harmonics jN +- 1 into a phase error that is
itself a wave, of jN times the frequency (Guo, He, Chen 2004 for gamma). It is found from the images
alone. Where a surface is unbroken it is smooth, whatever the phase; so second differences of the
phase along a line are, apart from noise, those of the error: a linear fit. How often each phase occurs
does not matter, as it does when histograms are equalised. A wave too long to repeat in the image is
compared with a finer one instead.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from bodyscan.arrays import Array, Floats, Mask
from bodyscan.geometry.robust import SIGMAS_PER_MEDIAN
from bodyscan.stripes.phase.waves import MeasuredWave

MULTIPLES = (1, 2, 3, 4)
"""j above: more are far below the noise; with three steps and a gamma of 2.2, two are not enough."""
MIN_PERIODS = 4
"""Periods of a wave within the stripes; with fewer, the surface's shape could look like its error."""
LAG_TURNS = 0.375
"""Between the pixels of a second difference, of the error's lowest wave: both waves show."""
MAX_ERROR = 0.1
"""Turns: three steps and a gamma of 5 give less. A fit that leaves more means another order of the
images."""


@dataclass(frozen=True, eq=False)
class PhaseError:
    """The error of a wave's turn, itself a wave of the turn as measured: amplitudes (turns) of
    cosines and sines at 1, 2, ... times `steps` times its frequency."""

    steps: int
    cosines: Array
    sines: Array

    def evaluate(self, turn: Floats) -> Floats:
        """Compute the error in turns at turns of any shape."""
        total = np.zeros_like(turn)
        for multiple, cosine, sine in zip(MULTIPLES, self.cosines, self.sines, strict=False):
            angle = np.float32(2.0 * np.pi * multiple * self.steps) * turn
            total += np.float32(cosine) * np.cos(angle) + np.float32(sine) * np.sin(angle)
        return total


def correct_wave(wave: MeasuredWave, error: PhaseError | None) -> MeasuredWave:
    """Subtract the error from a wave's turns."""
    if error is None:
        return wave
    return replace(wave, turn=(wave.turn - error.evaluate(wave.turn)) % np.float32(1.0))


def estimate_error(wave: MeasuredWave, usable: Mask, stripes: int) -> PhaseError | None:
    """Estimate the error of a wave at usable pixels (L, P); None if noise explains it, or the
    wave does not repeat."""
    if wave.wave.period * MIN_PERIODS > stripes:
        return None
    lag = _choose_lag(wave, usable)
    turns = _select_triples(wave.turn, usable, lag)
    if turns.shape[1] < 3_000:
        return None
    before, behind = (_wrap(turns[k + 1] - turns[k]) for k in (0, 1))
    steps = wave.wave.steps
    # Pixels cannot resolve shorter waves of the error than 1.5 px.
    count = max(1, round(lag / LAG_TURNS / 1.5))
    first, middle, last = (_evaluate_waves(turn, steps, count) for turn in turns)
    return _fit_error(first - 2.0 * middle + last, (behind - before).astype(float), steps)


def estimate_error_against(
    wave: MeasuredWave, finer: MeasuredWave, usable: Mask, stripes: int
) -> PhaseError | None:
    """Estimate the error of a wave whose one period covers all stripes, against a finer one that is
    taken as right."""
    if wave.wave.period < stripes:
        return None
    ratio = np.float32(wave.wave.period / finer.wave.period)
    turn = wave.turn[usable]
    difference = 2.0j * np.pi * (ratio * turn - finer.turn[usable])
    bins = 256
    bin_of = np.minimum((turn * bins).astype(np.int64), bins - 1)
    count = np.bincount(bin_of, minlength=bins)
    arrows = np.exp(difference)
    sums = np.bincount(bin_of, arrows.real, bins) + 1.0j * np.bincount(bin_of, arrows.imag, bins)
    # Below a mean length of 0.3 a bin's phases point anywhere.
    clear = (count >= 50) & (np.abs(sums) >= 0.3 * count)
    # Over less than a period of its own the error looks like a whole turn of the finer wave.
    if np.count_nonzero(clear) < bins / wave.wave.steps:
        return None
    curve = np.unwrap(np.angle(sums[clear])) / (2.0 * np.pi)
    middle = ((np.arange(bins) + 0.5) / bins)[clear]
    shapes = ratio * _evaluate_waves(middle, wave.wave.steps)
    weight = np.sqrt(count[clear])[:, None]
    # The curve is known up to whole turns; the error has mean zero.
    wanted = curve[:, None] - np.rint(np.mean(curve)) - np.arange(-2, 3)
    fitted = np.linalg.lstsq(weight * shapes, weight * wanted, rcond=None)[0]
    misfit = np.sum(np.square(weight * (wanted - shapes @ fitted)), axis=0)
    best, rms = fitted[:, np.argmin(misfit)], float(np.sqrt(misfit.min() / np.sum(weight**2)))
    if rms > MAX_ERROR or np.abs(shapes @ best).max() > MAX_ERROR * ratio:
        return None
    return PhaseError(wave.wave.steps, *np.split(best, 2))


def _choose_lag(wave: MeasuredWave, usable: Mask) -> int:
    """Pixels between those of a second difference."""
    reach = 4
    both = usable[:, reach:] & usable[:, :-reach]
    step = _wrap(wave.turn[:, reach:] - wave.turn[:, :-reach])[both]
    slope = float(np.median(np.abs(step))) / reach if step.size else 1.0
    return max(1, round(LAG_TURNS / wave.wave.steps / max(slope, 1e-6)))


def _select_triples(turn: Floats, usable: Mask, lag: int) -> Floats:
    """Turns (3, M) at three pixels of a line that are usable, as is everything between them."""
    if turn.shape[1] <= 2 * lag:
        return np.empty((3, 0), np.float32)
    total = np.pad(np.cumsum(usable, axis=1, dtype=np.int32), ((0, 0), (1, 0)))
    whole = total[:, 2 * lag + 1 :] - total[:, : -2 * lag - 1] == 2 * lag + 1
    line, first = np.nonzero(whole)
    every = max(1, len(line) // 100_000)
    line, first = line[::every], first[::every]
    return np.stack([turn[line, first + k * lag] for k in range(3)])


def _evaluate_waves(turn: Floats | Array, steps: int, count: int = len(MULTIPLES)) -> Array:
    """Cosines, then sines, (M, 2 K), of turns (M,) times `steps` times the first `count` multiples."""
    angle = 2.0 * np.pi * steps * np.multiply.outer(turn, MULTIPLES[:count])
    return np.concatenate([np.cos(angle), np.sin(angle)], axis=1)


def _fit_error(shapes: Array, measured: Array, steps: int) -> PhaseError | None:
    """Least squares without outliers (edges of surfaces, curvature)."""
    near = np.ones(len(measured), bool)
    for _ in range(4):
        # Waves of the error that second differences determine 20 times less than others are left 0.
        fitted = np.linalg.lstsq(shapes[near], measured[near], rcond=0.05)[0]
        residual = np.abs(measured - shapes @ fitted)
        near = residual <= 5.0 * SIGMAS_PER_MEDIAN * np.median(residual)
    variance = np.var(measured[near] - shapes[near] @ fitted)
    chi2 = np.sum(np.square(shapes[near] @ fitted)) / variance / len(fitted)
    # If too few different phases are seen to determine a wave of the error, it could be anything.
    # Neighbours share pixels, which makes sigmas too small by about half: 5 of them are significant.
    if np.abs(fitted).max() >= MAX_ERROR or chi2 <= 5.0**2:
        return None
    return PhaseError(steps, *np.split(np.asarray(fitted, float), 2))


def _wrap(turn: Floats) -> Floats:
    return turn - np.rint(turn)
