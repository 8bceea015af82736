"""Phase, amplitude and noise of waves of light, shifted by a part of their period from image to image.

Image k of N shows 1/2 + 1/2 cos(phi - 2 pi k / N), so that, whatever the surface's brightness,

    phi = atan2(sum I_k sin(2 pi k / N), sum I_k cos(2 pi k / N)).

Source: Creath, Phase-measurement interferometry techniques, Progress in Optics 26 (1988).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np

from bodyscan.arrays import Array, Floats, Greys, Indices, Mask
from bodyscan.geometry.robust import SIGMAS_PER_MEDIAN
from bodyscan.stripes.grey_noise import BANDS, MIN_PIXELS, fit_variance
from bodyscan.stripes.stripe_code import Wave


@dataclass(frozen=True, eq=False)
class MeasuredWave:
    """One wave at the pixels (L, P)."""

    wave: Wave
    turn: Floats  # s / period modulo 1
    # amplitude, mean: grey levels, at least 1e-3.
    amplitude: Floats
    mean: Floats

    def sigma(self, noise: Floats) -> Floats:
        """Compute the standard deviation (L, P) of `turn`; noise: of one image's grey levels.

        5e-4 of a period is left by rounding and by light that is not quite a wave.
        """
        by_noise = noise / (self.amplitude * np.float32(np.pi * np.sqrt(2.0 * self.wave.steps)))
        return np.hypot(by_noise, np.float32(5e-4))


def measure_wave(images: Greys, wave: Wave) -> MeasuredWave:
    """Measure a wave in its images (steps, L, P)."""
    angle = wave.sign * 2.0 * np.pi * np.arange(len(images)) / len(images)
    sine, cosine, mean = (
        np.einsum("nlp,n->lp", images, weight.astype(np.float32))
        for weight in (np.sin(angle), np.cos(angle), np.full(len(images), 1.0 / len(images)))
    )
    amplitude = np.hypot(sine, cosine) * np.float32(2.0 / len(images))
    turn = np.arctan2(sine, cosine) / np.float32(2.0 * np.pi) + np.float32(wave.first_turn)
    floor = np.float32(1e-3)
    return MeasuredWave(wave, turn % np.float32(1.0), np.maximum(amplitude, floor), mean)


def estimate_white_and_black(waves: Sequence[MeasuredWave]) -> tuple[Floats, Floats]:
    """Estimate the grey levels under all of the projector's light, and under none of it."""
    white = np.mean([wave.mean + wave.amplitude for wave in waves], axis=0)
    black = np.mean([wave.mean - wave.amplitude for wave in waves], axis=0)
    return np.minimum(white, 255.0), np.maximum(black, 0.0)


def estimate_white_image(images: Greys, waves: tuple[Wave, ...]) -> Greys:
    """Estimate the image (H, W) under all of the projector's light from images (F, H, W) of waves."""
    parts = zip(split_waves(images, waves), waves, strict=True)
    white, _ = estimate_white_and_black([measure_wave(part, wave) for part, wave in parts])
    return convert_like(white, images)


def convert_like(grey: Floats, images: Greys) -> Greys:
    """Convert grey levels to the type of the images."""
    return np.rint(grey).astype(np.uint8) if images.dtype == np.uint8 else grey


def split_waves(images: Greys, waves: tuple[Wave, ...]) -> list[Greys]:
    """Split images into those (F, L, P) of each wave, which follow each other."""
    ends = np.cumsum([0, *(wave.steps for wave in waves)])
    return [images[first:end] for first, end in pairwise(ends)]


def balance_images(
    images: Greys, wave: MeasuredWave, black: Greys | Floats, contrast: Floats, gains: Array
) -> tuple[Greys, MeasuredWave]:
    """Remove gains, see `estimate_gains`, from the images of a wave, and measure it again."""
    if np.array_equal(gains.T, [[1.0, 0.0]] * len(images)):
        return images, wave
    gain, added = gains.astype(np.float32)
    light = images.astype(np.float32) - black - np.multiply.outer(added, contrast)
    balanced: Floats = light / gain[:, None, None] + black
    return balanced, measure_wave(balanced, wave.wave)


def describe_gains(gains: Array, period: float) -> list[str]:
    """Say which images differ so much that it moves the phase of four by 0.01 of a period, and how."""
    return [
        f"image {step} of the wave of {period:g} stripes has {gain:.2f} times the light of the others "
        f"and {added:+.0%} of the contrast besides (exposure, flicker, a flash?): both are removed"
        for step, (gain, added) in enumerate(gains.T)
        if max(abs(added), abs(gain - 1.0) / 2.0) > 0.05
    ]


def estimate_gains(
    images: Greys, wave: MeasuredWave, black: Greys | Floats, contrast: Floats, usable: Mask
) -> Array:
    """Estimate what one image of a wave has and the others have not: a gain, and light such as a
    flash, as a share of the contrast, (2, steps); all 1 and 0 if none has, or if only a part of
    a period is shown.

    images: (steps, L, P) of the wave. black, contrast: (L, P), without the projector's light, and what
        all of it adds. usable: (L, P).

    Over a whole period each image is the first one shifted, whatever the wave's shape: all have one
    mean and one amplitude. What is wrong in one image moves the phases by which it is seen: each
    iteration leaves half of it.
    """
    gains = _measure_gains(images, wave, black, contrast, usable)
    # Subjects that show a period unevenly give 0.014.
    if gains is None or max(np.abs(gains[1]).max(), np.abs(gains[0] - 1.0).max() / 2.0) < 0.02:
        return np.stack([np.ones(len(images)), np.zeros(len(images))])
    return gains


def _measure_gains(
    images: Greys, wave: MeasuredWave, black: Greys | Floats, contrast: Floats, usable: Mask
) -> Array | None:
    """See `estimate_gains`; None if only a part of a period is shown."""
    lit = np.flatnonzero(usable)  # every n-th of which may have few phases
    some = np.random.default_rng(0).choice(lit, min(len(lit), 10_000))
    light = images.reshape(len(images), -1)[:, some] - black.ravel()[some].astype(np.float32)
    levels = light / contrast.ravel()[some]
    bins = 24
    gain, added = np.ones((len(levels), 1)), np.zeros((len(levels), 1))
    for _ in range(6):
        balanced = ((levels - added) / gain).astype(np.float32)
        bin_of = (measure_wave(balanced[:, None], wave.wave).turn[0] * bins).astype(int) % bins
        if np.bincount(bin_of, minlength=bins).min() <= levels.shape[1] / (8 * bins):
            return None
        profile = [np.median(levels[:, bin_of == k], axis=1) for k in range(bins)]
        shape = np.fft.rfft(profile, axis=0)
        mean, amplitude = shape[0].real / bins, np.abs(shape[1])
        gain = (amplitude / np.median(amplitude))[:, None]
        added = mean[:, None] - gain * np.median(mean)
    return np.stack([gain[:, 0], added[:, 0]])


def find_lit_part(
    images: Sequence[Greys],
    waves: Sequence[MeasuredWave],
    references: Sequence[tuple[Greys | Floats, Floats]],
    usable: Mask,
) -> tuple[Mask, list[str]]:
    """Find pixels (L, P) that light such as a flash reached in one image of a wave; also say which.

    images, waves, references: the images (steps, L, P) of each wave, the wave, and black and contrast.

    The mean of a wave's images lies halfway between black and white, whatever the surface and the blur.
    Where it is r of the contrast higher, light in one image moves the phase by up to 2 r / pi of a
    period: a hundredth for 0.02. On a real board means over 1/60 of the picture vary by 0.008.
    """
    size = max(15, max(usable.shape) // 60 | 1)
    weight = cv2.blur(usable.astype(np.float32), (size, size))
    left_out, notes = np.zeros(usable.shape, bool), list[str]()
    if not usable.any():
        return left_out, notes
    for stack, wave, (black, contrast) in zip(images, waves, references, strict=True):
        share = np.zeros(usable.shape, np.float32)
        share[usable] = (wave.mean - black)[usable] / contrast[usable]
        share[usable] -= np.median(share[usable])
        offset = cv2.blur(share, (size, size)) / np.maximum(weight, np.float32(1e-3))
        sigma = SIGMAS_PER_MEDIAN * float(np.median(np.abs(offset[usable])))
        part = usable & (offset > max(0.02, 6.0 * sigma)) & (weight > 0.2)
        if np.count_nonzero(part) < max(0.01 * np.count_nonzero(usable), 20 * wave.wave.steps):
            continue
        light = wave.wave.steps * float(np.median(offset[part]))
        which = "one image"
        if (gains := _measure_gains(stack, wave, black, contrast, part)) is not None:
            *_, second, largest = np.sort(gains[1])
            if largest < 0.25 * light:  # all of them: the phase stays
                continue
            if second < 0.4 * light < 0.8 * largest:
                which = f"image {np.argmax(gains[1])}"
        if which == "one image" and light < 0.1:
            continue
        left_out |= cv2.dilate(part.view(np.uint8), np.ones((size, size), np.uint8)) > 0
        over = np.count_nonzero(part) / np.count_nonzero(usable)
        notes.append(
            f"{which} of the wave of {wave.wave.period:g} stripes contradicts the others over "
            f"{over:.0%} of the picture, by {light:.0%} of the contrast (was there a flash?): that is "
            "left out"
        )
    return left_out, notes


def measure_wave_noise(
    waves: Sequence[MeasuredWave], images: Sequence[Greys], usable: Mask
) -> Floats:
    """Measure the variance (256,) of one image's grey level, for each grey level.

    Several waves, or more than three steps of one, determine mean and shape more than once; the
    differences are noise.

    waves, images: the waves, and the images (N, L, P) of each.
    usable: (L, P) pixels that the projector lights.
    """
    some = np.flatnonzero(usable)
    some = some[:: max(1, len(some) // 300_000)]
    # Sorted by the mean of all images, which is independent of the difference of two waves' means.
    steps = [wave.wave.steps for wave in waves]
    level = np.average([wave.mean.ravel()[some] for wave in waves], axis=0, weights=steps)
    misfits = list(_compute_misfits(waves, images, some))
    bands = [band for band in np.array_split(np.argsort(level), BANDS) if misfits]
    bands = [band for band in bands if len(band) >= MIN_PIXELS]
    grey = np.array([np.mean(level[band]) for band in bands])
    variance = np.array(
        [np.mean([_estimate_variance(each[band]) for each in misfits]) for band in bands]
    )
    return fit_variance(grey, variance, np.ones(len(bands)), images[0].dtype)


def _compute_misfits(
    waves: Sequence[MeasuredWave], images: Sequence[Greys], some: Indices
) -> Iterator[Array]:
    """Yield quantities at some pixels that are zero but for noise, scaled to one image's variance."""
    for first, second in pairwise(waves):
        difference = first.mean.ravel()[some] - second.mean.ravel()[some]
        yield difference / np.sqrt(1.0 / first.wave.steps + 1.0 / second.wave.steps)
    for wave, stack in zip(waves, images, strict=True):
        if wave.wave.steps > 3:
            yield _compute_wave_misfit(wave, stack, some)


def _compute_wave_misfit(wave: MeasuredWave, images: Greys, some: Indices) -> Array:
    """A component of the images orthogonal to mean and wave, less the harmonics 2 to 4 of the
    projector's response."""
    step = np.arange(wave.wave.steps)
    turn = 2.0 * np.pi * step / wave.wave.steps
    known = np.stack([np.ones(len(step)), np.cos(turn), np.sin(turn)])
    weights = np.linalg.svd(known)[2][-1]
    misfit = np.asarray(weights @ images.reshape(len(images), -1)[:, some])
    phase = 2.0 * np.pi * wave.turn.ravel()[some]
    amplitude = wave.amplitude.ravel()[some]
    shapes = np.stack([amplitude * f(h * phase) for h in (2, 3, 4) for f in (np.cos, np.sin)], 1)
    return np.asarray(misfit - shapes @ np.linalg.lstsq(shapes, misfit, rcond=None)[0])


def _estimate_variance(misfit: Array) -> float:
    """Variance about the mean, without outliers (a surface's edge, something that moved)."""
    deviation = np.abs(misfit - np.median(misfit))
    limit = 4.0 * SIGMAS_PER_MEDIAN * max(float(np.median(deviation)), 1e-3)
    return float(np.var(misfit[deviation <= limit]))
