"""How a person's motion at one moment correlates with another: little time apart, little motion."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from bodyscan.arrays import Array

Correlation = Callable[[Array], Array]

LEAST = 1e-3  # of the first course's variance; less is not worth an unknown
STANCE_S = 0.8
"""Time after which a stance has little to do with what it was: people sway at 0.1 to 1 Hz."""
BREATHS_S = np.geomspace(2.5, 5.8, 12)
"""Duration of a breath at rest: 10 to 24 a minute."""
USUAL_S, USUAL_SHARE = 3.75, 0.2
"""16 a minute, give or take a fifth: adults at rest breathe 12 to 20 times. Half a breath alone
looks much like a third of a deeper and slower one."""
STEADY = 0.05  # share of a breath's variance that does not recur with it
BEGUN = np.arange(8) * np.pi / 8.0
"""Phases; half a turn later each recurs with the opposite sign."""
LAG = 0.35
"""Tangent of the phase difference of belly and chest: 10 to 30 degrees at rest (Konno and Mead
1967)."""
IRREGULAR = 0.05
"""Share of a breath that is not a sine. What nobody saw is predicted by the sine alone, since
nothing in a scan shows how large this share is."""


def of_stance(seconds: Array) -> Array:
    """Correlation of a stance with itself after so many seconds.

    Matern's of order 5/2.
    """
    far = np.sqrt(5.0) * np.abs(seconds) / STANCE_S
    return np.asarray((1.0 + far + far**2 / 3.0) * np.exp(-far))


def of_breath(seconds: Array) -> Array:
    """Correlation of a breath with itself after so many seconds; it recurs, nobody knows when."""
    turns = 2.0 * np.pi * np.asarray(seconds)[..., None] / BREATHS_S
    return np.asarray((1.0 - STEADY) * np.cos(turns).mean(axis=-1) + STEADY * of_stance(seconds))


@dataclass(frozen=True, eq=False)
class Courses:
    """J courses over time, independent and of standard deviation 1, of which motion is made.

    values: at the pairs' moments, (P, J).
    middle: at the moment to which everything is carried, (J,).
    """

    values: Array
    middle: Array

    @property
    def count(self) -> int:
        return len(self.middle)

    @staticmethod
    def of(correlation: Correlation, seconds: Sequence[float | None]) -> Courses:
        """Courses for a correlation over time; seconds: each pair's moment, None if not known.

        Pairs without a moment have a course each, correlated with no other; if no moment is known,
        everything is carried to the mean.
        """
        timed = [k for k, second in enumerate(seconds) if second is not None]
        alone = [k for k, second in enumerate(seconds) if second is None]
        at = np.array([second for second in seconds if second is not None])
        values = np.zeros((len(seconds), len(alone)))
        values[alone, np.arange(len(alone))] = 1.0
        middle = np.zeros(len(alone))
        if not timed:
            return Courses(values, middle)
        knots = np.append(at, 0.5 * (at.min() + at.max()))
        sizes, vectors = np.linalg.eigh(correlation(knots[:, None] - knots))
        kept = sizes > LEAST * sizes[-1]
        ways = vectors[:, kept] / np.sqrt(sizes[kept])
        found = correlation(knots[:, None] - knots) @ ways
        rows = np.zeros((len(seconds), int(kept.sum())))
        rows[timed] = found[:-1]
        return Courses(np.hstack([rows, values]), np.concatenate([found[-1], middle]))

    @staticmethod
    def steady(count: int) -> Courses:
        """Courses of something that differs from pair to pair and does not move."""
        return Courses(np.eye(count), np.zeros(count))


def breaths(courses: Courses, seconds: Sequence[float | None]) -> tuple[Array, Array]:
    """Covariances (K, J, J) of the courses' amplitudes for K breaths, and their priors (K,).

    The breaths have every duration and phase. If a moment is not known there is only one, with
    independent moments.
    """
    at = np.array([second for second in seconds if second is not None])
    if len(at) < len(seconds):
        return np.eye(courses.count)[None], np.ones(1)
    knots = np.append(at, 0.5 * (at.min() + at.max()))
    told = np.linalg.pinv(np.vstack([courses.values, courses.middle]))
    turns = (2.0 * np.pi * knots / BREATHS_S[:, None, None] + BEGUN[:, None]).reshape(
        -1, len(knots)
    )
    waves = told @ np.stack([np.cos(turns), LAG * np.sin(turns)], axis=2)
    sines = 2.0 * waves @ np.swapaxes(waves, 1, 2)
    # What the courses leave out must leave the sum positive.
    any_way = told @ of_stance(knots[:, None] - knots) @ told.T + LEAST * np.eye(courses.count)
    usual = np.exp(-0.5 * (np.log(BREATHS_S / USUAL_S) / USUAL_SHARE) ** 2)
    likely = np.repeat(usual / (usual.sum() * len(BEGUN)), len(BEGUN))
    return sines + IRREGULAR**2 * any_way, likely
