"""What the operator is told of motion while pairs saw the subject."""

from __future__ import annotations

import numpy as np
import pytest

from bodyscan.geometry.velocity import SurfaceSpeeds, Velocity
from bodyscan.stripes.one_moment import StripeMotion
from bodyscan.workflows.range_images import motion_notes


def motion(speed_mm: float) -> StripeMotion:
    none = np.empty((0, 3))
    unseen = SurfaceSpeeds(none, none, none[:, 0], none[:, 0], none[:, :1])
    velocity = Velocity(np.zeros(6), np.eye(6), unseen)
    grid = np.zeros((1, 1))
    return StripeMotion(grid, grid, 100, velocity, speed_mm, 5.0, 0.0, 100.0, True)


@pytest.mark.parametrize(
    ("speeds", "timed", "told"),
    [
        ((7.0, 15.0, 9.0), True, False),
        ((70.0, 150.0, 90.0), True, True),  # frame_ms ten times too short
        ((7.0, 150.0, 9.0), True, False),  # one pair's fault is not the clock's
        ((70.0, 150.0, 90.0), False, False),
    ],
)
def test_a_frame_rate_that_makes_people_run_is_named(
    speeds: tuple[float, ...], timed: bool, told: bool
) -> None:
    motions = {f"p{number}": motion(speed) for number, speed in enumerate(speeds)}
    notes = " ".join(motion_notes(motions, timed=timed))
    assert "moved by up to" in notes
    assert ("nobody who stands moves at 90 mm/s" in notes) is told
