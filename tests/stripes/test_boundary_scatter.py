"""How far boundaries estimate_scatter against what they claim, on runs of a known estimate_scatter."""

from __future__ import annotations

import numpy as np
import pytest

from bodyscan.stripes.boundaries import Boundaries
from bodyscan.stripes.stripe_coordinates import estimate_scatter


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
