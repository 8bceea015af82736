"""How much more than independent corners boards err, seen from their vectors on what was solved."""

from __future__ import annotations

import numpy as np
import pytest

from bodyscan.calibration.board_views import LocatedView
from bodyscan.geometry.linear_gaussian import LinearGaussianSystem
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.registration.cluster_covariance import (
    ClusterRobustCovariance,
    NormalEquations,
    cluster_board_poses,
    cluster_robust_covariance,
)
from bodyscan.registration.view_graph import Target

ROWS = 30


def solved(
    targets: int, noise: np.ndarray, *, prior: float = 0.0, alike: int = 1
) -> tuple[NormalEquations, list[Target], np.ndarray]:
    """Pairs a, which is held, and b, and a board at each target, linear: the equations where they are
    solved, with residuals `noise` (targets, ROWS) before; and what b's motion came out as.

    alike: so many targets in turn are of one board in one place."""
    rng = np.random.default_rng(1000)  # the same problem whatever the noise
    size = 12 + 6 * targets
    names = [(f"s{k:03d}", "board") for k in range(targets)]
    columns = [np.r_[6:12, 12 + 6 * k : 18 + 6 * k] for k in range(targets)]
    clusters = rng.normal(size=(targets // alike, ROWS, 12))
    jacobians = clusters.repeat(alike, axis=0)
    matrix, right = np.zeros((size, size)), np.zeros(size)
    for own, jacobian, off in zip(columns, jacobians, noise, strict=True):
        matrix[np.ix_(own, own)] += jacobian.T @ jacobian
        right[own] += jacobian.T @ off
    matrix[range(6, 12), range(6, 12)] += prior
    free = np.arange(6, size)
    found = np.zeros(size)
    found[free] = np.linalg.solve(matrix[np.ix_(free, free)], right[free])
    parts = {}
    for name, own, jacobian, off in zip(names, columns, jacobians, noise, strict=True):
        vector = jacobian.T @ (off - jacobian @ found[own])
        part = LinearGaussianSystem(jacobian.T @ jacobian, vector)
        parts[name] = np.arange(6, 12), part.marginalize(np.arange(6, 12))
    known = LinearGaussianSystem.from_prior(np.diag([0.0] * 6 + [prior] * 6))
    cameras = dict.fromkeys("ab", np.zeros(0, np.int64))
    equations = NormalEquations(("a", "b"), cameras, np.arange(6, 12), known, parts, 1.0)
    return equations, names, found[6:12]


def draw(targets: int, sigma: float, seed: int, alike: int = 1) -> np.ndarray:
    """alike: so many targets in turn err the same."""
    rng = np.random.default_rng(seed)
    return np.asarray(sigma * rng.normal(size=(targets // alike, ROWS)).repeat(alike, axis=0))


def each(names: list[Target]) -> list[list[Target]]:
    return [[name] for name in names]


def of_b(found: ClusterRobustCovariance) -> np.ndarray:
    return found.poses.marginal("b")


def test_noise_as_large_as_thought_has_no_excess() -> None:
    equations, names, _ = solved(60, draw(60, 1.0, 0))
    found = cluster_robust_covariance(equations, each(names))
    # Of 54 x 6 degrees of freedom: known to 8 %, and never less than 1.
    assert 1.0 <= found.variance_inflation < 1.25
    independent = np.linalg.inv(equations.system.information)
    np.testing.assert_allclose(
        np.diag(of_b(found)), np.diag(independent) * found.variance_inflation, rtol=0.35
    )
    assert not found.poses.marginal("a").any(), "it holds the frame"
    assert not any(one.size for one in found.cameras.values())


def test_what_the_solve_followed_of_few_boards_is_allowed_for() -> None:
    """Of three boards' vectors the solve takes a third: without that the factor would be 6 of 9."""
    found = [
        cluster_robust_covariance(equations, each(names)).variance_inflation
        for seed in range(120)
        for equations, names, _ in [solved(3, draw(3, 3.0, seed))]
    ]
    assert np.mean(found) == pytest.approx(9.0, rel=0.15)


def test_the_covariance_is_what_solutions_scatter_by() -> None:
    ratios = []
    for seed in range(60):
        equations, names, came_out = solved(24, draw(24, 2.0, seed))
        covariance = of_b(cluster_robust_covariance(equations, each(names)))
        ratios.append(came_out @ np.linalg.solve(covariance, came_out) / 6.0)
    assert np.mean(ratios) == pytest.approx(1.0, abs=0.25)


def test_boards_in_one_place_that_err_alike_are_one_piece_of_evidence() -> None:
    equations, names, _ = solved(90, draw(90, 1.0, 0, alike=3), alike=3)
    together = [names[k : k + 3] for k in range(0, 90, 3)]
    # Their vectors add up: three times as much as if they erred by themselves.
    assert cluster_robust_covariance(equations, each(names)).variance_inflation < 1.3
    assert cluster_robust_covariance(equations, together).variance_inflation == pytest.approx(
        3.0, rel=0.2
    )


def test_one_place_alone_says_nothing_of_how_it_errs() -> None:
    equations, names, _ = solved(5, draw(5, 7.0, 0))
    found = cluster_robust_covariance(equations, [names])
    assert found.variance_inflation == 1.0
    independent = np.linalg.inv(equations.system.information)
    np.testing.assert_allclose(of_b(found), independent, rtol=1e-6, atol=1e-12)


def test_a_prior_is_exact_and_does_not_err() -> None:
    equations, names, _ = solved(30, draw(30, 3.0, 0), prior=1e9)
    found = cluster_robust_covariance(equations, each(names))
    np.testing.assert_allclose(np.diag(of_b(found)), 1e-9, rtol=0.01)


def view(shot: str, board: str, *, size: float = 300.0) -> LocatedView:
    points = np.array([[0.0, 0.0, 0.0], [size, 0.0, 0.0], [0.0, 0.0, 0.0]])
    one = RigidTransform.identity()
    return LocatedView("p", shot, board, points, points[:, :2], one, (one,))


def test_boards_that_nearly_stood_where_another_did_are_in_its_place() -> None:
    def stands(x: float, turn: float = 0.0) -> RigidTransform:
        return RigidTransform.from_rotation_vector([0.0, turn, 0.0], [x, 0.0, 1000.0])

    poses = {
        ("s0", "b"): stands(0.0), ("s1", "b"): stands(14.9), ("s2", "b"): stands(15.1),
        ("s3", "b"): stands(0.0, 0.049), ("s4", "b"): stands(0.0, -0.051), ("s0", "c"): stands(0.0),
        ("s5", "b"): stands(25.0),
    }  # fmt: skip
    # A twentieth of 300 mm is 15 mm; s5 is near s2, whose place s2 began.
    assert cluster_board_poses([view(*target) for target in poses], poses) == [
        [("s0", "b"), ("s1", "b"), ("s3", "b")],
        [("s0", "c")],
        [("s2", "b"), ("s5", "b")],
        [("s4", "b")],
    ]
