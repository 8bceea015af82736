"""How far boundaries estimate_scatter against what they claim, on runs of a known estimate_scatter."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from bodyscan.stripes.boundaries import Boundaries
from bodyscan.stripes.stripe_coordinates import estimate_local_scatter, estimate_scatter


def boundaries(
    count: int, *, claimed: float, apart_px: float = 2.0, line: int | None = None
) -> Boundaries:
    """Runs of so many boundaries (all, where line is None) that lie 0.05 px off a parabola."""
    number = np.arange(count)
    along = number % (line or count)
    noise = 0.05 * np.random.default_rng(0).standard_normal(count)
    return Boundaries(
        line=number // (line or count),
        before=np.floor(apart_px * along).astype(np.int64),
        position=30.0 + apart_px * along + 1e-6 * along**2 + noise,
        line_position=np.zeros(count),
        sigma_px=np.full(count, claimed),
        index=along + 1,
        joined=along[1:] > 0,
        blur2=0.0,
    )


def test_ratio_of_observed_to_predicted_scatter() -> None:
    # Of 10,000 overlapping fives the robust ratio is known to 2 %.
    for times in (0.5, 1.0, 1.1):
        assert estimate_scatter(boundaries(10_000, claimed=0.05 / times)) == 1.0
    for times in (1.3, 2.0, 4.0):
        assert estimate_scatter(boundaries(10_000, claimed=0.05 / times)) == pytest.approx(
            times, rel=0.05
        )


def test_a_thousand_runs_of_five_are_needed() -> None:
    assert estimate_scatter(boundaries(1004, claimed=0.02)) > 2.0
    assert estimate_scatter(boundaries(1003, claimed=0.02)) == 1.0
    assert estimate_scatter(boundaries(4, claimed=0.02)) == 1.0
    # Of lines of twelve, eight starts each.
    assert estimate_scatter(boundaries(12 * 125, claimed=0.02, line=12)) > 2.0
    assert estimate_scatter(boundaries(12 * 125 - 1, claimed=0.02, line=12)) == 1.0


def patch(rough: float) -> Boundaries:
    """A hundred lines of fifty boundaries; those of lines 50 and on lie farther off than claimed."""
    even = boundaries(5000, claimed=0.05, line=50)
    position = even.position.copy()
    straight = 30.0 + 2.0 * (even.index - 1)
    position[2500:] += (rough - 1.0) * (position - straight)[2500:]
    return replace(even, position=position)


def test_local_scatter() -> None:
    found = estimate_local_scatter(patch(2.0)).reshape(100, 50)
    # Windows of 31 lines: those of the first 35 and the last 35 lines see one kind alone.
    assert np.all(found[:35] == 1.0)
    # Squares of twice a normal deviate, no more than 9, have a mean of 3.114; a window's 230 to 450
    # overlapping fives know its root to 6 %.
    assert np.median(found[65:]) == pytest.approx(np.sqrt(3.114), rel=0.06)
    assert np.all(np.abs(found[65:] / np.sqrt(3.114) - 1.0) < 0.2)
    # One that lies far off alone is none of it.
    stray = boundaries(5000, claimed=0.05, line=50)
    stray.position[2525] += 5.0
    assert np.all(estimate_local_scatter(stray) == 1.0)


def test_insignificant_local_scatter_is_ignored() -> None:
    assert np.all(estimate_local_scatter(patch(1.1)) == 1.0)
    for count in (0, 4, 5):
        assert np.all(estimate_local_scatter(boundaries(count, claimed=0.02)) == 1.0)
