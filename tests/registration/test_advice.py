import numpy as np
import pytest
from ring import CHARUCO, ring_of_cameras, ring_rig, ring_views

from bodyscan.boards.board_layout import corner_points, corners_per_face
from bodyscan.calibration.board_views import LocatedView
from bodyscan.geometry.camera import Camera
from bodyscan.geometry.linear_gaussian import invert_scaled
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.geometry.uncertainty import position_sigma
from bodyscan.registration.advice import advise, find_articulation_shots
from bodyscan.registration.more_shots import BoardCandidate, RigInformation
from bodyscan.registration.normal_equations import NormalEquations, normal_equations
from bodyscan.registration.rig_solve import RigSolution, solve_rig
from bodyscan.rig.rig import Rig

NOISE_PX = 0.03


Ring = tuple[
    Rig,
    dict[str, RigidTransform],
    dict[str, Camera],
    list[LocatedView],
    dict[tuple[str, str], RigidTransform],
    RigSolution,
]


@pytest.fixture(scope="module")
def ring() -> Ring:
    placings, cameras = ring_of_cameras()
    views, truth = ring_views(placings, cameras, noise_px=NOISE_PX)
    rig = ring_rig(placings)
    return rig, placings, cameras, views, truth, solve_rig(rig, views, cameras).value


def equations_of(placed: RigSolution, *, by_board: bool = False) -> NormalEquations:
    """In the frame of the ring's first pair, or of a board."""
    return normal_equations(
        placed.views,
        placed.cameras,
        placed.rig_from_camera,
        placed.rig_from_board,
        fixed_pair=None if by_board else "p1-1",
        fixed_target=min(placed.rig_from_board) if by_board else None,
        cameras_free=True,
    )


def captured(
    place: BoardCandidate,
    count: int,
    placings: dict[str, RigidTransform],
    cameras: dict[str, Camera],
    rng: np.random.Generator,
) -> list[LocatedView]:
    """`count` shots of the board as advised, imaged by the true cameras at their true places."""
    corners, per_face = corner_points(CHARUCO), corners_per_face(CHARUCO)
    views = []
    for shot in range(count):
        tilt = shot % len(place.rig_from_board)
        for seen in place.views[tilt]:
            front = seen.points[0, 2] < 1.0
            points = corners[:per_face] if front else corners[-per_face:]
            points = points[[np.any(np.all(p == seen.points, axis=1)) for p in points]]
            pose = placings[seen.pair].inverse() @ place.rig_from_board[tilt]
            pixels = cameras[seen.pair].project(pose.apply(points))
            noisy = pixels + rng.normal(0.0, NOISE_PX, pixels.shape)
            views.append(LocatedView(seen.pair, f"more{shot}", "board", points, noisy, pose))
    return views


def test_shots_as_advised_do_halve_the_sigma(ring: Ring) -> None:
    rig, placings, cameras, views, _, placed = ring
    more = advise(rig, placed).more
    assert more is not None
    assert more.halves
    assert more.after_mm <= more.before_mm / 2
    extra = captured(more.candidate, more.shots, placings, cameras, np.random.default_rng(5))
    again = solve_rig(rig, [*views, *extra], cameras).value
    centre = again.rig_from_camera[more.pair].translation
    sigma = np.linalg.norm(position_sigma(again.covariance, more.pair, centre))
    # The noise is estimated anew and robust weights shift a little: 10 %.
    assert sigma == pytest.approx(more.after_mm, rel=0.1)


def test_what_is_told_to_be_gained_is_gained_by_as_many_shots_as_are_told(ring: Ring) -> None:
    rig, _, _, _, _, placed = ring
    more = advise(rig, placed).more
    assert more is not None
    knowledge = RigInformation(equations_of(placed), placed.cameras, placed.rig_from_camera)
    told = knowledge.after(knowledge.information(more.candidate), more.pair, more.shots)
    assert told.shots_to_halve == more.shots
    gained = np.sqrt(told.after_mm2[-1] / told.before_mm2)
    assert more.after_mm == pytest.approx(gained * more.before_mm)


def test_the_worst_pair_is_that_of_the_covariance(ring: Ring) -> None:
    rig, _, _, _, _, placed = ring
    advice = advise(rig, placed)
    sigmas = {
        name: np.linalg.norm(position_sigma(placed.covariance, name, t.translation))
        for name, t in placed.rig_from_camera.items()
    }
    assert advice.worst == max(sigmas, key=lambda name: sigmas[name])
    assert advice.more is not None
    assert advice.more.before_mm == pytest.approx(sigmas[advice.worst], rel=1e-6)
    assert len(advice.chain) == len(sigmas) - 1
    assert not advice.bridges
    assert not advice.crucial
    assert set(advice.more.between) <= set(advice.more.candidate.visible_to)
    assert f"seen by both {' and '.join(advice.more.between)}" in advice.lines[-1]


def test_links_that_nothing_doubles_are_named() -> None:
    placings, cameras = ring_of_cameras(heights=(700, 1200))
    views, _ = ring_views(placings, cameras, shots=30)
    # The third pole sees the board together with the others in one shot only.
    mixed = {v.shot for v in views if v.pair == "p3-2"} & {
        v.shot for v in views if v.pair == "p1-2"
    }
    bridge = min(mixed)
    kept = [
        v
        for v in views
        if (v.shot == bridge and v.pair in ("p1-2", "p3-2"))
        or (v.shot != bridge and (v.pair[:2] == "p3") == (int(v.shot[1:]) % 2 == 0))
    ]
    rig = ring_rig(placings)
    placed = solve_rig(rig, kept, cameras).value
    advice = advise(rig, placed)
    # p3-1 hangs on p3-2 alone as well, by more shots.
    assert ("p1-2", "p3-2", 1) in [(link.first, link.second, link.shots) for link in advice.bridges]
    assert all({"p3-2"} & {link.first, link.second} for link in advice.bridges)
    assert find_articulation_shots(placed) == ((bridge, "board"),)
    # One shot ties it: by far the least known link, and the advice is to tie that pole again.
    assert {advice.links[0].first[:2], advice.links[0].second[:2]} == {"p1", "p3"}
    assert advice.weak[0].sigma_mm > 2 * np.median([link.sigma_mm for link in advice.chain])
    assert {advice.weak[0].first[:2], advice.weak[0].second[:2]} == {"p1", "p3"}
    assert advice.worst.startswith("p3")
    assert advice.more is not None
    assert any(name.startswith("p3") for name in advice.more.between)
    assert not all(name.startswith("p3") for name in advice.more.between)
    assert advice.more.shots <= 3
    assert bridge in "\n".join(advice.lines)


@pytest.mark.parametrize("by_board", [False, True])
def test_eliminating_boards_keeps_the_covariance(ring: Ring, by_board: bool) -> None:
    placed = ring[-1]
    equations = equations_of(placed, by_board=by_board)
    held = equations.held[equations.held < equations.first_board]
    information = equations.without_boards().information
    free = np.setdiff1d(np.arange(len(information)), held)
    inverse = equations.variance_px2 * invert_scaled(information[np.ix_(free, free)])
    moving = free[free < equations.first_board]
    every = invert_scaled(equations.system.information[np.ix_(equations.free, equations.free)])
    place = np.searchsorted(equations.free, moving)
    expected = equations.variance_px2 * every[np.ix_(place, place)]
    scale = np.sqrt(np.diag(expected))
    got = inverse[: len(moving), : len(moving)]
    # The unknowns' correlations lose half of double precision's digits.
    np.testing.assert_allclose(got / np.outer(scale, scale), expected / np.outer(scale, scale),
                               atol=1e-5)  # fmt: skip
