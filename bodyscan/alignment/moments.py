"""How alike a person's motion is at two moments: what is a little apart in time moved little."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from bodyscan.arrays import Array

Correlation = Callable[[Array], Array]

LEAST = 1e-3  # of the variance of the first course; less is not worth an unknown
STANCE_S = 0.8
"""After which a stance has little to do with what it was: people sway at 0.1 to 1 Hz."""
BREATHS_S = np.linspace(2.8, 5.5, 10)
"""From one breath to the next at rest: 11 to 21 a minute."""
STEADY = 0.05  # of a breath's variance that does not come back with it
STEP_S = 1e-3


def of_stance(seconds: Array) -> Array:
    """Correlation of a stance with that of so many seconds later: Matern's of 5/2, whose speed is
    smooth too."""
    far = np.sqrt(5.0) * np.abs(seconds) / STANCE_S
    return np.asarray((1.0 + far + far**2 / 3.0) * np.exp(-far))


def of_breath(seconds: Array) -> Array:
    """Correlation of a breath: it comes back, but nobody knows how soon."""
    turns = 2.0 * np.pi * np.asarray(seconds)[..., None] / BREATHS_S
    return np.asarray((1.0 - STEADY) * np.cos(turns).mean(axis=-1) + STEADY * of_stance(seconds))


@dataclass(frozen=True, eq=False)
class Courses:
    """J courses over time, independent and of standard deviation 1, that motion is made of.

    values: (P, J) at the pairs' moments.  middle: (J,) at the moment that all is carried to.
    speeds: (P, J) per second, 0 where a moment is not known.
    """

    values: Array
    middle: Array
    speeds: Array

    @property
    def count(self) -> int:
        return len(self.middle)

    @staticmethod
    def of(correlation: Correlation, seconds: Sequence[float | None]) -> Courses:
        """Pairs without a moment have a course each: theirs is like no other, and what all is
        carried to is then the mean."""
        timed = [k for k, second in enumerate(seconds) if second is not None]
        alone = [k for k, second in enumerate(seconds) if second is None]
        at = np.array([second for second in seconds if second is not None])
        values = np.zeros((len(seconds), len(alone)))
        values[alone, np.arange(len(alone))] = 1.0
        middle, speeds = np.zeros(len(alone)), np.zeros_like(values)
        if not timed:
            return Courses(values, middle, speeds)
        knots = np.append(at, 0.5 * (at.min() + at.max()))
        sizes, vectors = np.linalg.eigh(correlation(knots[:, None] - knots))
        kept = sizes > LEAST * sizes[-1]
        ways = vectors[:, kept] / np.sqrt(sizes[kept])
        found = correlation(knots[:, None] - knots) @ ways
        ahead, behind = (
            correlation(at[:, None] + step - knots) @ ways for step in (STEP_S, -STEP_S)
        )
        rows, rates = np.zeros((2, len(seconds), int(kept.sum())))
        rows[timed], rates[timed] = found[:-1], (ahead - behind) / (2.0 * STEP_S)
        return Courses(
            np.hstack([rows, values]),
            np.concatenate([found[-1], middle]),
            np.hstack([rates, speeds]),
        )

    @staticmethod
    def steady(count: int) -> Courses:
        """Of what is another for each pair, and does not move."""
        return Courses(np.eye(count), np.zeros(count), np.zeros((count, count)))
