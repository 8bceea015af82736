"""Temporal modes of a person's motion: how it correlates between the pairs' moments."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from bodyscan.alignment.sway_prior import correlate_stance
from bodyscan.arrays import Array

MIN_SHARE = 1e-3  # of the largest eigenvalue; less is not worth an unknown
BREATHS_S = np.geomspace(2.5, 5.8, 8)
"""Duration of a breath at rest: 10 to 24 a minute."""
PHASES = np.arange(12) * np.pi / 6.0
SHARPNESSES = 1, 2, 3
"""Exponents n of a breath cos^2n: 1 is a sine, 3 rests for long breathed out (Lujan et al. 1999, Med.
Phys. 26)."""
IRREGULAR = 0.25
"""Part of a breath: the depth of resting breaths varies by a quarter (Benchetrit 2000, Respir. Physiol.
122), and they begin and end within 0.4 s."""


def correlate_breath(seconds: Array) -> Array:
    """Correlation of a breath with itself after so many seconds, averaged over its duration."""
    phase = 2.0 * np.pi * np.asarray(seconds)[..., None] / BREATHS_S
    share = IRREGULAR**2
    return np.asarray(
        (1.0 - share) * np.cos(phase).mean(axis=-1) + share * correlate_stance(2.0 * seconds)
    )


@dataclass(frozen=True, eq=False)
class TemporalModes:
    """Karhunen-Loeve basis of J modes of a stationary Gaussian process, of unit variance each."""

    values: Array  # at the pairs' moments, (P, J)
    middle: Array  # at the middle of the scan, to which everything is carried, (J,)

    @property
    def count(self) -> int:
        return len(self.middle)

    @staticmethod
    def from_correlation(
        correlation: Callable[[Array], Array], seconds: Sequence[float | None], middle_s: float
    ) -> TemporalModes:
        """Modes of a correlation over time; seconds: each pair's moment, None if not known.

        Pairs without a moment have one mode each, independent of all others. If no moment is known,
        everything is carried to the mean.
        """
        timed = [k for k, second in enumerate(seconds) if second is not None]
        untimed = [k for k, second in enumerate(seconds) if second is None]
        at = np.array([second for second in seconds if second is not None])
        independent = np.zeros((len(seconds), len(untimed)))
        independent[untimed, np.arange(len(untimed))] = 1.0
        middle = np.zeros(len(untimed))
        if not timed:
            return TemporalModes(independent, middle)
        knots = np.append(at, middle_s)
        covariance = correlation(knots[:, None] - knots)
        eigenvalues, eigenvectors = np.linalg.eigh(covariance)
        kept = eigenvalues > MIN_SHARE * eigenvalues[-1]
        modes = covariance @ (eigenvectors[:, kept] / np.sqrt(eigenvalues[kept]))
        rows = np.zeros((len(seconds), int(kept.sum())))
        rows[timed] = modes[:-1]
        return TemporalModes(np.hstack([rows, independent]), np.concatenate([modes[-1], middle]))


@dataclass(frozen=True, eq=False)
class Breaths:
    """K breaths that a person may have drawn, as amplitudes of J temporal modes."""

    # (K, J, 2), of unit variance over time: the breath, and what comes earlier or later of it.
    waves: Array
    irregular: Array  # covariance (J, J) of what is not periodic
    priors: Array  # probabilities, (K,)

    @staticmethod
    def from_modes(
        modes: TemporalModes, seconds: Sequence[float | None], middle_s: float
    ) -> Breaths:
        """Breaths of every duration, phase and sharpness.

        If a moment is not known there is only one, with independent moments.
        """
        at = np.array([second for second in seconds if second is not None])
        if len(at) < len(seconds):
            return Breaths(np.zeros((1, modes.count, 2)), np.eye(modes.count), np.ones(1))
        knots = np.append(at, middle_s)
        amplitudes_from_values = np.linalg.pinv(np.vstack([modes.values, modes.middle]))
        phase = (2.0 * np.pi * knots / BREATHS_S[:, None, None] + PHASES[:, None]).reshape(
            -1, len(knots)
        )
        # Belly and chest differ in phase by 10 to 30 degrees at rest (Konno and Mead 1967): tan 0.35.
        waves = [
            np.stack([_breathe(phase, n), 0.35 * _breathe(phase, n, slope=True)], axis=2)
            for n in SHARPNESSES
        ]
        # The small diagonal keeps the sum positive definite.
        irregular = amplitudes_from_values @ correlate_stance(
            2.0 * (knots[:, None] - knots)
        ) @ amplitudes_from_values.T + MIN_SHARE * np.eye(modes.count)
        # 16 breaths a minute, give or take a fifth: adults at rest breathe 12 to 20 times. Half a
        # breath alone looks much like a third of a deeper and slower one.
        prior = np.exp(-0.5 * (np.log(BREATHS_S / 3.75) / 0.2) ** 2)
        priors = np.tile(np.repeat(prior, len(PHASES)), len(SHARPNESSES))
        return Breaths(
            amplitudes_from_values @ np.concatenate(waves),
            IRREGULAR**2 * irregular,
            priors / priors.sum(),
        )


def _breathe(phase: Array, sharpness: int, *, slope: bool = False) -> Array:
    """A breath of zero mean and unit variance at phases (...), breathed in at 0; or its derivative."""

    def wave(phase: Array) -> Array:
        share = np.mod(phase / (2.0 * np.pi), 1.0)
        # Inspiration takes 0.4 of a breath (Tobin et al. 1983, Chest 84).
        angle = np.where(share < 0.6, share / 0.6, 1.0 + (share - 0.6) / 0.4)
        return np.asarray(np.cos(0.5 * np.pi * angle) ** (2 * sharpness))

    period = wave(np.linspace(0.0, 2.0 * np.pi, 360, endpoint=False))
    if slope:
        return (wave(phase + 0.01) - wave(phase - 0.01)) / (0.02 * period.std())
    return (wave(phase) - period.mean()) / period.std()
