"""Where pairs stand by the boards they share, and which views and pairs do not go along."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from bodyscan.calibration.board_views import LocatedView
from bodyscan.errors import RigDisconnected
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.registration.view_graph import (
    build_view_graph,
    find_initial_poses,
    locate_boards_jointly,
)

PLACED = {
    "a": RigidTransform.identity(),
    "b": RigidTransform.from_rotation_vector([0.0, 0.4, 0.0], [-500.0, 0.0, 80.0]),
    "c": RigidTransform.from_rotation_vector([0.0, -0.5, 0.1], [480.0, 30.0, 60.0]),
}
AWAY_MM = 1000.0
POINTS = np.array([[40.0 * (k % 4), 40.0 * (k // 4), 0.0] for k in range(12)])


def board(shot: int) -> RigidTransform:
    rng = np.random.default_rng(shot)
    turn, shift = rng.uniform(-0.4, 0.4, 3), rng.uniform(-100.0, 100.0, 3)
    return RigidTransform.from_rotation_vector(turn, shift + [0.0, 0.0, AWAY_MM])


def view(pair: str, shot: int, aside_mm: float = 0.0, corners: int = 12) -> LocatedView:
    """aside_mm: how far from where it stood the board is seen."""
    moved = RigidTransform(np.eye(3), np.array([0.6, 0.8, 0.0]) * aside_mm)
    seen = PLACED[pair].inverse() @ moved @ board(shot)
    points = POINTS[:corners]
    return LocatedView(pair, f"s{shot}", "board", points, points[:, :2], seen)


def test_pairs_are_tied_by_the_boards_they_saw_at_one_moment() -> None:
    graph = build_view_graph(
        [view("a", 1), view("b", 1), view("b", 2), view("c", 2), view("a", 3)], "abcd"
    )
    assert sorted(map(sorted, graph.edges)) == [["a", "b"], ["b", "c"]]
    assert graph.edges["a", "b"]["targets"] == [("s1", "board")]
    assert set(graph.nodes) == set("abcd")


def test_poses_follow_along_a_chain_of_shared_boards() -> None:
    views = [view(pair, shot) for shot in (1, 2) for pair in "ab"]
    views += [view(pair, shot) for shot in (3, 4) for pair in "bc"]
    found, left_out = find_initial_poses(views, "abc")
    assert not left_out
    for one, other in (("a", "b"), ("a", "c")):
        np.testing.assert_allclose(
            (found[one].inverse() @ found[other]).matrix,
            (PLACED[one].inverse() @ PLACED[other]).matrix,
            atol=1e-6,
        )


def test_a_pair_whose_pictures_were_taken_at_other_moments_is_left_out() -> None:
    views = [view(pair, shot) for shot in range(1, 6) for pair in "ab"]
    views += [view("c", shot, 150.0 * shot) for shot in range(1, 6)]
    found, left_out = find_initial_poses(views, "abc")
    assert set(found) == {"a", "b"}
    assert "c" in left_out["c"]
    with pytest.raises(
        RigDisconnected, match=r"pose of a, c that .*differs from shot to shot.*taken together"
    ):
        find_initial_poses([v for v in views if v.pair != "b"], "ac")


def test_three_shots_that_agree_are_a_start_where_as_many_do_on_something_else() -> None:
    aside = [0.0, 10.0, 5.0, 0.0, 200.0, 400.0, 600.0, 605.0, 600.0]
    views = [view(pair, k, aside[k] * (pair == "c")) for k in range(9) for pair in "ac"]
    found, left_out = find_initial_poses(views, "ac")
    assert not left_out
    assert np.linalg.norm(found["c"].translation - found["a"].apply(PLACED["c"].translation)) < 20.0


def test_a_board_stands_where_most_corners_say_and_a_view_far_off_is_doubtful() -> None:
    """A twelfth of the distance, 80 mm, is doubtful; a twenty-fifth agrees."""
    for aside_mm, doubted in ((70.0, False), (90.0, True)):
        views = [view("a", 1), view("b", 1), view("c", 1, aside_mm), view("a", 2)]
        kept, boards, doubtful = locate_boards_jointly(views, PLACED)
        assert len(kept) == 4
        np.testing.assert_allclose(boards["s1", "board"].matrix, board(1).matrix, atol=1e-6)
        assert doubtful == ({("s1", "board")} if doubted else set())
    few = [view("a", 1, 100.0, corners=8), view("b", 1), view("c", 1, 100.0, corners=3)]
    _, boards, _ = locate_boards_jointly(few, PLACED)
    assert np.linalg.norm(boards["s1", "board"].translation - board(1).translation) < 1e-6
    more = [view("a", 1, 100.0, corners=8), view("b", 1), view("c", 1, 130.0, corners=6)]
    _, boards, _ = locate_boards_jointly(more, PLACED)
    assert np.linalg.norm(boards["s1", "board"].translation - board(1).translation) > 90.0


def test_a_board_numbered_from_its_other_end_is_numbered_as_the_other_pairs_see_it() -> None:
    from_there = RigidTransform(np.diag([-1.0, -1.0, 1.0]), np.array([120.0, 80.0, 0.0]))
    either = RigidTransform.identity(), from_there
    views = [replace(view(pair, 1), alternatives=either) for pair in "abc"]
    views[2] = replace(views[2].resolve(from_there), alternatives=either)
    kept, boards, doubtful = locate_boards_jointly(views, PLACED)
    assert not doubtful
    for one in kept:
        assert not one.ambiguous
        seen = PLACED[one.pair] @ one.camera_from_board
        np.testing.assert_allclose(seen.matrix, boards["s1", "board"].matrix, atol=1e-6)
        np.testing.assert_allclose(one.points, kept[0].points, atol=1e-9)


def test_one_board_with_one_numbering_ties_two_pairs() -> None:
    """Nothing contradicts it, so its one vote is most."""
    found, left_out = find_initial_poses([view("a", 1), view("b", 1)], "ab")
    assert not left_out
    between = (found["a"].inverse() @ found["b"]).matrix
    # Both views are exact: rounding of 1 m is left.
    np.testing.assert_allclose(between, PLACED["b"].matrix, atol=1e-6)
