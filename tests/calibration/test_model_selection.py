"""Held-out boards choose the model of the light: what is counted, what against what, and how often."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, cast

import numpy as np
import pytest

from bodyscan.arrays import Array, Indices
from bodyscan.calibration.boundary_points import BoundaryPoints
from bodyscan.calibration.model_selection import (
    Candidate,
    HeldOutErrors,
    HeldOutModel,
    ResidualPair,
    compute_shared_weights,
    gain,
    hold_out,
    select_model,
    split,
)
from bodyscan.geometry.light_planes import RayDepths


class AtOneDepth:
    """Sheets that see everything at one depth, with one variance."""

    def __init__(self, depth: float = 0.0, variance: float = 0.0) -> None:
        self._depth, self._variance = depth, variance

    def intersect(self, rays: Array, s: Array) -> RayDepths:
        assert np.all(rays[:, 2] == 1.0)
        return RayDepths(np.full(s.shape, self._depth), s, np.full(s.shape, self._variance))


def boards(
    *sizes: int, numbers: tuple[int, ...] | None = None, tilt: float = 0.0
) -> BoundaryPoints:
    """Square boards of size x size points 10 mm apart, facing the camera from 1 m on, or tilted; one
    boundary for each column."""
    points, board, index = [], [], []
    for number, size in zip(numbers or range(len(sizes)), sizes, strict=True):
        x, y = np.meshgrid(10.0 * np.arange(size), 10.0 * np.arange(size), indexing="ij")
        points += [np.stack([x, y, 1000.0 + 50.0 * number + tilt * x], axis=-1).reshape(-1, 3)]
        board += [number] * size**2
        index += np.repeat(np.arange(size), size).tolist()
    count = len(board)
    across = np.tile([1.0, 0.0, 0.0], (count, 1))
    return BoundaryPoints(
        np.array(index), np.array(board), np.concatenate(points), across, np.full(count, 0.1)
    )


def errors(*distances: Array) -> list[HeldOutErrors]:
    return [HeldOutErrors(one, np.ones_like(one)) for one in distances]


def model(name: str, **keys: bool) -> Candidate:
    return Candidate(name, lambda data: cast(Any, AtOneDepth()), **keys)


def figures_of(data: BoundaryPoints, distances: Array, **keys: bool) -> HeldOutModel:
    (found,) = select_model([model("one", **keys)], errors(distances), data)[1]
    return found


def test_every_board_counts_the_same_however_many_points_it_has() -> None:
    data = boards(6, 3, numbers=(0, 2))
    distances = np.where(data.board == 0, 1.0, -3.0)
    found = figures_of(data, distances)
    assert found.mean_mm == pytest.approx(2.0)  # point by point it would be 1.4
    assert found.median_mm == pytest.approx(1.0)
    assert found.rms_mm == pytest.approx(np.sqrt((36 * 1.0 + 9 * 9.0) / 45))
    assert found.measured == 1.0
    assert found.chosen
    assert found.gain is None


def test_what_was_not_measured_counts_as_far_off_where_a_model_measures_everywhere() -> None:
    data = boards(6, 3)
    distances = np.where(data.board == 0, 2.0, -6.0)
    distances[0], distances[1] = np.nan, 500.0
    found = figures_of(data, distances)
    # Both count for 30 medians.
    assert found.mean_mm == pytest.approx(((34 * 2.0 + 2 * 60.0) / 36 + 6.0) / 2)
    assert found.rms_mm == pytest.approx(np.sqrt((34 * 4.0 + 9 * 36.0) / 43))  # outliers apart
    assert found.measured == pytest.approx(44 / 45)
    found = figures_of(data, distances, complete=False)
    assert found.mean_mm == pytest.approx(((34 * 2.0 + 60.0) / 35 + 6.0) / 2)


def warped(data: BoundaryPoints, amount: float) -> Array:
    """Noise of 1 mm, and a bend of each board that no shift and no tilt makes up for."""
    _, across, down = data.board_errors.effects.T
    noise = np.random.default_rng(0).normal(size=len(data.index))
    return np.asarray(noise + amount * across * down)


def test_a_richer_model_is_taken_where_it_is_clearly_better_and_only_there() -> None:
    data = boards(12, 12, 12, 12)
    plain, good = warped(data, 0.5), warped(data, 0.0)
    names = [model("plain"), model("good"), model("as good")]
    # As good: the difference is noise of its own, which is at no point better than chance.
    as_good = good + 0.02 * np.random.default_rng(1).normal(size=len(good))
    chosen, (first, second, third) = select_model(names, errors(plain, good, as_good), data)
    assert chosen == 1
    assert [one.chosen for one in (first, second, third)] == [False, True, False]
    assert first.gain is None
    assert second.gain is not None
    assert second.gain > 3.0
    assert third.gain is not None  # against the good one, not the plain one, which it beats
    assert abs(third.gain) < 3.0
    # The other way round nothing is gained by any.
    chosen, figures = select_model(names, errors(good, plain, as_good), data)
    assert chosen == 0
    assert figures[1].gain is not None
    assert figures[1].gain < -1.0


def test_a_model_that_measured_nothing_is_not_listed() -> None:
    data = boards(12, 12)
    nothing = np.full(len(data.index), np.nan)
    chosen, figures = select_model(
        [model("plain"), model("empty")], errors(warped(data, 0.5), nothing), data
    )
    assert chosen == 0
    assert [one.model for one in figures] == ["plain"]


def test_where_a_model_gives_nothing_for_seldom_stripes_others_are_compared_elsewhere() -> None:
    data = boards(12, 12, 12, 12)
    plain, good = warped(data, 0.5), warped(data, 0.0)
    good[::3] = np.nan
    seldom = [model("plain"), model("seldom", complete=False)]
    assert select_model(seldom, errors(plain, good), data)[0] == 1
    # Of one that should have measured these, each counts as far off.
    assert select_model([model("plain"), model("good")], errors(plain, good), data)[0] == 0


def test_boards_are_held_out_in_six_groups_and_two_boards_by_halves() -> None:
    data = boards(*[3] * 7)
    folds = split(data)
    out = [set(data.board[fold].tolist()) for fold in folds]
    assert sorted(map(sorted, out)) == [[0, 6], [1], [2], [3], [4], [5]]
    assert len(split(boards(3, 3, 3))) == 3
    two = boards(4, 4)
    folds = split(two)
    assert len(folds) == 4
    assert np.all(np.sum(folds, axis=0) == 1)
    assert all(np.count_nonzero(fold) == 8 for fold in folds)
    assert all(len(set(two.board[fold].tolist())) == 1 for fold in folds)


def test_what_is_left_out_is_measured_by_a_model_that_has_not_seen_it() -> None:
    data = boards(3, 3, 3, tilt=0.5)
    seen: list[Indices] = []

    def fit(rest: BoundaryPoints) -> Any:
        seen.append(np.unique(rest.board))
        return AtOneDepth(1020.0 + len(seen))

    found = hold_out(Candidate("one", fit), data, split(data))
    assert [one.tolist() for one in seen] == [[1, 2], [0, 2], [0, 1]]
    depth = 1021.0 + data.board
    # Across a board tilted by atan(1/2): its normal is (-1, 0, 2) / sqrt 5, met by the ray p / z.
    normal = np.array([-1.0, 0.0, 2.0]) / np.sqrt(5.0)
    facing = (data.points / data.points[:, 2:]) @ normal
    np.testing.assert_allclose(found.distances, (depth - data.points[:, 2]) * facing, rtol=1e-9)


@pytest.mark.parametrize("noise", [0.0, 0.15])
@pytest.mark.parametrize("variance", [0.0, 2.0])
def test_the_boards_error_is_estimated_apart_from_the_points_noise(
    noise: float, variance: float
) -> None:
    data = boards(*[20] * 6, tilt=1.0)
    # Shift and two tilts, of standard deviation 1 each, and what sheets are wrong by, times facing.
    facing = data.board_errors.facing
    unit = 3.0 + variance * float(np.mean(facing**2))
    rng = np.random.default_rng(0)
    off = 0.2 * np.sqrt(unit) * np.where(data.board % 2, 1.0, -1.0)
    off += noise * rng.normal(size=len(off))
    sheets = Candidate("one", lambda rest: cast(Any, AtOneDepth(1000.0, variance)))
    found = replace(hold_out(sheets, data, split(data)), distances=off)
    # The spread of 2,280 differences is known to 2 %; noise left in would add 10 % or more.
    assert found.board_error_mm(data) == pytest.approx(0.2, rel=0.03)


@pytest.mark.parametrize(
    ("cluster_size", "sign", "mean"),
    [
        # d = 0.1 at 1,600 points: sum d^2 = 16, standard error 2 sqrt(16) = 8.
        (1, 1.0, 2.0),
        (1, -1.0, -2.0),
        # Sixteen share their error: the error is four times as large.
        (16, 1.0, 0.5),
    ],
)
def test_gains_are_standard_errors(cluster_size: int, sign: float, mean: float) -> None:
    """Models differ by a tenth of a sigma, the nearer one right; errors are equal in a cluster."""
    found = []
    for seed in range(150):
        rng = np.random.default_rng(seed)
        noise = rng.normal(size=(1600 // cluster_size, 2)).repeat(cluster_size, axis=0)
        wrong = noise + [0.1, 0.0]
        simple, rich = (wrong, noise) if sign > 0 else (noise, wrong)
        # In other units nothing changes.
        pair = ResidualPair(10.0 * simple, 10.0 * rich, np.arange(1600) // cluster_size)
        found.append(gain(pair))
    # 150 of them: the mean is known to 0.08, their deviation to 6 %.
    assert np.mean(found) == pytest.approx(mean, abs=0.25)
    assert np.std(found) == pytest.approx(1.0, abs=0.15)


def test_what_no_model_explains_counts_for_less() -> None:
    one, other = np.ones((9, 2)), np.ones((9, 2))
    one[0], other[0] = 4.0 * 1.4826, -9.0  # four sigmas off in the better model
    one[1] = 50.0  # in one model alone
    weights = compute_shared_weights([one, other])
    assert weights.shape == (9,)
    usual = 1.0 / (1.0 + 2.0 / (4.0 * 1.4826) ** 2)
    np.testing.assert_allclose(weights[2:], usual)
    assert weights[1] == pytest.approx(usual)
    assert weights[0] == pytest.approx(1.0 / 3.0)  # u and v together: twice 4 sigmas squared
