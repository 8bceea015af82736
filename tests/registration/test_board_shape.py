"""A board that is bent, or printed a little too wide, is found out; a good one is left alone."""

from __future__ import annotations

import numpy as np
import pytest
from ring import CHARUCO, ring_of_cameras, ring_rig, ring_views, rms_mm, seen_anew

from bodyscan.arrays import Array
from bodyscan.calibration.board_views import LocatedView
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.outcome import Outcome
from bodyscan.registration.rig_solve import RigSolution, solve_rig

Placed = tuple[Outcome[RigSolution], Outcome[RigSolution]]
PLACINGS, CAMERAS = ring_of_cameras(heights=(700, 1200))


def really(points: Array) -> Array:
    """Where the corners of a bent board lie whose print is 1 per mille too wide."""
    x, y, z = points.T
    middle = 315.0
    bow = 1.0 - ((x - middle) / 315.0) ** 2
    return np.column_stack([middle + 1.001 * (x - middle), y, z + bow])


def bent_views(moved_mm: float = 0.0) -> tuple[list[LocatedView], list[LocatedView]]:
    """`ring_views` of that board, and of the flat one; moved_mm: sigma of what it moves by between
    the pictures of one shot."""
    rng = np.random.default_rng(3)
    flat, truth = ring_views(PLACINGS, CAMERAS, shots=30)
    bent = []
    for view in flat:
        moved = RigidTransform.from_translation(rng.normal(0.0, moved_mm, 3)) @ truth[view.target]
        there = PLACINGS[view.pair].inverse() @ moved
        bent.append(seen_anew(view, CAMERAS[view.pair], there, rng, really(view.points)))
    return bent, flat


@pytest.fixture(scope="module")
def placed() -> Placed:
    bent, flat = bent_views()
    rig = ring_rig(PLACINGS)
    return solve_rig(rig, bent, CAMERAS), solve_rig(rig, flat, CAMERAS)


def test_a_bent_board_is_found_out_by_cameras_that_are_not_synchronised() -> None:
    found = solve_rig(ring_rig(PLACINGS), bent_views(moved_mm=4.0)[0], CAMERAS)
    assert "not taken together" in found.notes[0]
    assert found.value.board_shapes["board"].out_of_plane_mm == pytest.approx(0.605, abs=0.06)


def test_the_bend_and_the_stretch_are_measured(placed: Placed) -> None:
    bent, _ = placed
    shape = bent.value.board_shapes[CHARUCO.name]
    found = shape.points + shape.offsets
    true = really(shape.points)
    gaps = np.linalg.norm(found[:, None] - found, axis=2)
    true_gaps = np.linalg.norm(true[:, None] - true, axis=2)
    size = np.sum(gaps * true_gaps) / np.sum(gaps**2)  # pictures cannot tell the size
    assert np.sqrt(np.mean((size * gaps - true_gaps) ** 2)) < 0.03
    # Inner corners reach 245 of 315 mm from the middle: 0.605 mm of the bow, and so far for each face.
    assert shape.out_of_plane_mm == pytest.approx(0.605, abs=0.08)
    across, down = shape.stretch
    assert across - down == pytest.approx(1e-3, abs=1e-4)
    assert any("used, boards held out" in note and "mm out of plane" in note for note in bent.notes)


def test_the_rig_is_as_good_as_with_a_flat_board(placed: Placed) -> None:
    bent, flat = placed
    # The size of the board is 0.3 per mille off on average, so are the distances of the cameras.
    assert rms_mm(bent.value, PLACINGS) < 2.0 * rms_mm(flat.value, PLACINGS) + 1e-3 * 1300.0
    assert max(bent.value.rms_px.values()) < 1.1 * max(flat.value.rms_px.values())


def test_a_flat_board_is_left_alone(placed: Placed) -> None:
    _, flat = placed
    assert not flat.value.board_shapes
    assert not flat.notes
