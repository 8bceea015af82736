"""Which links hold a rig together, and which further shots are suggested."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from ring import CHARUCO, ring_of_cameras, ring_rig, ring_views

from bodyscan.boards.board_layout import corner_points, corners_per_face
from bodyscan.calibration.board_views import LocatedView
from bodyscan.geometry.camera import Camera
from bodyscan.geometry.lenses.opencv import Radial
from bodyscan.geometry.linear_gaussian import invert_scaled
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.geometry.uncertainty import position_sigma
from bodyscan.registration.advice import (
    Advice,
    Link,
    ShotSuggestion,
    advise,
    find_articulation_shots,
    find_links,
    minimum_spanning_links,
)
from bodyscan.registration.more_shots import (
    BoardCandidate,
    RigInformation,
    candidate_azimuths,
    propose_board_poses,
)
from bodyscan.registration.normal_equations import NormalEquations, normal_equations
from bodyscan.registration.rig_frame import nominal_pose
from bodyscan.registration.rig_solve import RigSolution, solve_rig
from bodyscan.rig.board import Board
from bodyscan.rig.pair import NominalPose
from bodyscan.rig.rig import Rig, Volume

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
    assert len(minimum_spanning_links(find_links(placed))) == len(sigmas) - 1
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
    links = find_links(placed)
    assert {links[0].first[:2], links[0].second[:2]} == {"p1", "p3"}
    assert advice.weak[0].sigma_mm > 2 * np.median(
        [link.sigma_mm for link in minimum_spanning_links(links)]
    )
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
    held = equations.fixed[equations.fixed < equations.first_board]
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


def more(**changes: Any) -> ShotSuggestion:
    views = tuple(
        tuple(cast(Any, SimpleNamespace(pair=name)) for name in names)
        for names in (("a", "b", "c"), ("c", "b", "a", "d"))
    )
    place = BoardCandidate(
        "knee", np.array([10.0, -20.0, 499.6]), 91.0, (RigidTransform.identity(),), views
    )
    keys = {"pair": "a", "shots": 3, "between": ("a", "b"), "candidate": place, "before_mm": 0.5,
            "after_mm": 0.24, "halves": True}  # fmt: skip
    return ShotSuggestion(**cast(Any, keys | changes))


def advice(
    *bridges: Link, weak: tuple[Link, ...] = (), shots: ShotSuggestion | None = None
) -> list[str]:
    crucial = (("s1", "b"), ("s4", "b")) if bridges else ()
    return Advice(bridges, weak, crucial, "d", 0.3123, shots).lines


def test_what_alone_ties_a_rig_together_is_told_first() -> None:
    assert advice(
        Link("a", "b", 1, 0.2), Link("a", "c", 4, 0.1), weak=(Link("c", "d", 2, 0.9),)
    ) == [
        "a and b, with 1 shot in common, are the only link between two parts of the rig",
        "a and c, with 4 shots in common, are the only link between two parts of the rig",
        "without any one of these shots the rig is disconnected: s1 (b), s4 (b)",
        "weak link: sigma of d relative to c is 0.900 mm (2 shots in common), and no other link "
        "between their parts is better",
        "d has the largest sigma in the rig frame: 0.312 mm",
    ]
    assert len(advice()) == 1


def said(**changes: Any) -> str:
    return advice(shots=more(**changes))[-1]


def test_further_shots_are_told_with_where_to_hold_the_board() -> None:
    assert said() == (
        "3 more shots seen by both a and b (also by c), board at knee height (middle at 10, -20, 500 "
        "mm, facing the subject's left, tilted in turn in all directions), would halve the sigma of "
        "a: 0.500 to 0.240 mm"
    )
    assert "would improve a, though not by half: 0.500 to 0.300" in said(after_mm=0.3, halves=False)
    assert said(shots=1).startswith("1 more shot seen")
    assert said(after_mm=0.4).startswith("3 more shots seen")  # four fifths is worth it
    assert said(after_mm=0.401) == (
        "further shots of this board would improve a little: 3 more reduce its sigma from 0.500 to "
        "0.401 mm"
    )


def test_a_place_is_seen_by_those_who_see_every_tilt() -> None:
    place = more().candidate
    assert place.visible_to == ("a", "b", "c")
    two = place.restrict_to(("a", "d"))
    assert two.visible_to == ("a",)
    assert [len(tilt) for tilt in two.views] == [1, 2]


def test_the_best_chain_leaves_out_what_others_do_better() -> None:
    links = [
        Link("a", "b", 3, 0.1), Link("b", "c", 3, 0.3), Link("a", "c", 9, 0.4), Link("c", "d", 1, 2.0),
    ]  # fmt: skip
    assert minimum_spanning_links(links) == (links[3], links[1], links[0])
    assert minimum_spanning_links([]) == ()


CAMERA = Camera(900.0, 900.0, 0.0, 319.5, 239.5, Radial(), 640, 480)
BOARD = Board(name="b", kind="checkerboard", columns=9, rows=7, square_mm=40)


def stood(azimuth_deg: float, height_mm: float = 1000.0, away_mm: float = 1500.0) -> RigidTransform:
    """A camera that looks at the rig's axis."""
    at = np.radians(azimuth_deg)
    place = (away_mm * np.cos(at), away_mm * np.sin(at), height_mm)
    return nominal_pose(NominalPose(position_mm=place, look_at_mm=(0.0, 0.0, height_mm)))


def test_boards_face_halfway_between_any_two_cameras_in_steps_of_15_degrees() -> None:
    found = np.degrees(candidate_azimuths([stood(0.0), stood(60.0), stood(130.0)], two_faced=False))
    np.testing.assert_allclose(found, [30.0, 60.0, 90.0])  # 65 and 95 lie nearer to these
    # However far away either stands.
    apart = [stood(0.0), stood(60.0, away_mm=500.0)]
    np.testing.assert_allclose(np.degrees(candidate_azimuths(apart, two_faced=False)), [30.0])
    # Opposite each other they have no way between; of two faces either will do.
    np.testing.assert_allclose(candidate_azimuths([stood(0.0), stood(180.0)], two_faced=False), [])
    behind = [stood(200.0), stood(260.0)]
    np.testing.assert_allclose(
        np.degrees(candidate_azimuths(behind, two_faced=False)), [225.0 + 0.0]
    )
    np.testing.assert_allclose(np.degrees(candidate_azimuths(behind, two_faced=True)), [45.0])


def test_places_are_those_that_two_pairs_would_see_within_the_volume() -> None:
    placed = {"a": stood(-25.0), "b": stood(25.0), "c": stood(180.0)}
    places = propose_board_poses(BOARD, Volume(), dict.fromkeys(placed, CAMERA), placed)
    assert places
    heights = {"knee": 500.0, "waist": 1000.0, "chest": 1350.0}
    assert {place.height for place in places} <= set(heights)
    for place in places:
        assert set(place.visible_to) == {"a", "b"}
        assert place.facing_deg == pytest.approx(0.0)
        assert place.centre_mm[2] == heights[place.height]
    radius = Volume().radius_mm
    along = sorted(place.centre_mm[0] for place in places if place.height == "waist")
    np.testing.assert_allclose(along, [-0.35 * radius, 0.0, 0.35 * radius])
    alone = {"a": placed["a"], "c": placed["c"]}
    assert not propose_board_poses(BOARD, Volume(), dict.fromkeys(alone, CAMERA), alone)
