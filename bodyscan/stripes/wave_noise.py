"""Noise of grey levels, measured from the waves of a phase-shift sequence themselves.

Several waves, or more than three steps of one, give the surface's mean brightness and the shape of
a wave more than once; the differences are noise.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import pairwise

import numpy as np

from bodyscan.arrays import Array, Floats, Greys, Indices, Mask
from bodyscan.geometry.robust import SIGMAS_PER_MEDIAN
from bodyscan.stripes.grey_noise import fitted_variance
from bodyscan.stripes.waves import WaveSeen

BANDS = 16
ENOUGH_PIXELS = 500
MOST_PIXELS = 300_000
OUTLYING = 4.0
HARMONICS = (2, 3, 4)


def wave_variance(waves: Sequence[WaveSeen], images: Sequence[Greys], usable: Mask) -> Floats:
    """Variance (256,) of one image's grey level, for each grey level.

    waves, images: the waves, and the images (N, L, P) of each.
    usable: (L, P) pixels that the projector lights.
    """
    some = np.flatnonzero(usable)
    some = some[:: max(1, len(some) // MOST_PIXELS)]
    # Sorted by the mean of all images, which is independent of the difference of two waves' means.
    steps = [wave.wave.steps for wave in waves]
    level = np.average([wave.mean.ravel()[some] for wave in waves], axis=0, weights=steps)
    misfits = list(_misfits(waves, images, some))
    bands = [band for band in np.array_split(np.argsort(level), BANDS) if misfits]
    bands = [band for band in bands if len(band) >= ENOUGH_PIXELS]
    grey = np.array([np.mean(level[band]) for band in bands])
    spread2 = np.array([np.mean([_spread2(each[band]) for each in misfits]) for band in bands])
    return fitted_variance(grey, spread2, np.ones(len(bands)), images[0].dtype)


def _misfits(waves: Sequence[WaveSeen], images: Sequence[Greys], some: Indices) -> Iterator[Array]:
    """Quantities that would be zero without noise, at some pixels, each with one image's
    variance."""
    for one, other in pairwise(waves):
        apart = one.mean.ravel()[some] - other.mean.ravel()[some]
        yield apart / np.sqrt(1.0 / one.wave.steps + 1.0 / other.wave.steps)
    for wave, stack in zip(waves, images, strict=True):
        if wave.wave.steps > 3:
            yield _beside_the_wave(wave, stack, some)


def _beside_the_wave(wave: WaveSeen, images: Greys, some: Indices) -> Array:
    """What images show besides mean and wave, less the harmonics of the projector's response."""
    step = np.arange(wave.wave.steps)
    turn = 2.0 * np.pi * step / wave.wave.steps
    known = np.stack([np.ones(len(step)), np.cos(turn), np.sin(turn)])
    weights = np.linalg.svd(known)[2][-1]
    misfit = np.asarray(weights @ images.reshape(len(images), -1)[:, some])
    phase = 2.0 * np.pi * wave.turn.ravel()[some]
    amplitude = wave.amplitude.ravel()[some]
    shapes = np.stack([amplitude * f(h * phase) for h in HARMONICS for f in (np.cos, np.sin)], 1)
    return np.asarray(misfit - shapes @ np.linalg.lstsq(shapes, misfit, rcond=None)[0])


def _spread2(misfit: Array) -> float:
    """Variance about the mean, without outliers (a surface's edge, where things moved)."""
    off = np.abs(misfit - np.median(misfit))
    near = misfit[off <= OUTLYING * SIGMAS_PER_MEDIAN * max(float(np.median(off)), 1e-3)]
    return float(np.var(near))
