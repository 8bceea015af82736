"""A pair or a pole that moved since the calibration is named, and by how much it moved."""

import numpy as np
import pytest
from ring import ring_of_cameras, ring_rig, ring_views

from bodyscan.arrays import Array
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.registration.drift import Drift, find_drift, observe_pose
from bodyscan.registration.rig_solve import RigSolution, solve_rig

NOISE_PX = 0.03
PLACINGS, CAMERAS = ring_of_cameras()
POLES = {name: name[:2] for name in PLACINGS}


@pytest.fixture(scope="module")
def calibrated() -> RigSolution:
    views, _ = ring_views(PLACINGS, CAMERAS, shots=40, noise_px=NOISE_PX, seed=5)
    return solve_rig(ring_rig(PLACINGS), views, CAMERAS).value


def drift_after(
    calibrated: RigSolution, moved: dict[str, RigidTransform], shots: int = 3, seed: int = 11
) -> Drift:
    """Some boards later, seen by a rig of which `retract` pairs stand elsewhere."""
    now = {name: moved.get(name, RigidTransform.identity()) @ at for name, at in PLACINGS.items()}
    views, _ = ring_views(now, CAMERAS, shots=shots, noise_px=NOISE_PX, seed=seed)
    poses = [observe_pose(view, CAMERAS[view.pair], NOISE_PX) for view in views]
    return find_drift(poses, calibrated.rig_from_camera, calibrated.covariance, POLES)


def about(
    place: Array | list[float], turn_deg: list[float], shift_mm: list[float]
) -> RigidTransform:
    """A motion in the rig frame that turns about `place`."""
    turn = RigidTransform.from_rotation_vector(np.radians(turn_deg), np.zeros(3))
    here = RigidTransform(np.eye(3), np.asarray(place, float))
    shift = RigidTransform(np.eye(3), np.asarray(shift_mm, float))
    return shift @ here @ turn @ here.inverse()


@pytest.mark.parametrize("seed", [11, 12, 13, 14])
def test_a_rig_that_stood_still_is_not_suspected(calibrated: RigSolution, seed: int) -> None:
    drift = drift_after(calibrated, {}, seed=seed)
    assert drift.moves == ()
    # Corners here are independent, and CORRELATED takes three of them for one.
    assert 0.3 < drift.misfit < 1.0


@pytest.mark.parametrize("pair", ["p1-2", "p3-3"])
@pytest.mark.parametrize(
    ("turn_deg", "shift_mm"), [([0, 0, 0], [0.3, -0.4, 0]), ([0.012, 0, 0.016], [0, 0, 0])]
)
def test_half_a_millimetre_or_a_fiftieth_of_a_degree_is_noticed(
    calibrated: RigSolution, pair: str, turn_deg: list[float], shift_mm: list[float]
) -> None:
    motion = about(PLACINGS[pair].translation, turn_deg, shift_mm)
    (move,) = drift_after(calibrated, {pair: motion}, shots=6).moves
    assert move.pairs == (pair,)
    moved = move.motion.apply(PLACINGS[pair].translation) - PLACINGS[pair].translation
    assert np.linalg.norm(moved - shift_mm) < max(4.0 * move.sigma_mm, 0.1)
    assert move.sigma_mm < 0.3


def test_a_pole_that_was_bumped_is_one_move(calibrated: RigSolution) -> None:
    motion = about([-1300.0, 0.0, 0.0], [0.1, 0.05, 0.0], [0.0, 0.0, 0.0])
    pairs = {name: motion for name in PLACINGS if name.startswith("p2")}
    (move,) = drift_after(calibrated, pairs, shots=6).moves
    assert move.name == "pole p2"
    assert set(move.pairs) == set(pairs)
    assert move.turn_deg == pytest.approx(np.degrees(motion.angle), abs=0.01)


def test_a_pair_far_off_is_found_as_well_as_a_pole(calibrated: RigSolution) -> None:
    pole = about([-1300.0, 0.0, 0.0], [0.0, 0.0, 0.05], [0.0, 0.0, 0.0])
    far = about(PLACINGS["p3-2"].translation, [2.0, 0.0, 1.0], [30.0, 10.0, -20.0])
    moved = {name: pole for name in PLACINGS if name.startswith("p2")} | {"p3-2": far}
    drift = drift_after(calibrated, moved, shots=6)
    assert {move.name for move in drift.moves} == {"pole p2", "pair p3-2"}
    farthest = max(drift.moves, key=lambda move: move.shift_mm)
    assert farthest.shift_mm == pytest.approx(np.linalg.norm([30, 10, 20]), abs=0.5)
    assert drift.misfit < 0.1 * drift.misfit_before


def test_a_board_that_one_pair_alone_sees_says_nothing(calibrated: RigSolution) -> None:
    views, _ = ring_views(PLACINGS, CAMERAS, shots=3, noise_px=NOISE_PX, seed=1)
    poses = [observe_pose(v, CAMERAS[v.pair], NOISE_PX) for v in views if v.pair == "p1-1"]
    drift = find_drift(poses, calibrated.rig_from_camera, calibrated.covariance, POLES)
    assert drift.moves == ()
    assert drift.lonely == ("p1-1",)
