"""Wrong views out and back in, round after round, and how the wrong ones are told."""

from __future__ import annotations

from collections.abc import Iterator, Sequence, Set
from typing import Any

import numpy as np
import pytest

from bodyscan.boards.view import ViewKey
from bodyscan.calibration.board_views import LocatedView
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.geometry.uncertainty import PoseCovariance
from bodyscan.outcome import Outcome
from bodyscan.registration import view_consistency
from bodyscan.registration.joint_solve import JointSolution
from bodyscan.registration.rig_solve import RigSolution, collect_corners
from bodyscan.registration.view_consistency import ConsistentSolve, solve_consistently

BEFORE = RigidTransform.from_rotation_vector([0.0, 0.1, 0.0], [10.0, 0.0, 900.0])


def view(number: int) -> LocatedView:
    points = np.zeros((4, 3))
    shift = RigidTransform(np.eye(3), np.array([float(number), 0.0, 0.0]))
    return LocatedView("p", f"s{number}", "b", points, points[:, :2], shift)


VIEWS = [view(number) for number in range(8)]
START = JointSolution({"p": BEFORE}, {("s0", "b"): BEFORE, ("gone", "b"): BEFORE}, {})


def solve(
    monkeypatch: pytest.MonkeyPatch, judged: Sequence[set[int]], wrong: Set[int] = frozenset()
) -> tuple[ConsistentSolve, list[set[int]]]:
    """With what each round finds wrong; and which views each solve was given."""
    given: list[set[int]] = []
    rounds: Iterator[set[int]] = iter(judged)

    def fully(views: Sequence[LocatedView], start: JointSolution, **keys: Any) -> JointSolution:
        given.append({int(one.shot[1:]) for one in views})
        assert keys == {"root": "p"}
        # Each board that is seen starts where it was, or where its own view has it; no other does.
        assert start.root_from_board.keys() == {one.target for one in views}
        for one in views:
            expected = BEFORE if one.shot == "s0" else BEFORE @ one.camera_from_board
            assert np.array_equal(start.root_from_board[one.target].matrix, expected.matrix)
        return START

    def judge(views: Sequence[LocatedView], solution: JointSolution, limit_px: float) -> Any:
        assert list(views) == VIEWS, "those that are out are judged as well"
        assert limit_px == 0.7
        out = next(rounds)
        return Outcome([VIEWS[k] for k in sorted(out)], (f"{sorted(out)}",))

    monkeypatch.setattr(view_consistency, "refine_solution", fully)
    monkeypatch.setattr(view_consistency, "find_inconsistent_views", judge)
    found = solve_consistently(VIEWS, START, root="p", limit_px=0.7, wrong=keys_of(wrong))
    return found, given


def keys_of(numbers: Set[int]) -> set[ViewKey]:
    return {VIEWS[k].key for k in numbers}


ALL = set(range(8))


@pytest.mark.parametrize(
    ("before", "judged", "without", "wrong"),
    [
        (set(), [set()], [set()], set()),
        (set(), [{3}, {3}], [set(), {3}], {3}),
        (set(), [{3, 5}, {3}, {3}], [set(), {3, 5}, {3}], {3}),  # a view that fits after all
        ({2}, [set(), set()], [{2}, set()], set()),
        # From the third round on none comes back.
        (set(), [{3}, {5}, {3}, {5}], [set(), {3}, {5}, {3, 5}], {3, 5}),
        # Where most views are wrong no further solve follows.
        ({7}, [{0, 1, 2, 3, 4}], [{7}], {0, 1, 2, 3, 4, 7}),
        (set(), [{0, 1, 2, 3}, {0, 1, 2, 3}], [set(), {0, 1, 2, 3}], {0, 1, 2, 3}),
    ],
)
def test_wrong_views_are_left_out_and_come_back_where_they_fit(
    before: set[int],
    judged: list[set[int]],
    without: list[set[int]],
    wrong: set[int],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """judged: the wrong views that each round finds; without: those that each solve leaves out."""
    found, given = solve(monkeypatch, judged, wrong=before)
    assert given == [ALL - out for out in without]
    assert found.wrong == keys_of(wrong)
    assert found.notes == (f"{sorted(judged[-1])}",)
    assert found.select_consistent(VIEWS) == [one for k, one in enumerate(VIEWS) if k not in wrong]


class PinholeOfOne:
    """Focal length 1 px, origin in the middle."""

    def project(self, points: np.ndarray) -> np.ndarray:
        return np.asarray(points[:, :2] / points[:, 2:])


def test_what_a_camera_saw_is_told_corner_by_corner_with_its_targets_number() -> None:
    boards = {("s1", "b"): BEFORE, ("s0", "b"): BEFORE, ("s0", "a"): BEFORE}
    one = RigidTransform.identity()
    points = np.array([[0.0, 0.0, 0.0], [90.0, 0.0, 0.0], [0.0, 90.0, 0.0]])
    there = PinholeOfOne().project(BEFORE.apply(points))
    views = [
        LocatedView("q", "s1", "b", points, there + 0.5, one),
        LocatedView("p", "s0", "b", points[:2], there[:2] + [0.25, -0.5], one),
        LocatedView("q", "s0", "a", points[:1], there[:1], one),
    ]
    cameras: Any = {"p": PinholeOfOne(), "q": PinholeOfOne()}
    unknown = PoseCovariance((), np.zeros((0, 0)))
    placed = RigSolution(dict.fromkeys("pqr", one), boards, cameras, unknown, tuple(views), {})
    found = collect_corners(placed, ["q", "p", "r", "unplaced"])
    assert set(found) == {"p", "q"}, "r saw nothing"
    assert found["p"].target.tolist() == [1, 1]  # of (s0, a), (s0, b), (s1, b)
    assert found["q"].target.tolist() == [2, 2, 2, 0]
    np.testing.assert_allclose(found["p"].residuals_px, [[-0.25, 0.5]] * 2, atol=1e-6)
    np.testing.assert_allclose(found["q"].pixels[:3], there + 0.5, rtol=1e-6)
    np.testing.assert_allclose(found["q"].residuals_px[3], 0.0, atol=1e-6)
