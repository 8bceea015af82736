"""The normal equations of a small rig, against differences of its reprojection errors."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from bodyscan.arrays import Array
from bodyscan.calibration.board_views import PRIOR, BoardShape, LocatedView
from bodyscan.geometry.camera import Camera, CameraPrior
from bodyscan.geometry.lenses.opencv import Radial
from bodyscan.geometry.linear_gaussian import LinearGaussianSystem
from bodyscan.geometry.transforms import RigidTransform, twist_jacobian
from bodyscan.registration.cluster_covariance import NormalEquations, build_normal_equations
from bodyscan.registration.joint_solve import estimate_view_sigmas
from bodyscan.registration.view_graph import Target

CAMERAS = {
    "a": Camera(900.0, 910.0, 0.0, 320.0, 240.0, Radial(-0.1, 0.05), 640, 480),
    "b": Camera(1000.0, 990.0, 0.0, 310.0, 250.0, Radial(-0.05, 0.02), 640, 480),
}
PLACED = {
    "a": RigidTransform.from_rotation_vector([0.1, -0.2, 0.05], [-300.0, 20.0, 10.0]),
    "b": RigidTransform.from_rotation_vector([-0.1, 0.25, -0.1], [320.0, -40.0, 30.0]),
}
BOARDS: dict[Target, RigidTransform] = {
    ("s1", "board"): RigidTransform.from_rotation_vector([0.3, 0.2, 0.1], [-60.0, -40.0, 1000.0]),
    ("s2", "board"): RigidTransform.from_rotation_vector([-0.3, 0.1, 0.4], [-40.0, -90.0, 1150.0]),
    ("s3", "board"): RigidTransform.from_rotation_vector([0.1, -0.4, 0.2], [-80.0, -50.0, 950.0]),
}
SEEN = (("a", "s1"), ("b", "s1"), ("a", "s2"), ("b", "s3"), ("a", "s3"))
POINTS = np.array([[40.0 * (k % 5), 40.0 * (k // 5), 0.0] for k in range(20)])


def views() -> list[LocatedView]:
    rng = np.random.default_rng(4)
    found = []
    for pair, shot in SEEN:
        camera_from_board = PLACED[pair].inverse() @ BOARDS[shot, "board"]
        pixels = CAMERAS[pair].project(camera_from_board.apply(POINTS))
        pixels = pixels + 1e-3 * rng.standard_normal(pixels.shape)
        found.append(LocatedView(pair, shot, "board", POINTS, pixels, camera_from_board))
    return found


def equations(seen: list[LocatedView], fixed_target: Target | None = None) -> NormalEquations:
    return build_normal_equations(
        seen, CAMERAS, PLACED, BOARDS, fixed_pair="a", fixed_target=fixed_target
    )


def errors(seen: list[LocatedView], step: Array) -> Array:
    """All reprojection errors (N,) px after a step in all unknowns."""
    pairs, boards, of_cameras = np.split(step, [12, 30])
    placed = {n: PLACED[n].retract(t) for n, t in zip("ab", pairs.reshape(2, 6), strict=True)}
    boarded = {
        t: at.retract(s) for (t, at), s in zip(BOARDS.items(), boards.reshape(3, 6), strict=True)
    }
    steps = zip("ab", np.split(of_cameras, 2), strict=True)
    cameras = {name: CAMERAS[name].retract(own) for name, own in steps}
    parts = []
    for view in seen:
        points = placed[view.pair].inverse().apply(boarded[view.target].apply(view.points))
        parts.append((cameras[view.pair].project(points) - view.pixels).ravel())
    return np.concatenate(parts)


def jacobian(seen: list[LocatedView]) -> Array:
    count = 30 + sum(len(c.parameters) for c in CAMERAS.values())
    columns = []
    for k, one in enumerate(np.eye(count)):
        size = 1e-6 if k % 6 < 3 or k >= 30 else 1e-3
        columns.append((errors(seen, size * one) - errors(seen, -size * one)) / (2 * size))
    return np.stack(columns, axis=1)


@pytest.mark.parametrize("target", [None, *BOARDS])
def test_they_are_those_of_all_errors_by_all_unknowns(target: Target | None) -> None:
    """With noise so even that every corner counts alike; boards but the frame's are eliminated."""
    seen = views()
    found = equations(seen, target)
    assert found.names == ("a", "b")
    assert list(found.parts) == list(BOARDS)
    by = jacobian(seen)
    residuals = errors(seen, np.zeros(by.shape[1]))
    corner = np.linalg.norm(residuals.reshape(-1, 2), axis=1)
    assert corner.max() < 4.0 * np.sqrt(np.mean(residuals**2))
    held = range(6) if target is None else 12 + 6 * list(BOARDS).index(target) + np.arange(6)
    unknowns = np.setdiff1d(np.arange(by.shape[1]), held)
    whole = LinearGaussianSystem(by.T @ by, -by.T @ residuals).select(unknowns)
    truth = whole.marginalize(np.flatnonzero(np.isin(unknowns, range(12, 30))))
    system = found.sum_parts(list(found.parts))
    # Weights of corners two or three spreads off are 0.7 to 1, near them 1, and the noise of a view
    # is known from 40 residuals to 22 % of its variance.
    ratio = np.linalg.eigvals(np.linalg.solve(truth.information, system.information)).real
    assert ratio.min() > 0.6
    assert ratio.max() < 1.4
    scale = np.sqrt(np.diag(truth.information))
    assert np.linalg.norm((system.vector - truth.vector) / scale) < 0.3 * np.linalg.norm(
        truth.vector / scale
    )
    assert found.free.tolist() == list(range(6 if target is None else 0, found.prior.size))
    assert np.sqrt(found.variance_px2) == pytest.approx(1e-3, rel=0.25)


def test_a_corner_that_is_far_off_counts_for_next_to_nothing() -> None:
    seen = views()
    before = equations(seen)
    pixels = seen[0].pixels.copy()
    pixels[7] += 0.2  # two hundred times the noise
    after = equations([replace(seen[0], pixels=pixels), *seen[1:]])
    scale = np.sqrt(np.diag(before.system.information))
    change = (after.system.information - before.system.information) / np.outer(scale, scale)
    assert np.abs(change).max() < 0.12, "one corner of twenty of a board less"
    # At most 16 variances, as Cauchy's loss has it, of 200 residuals: all others count 8 % more.
    assert np.all(np.diag(change) < 0.1), "and its view not more"


def test_what_is_known_of_cameras_beforehand_is_added_to_their_own_unknowns() -> None:
    seen = views()
    found = equations(seen)
    own = np.concatenate(list(found.cameras.values()))
    sigmas = np.concatenate([CAMERAS[name].prior_sigmas for name in "ab"])
    expected = np.zeros(found.prior.size)
    expected[own] = found.variance_px2 / sigmas**2
    np.testing.assert_allclose(found.prior.information, np.diag(expected))


def test_cameras_that_are_known_take_no_degrees_of_freedom() -> None:
    priors = {n: CameraPrior(c.parameters, np.full(7, 1e-9)) for n, c in CAMERAS.items()}
    exact = {name: replace(camera, prior=priors[name]) for name, camera in CAMERAS.items()}
    seen = views()
    found = build_normal_equations(seen, exact, PLACED, BOARDS, fixed_pair="a", fixed_target=None)
    # Of 200 residuals with weights of 0.9, three boards and a pair take 24, unknown cameras 14.
    ratio = found.variance_px2 / equations(seen).variance_px2
    assert ratio == pytest.approx((180 - 24 - 14) / (180 - 24), rel=5e-3)


def test_a_view_at_a_slant_counts_by_its_own_noise() -> None:
    rng = np.random.default_rng(0)
    views = [0.016 * rng.standard_normal(96) for _ in range(9)] + [0.065 * rng.standard_normal(96)]
    sigmas = estimate_view_sigmas(views)
    # Of 96 residuals a sigma is known to 7 %; a tenth of the view's is that of all views together.
    np.testing.assert_allclose(sigmas[-1] / np.median(sigmas[:-1]), 0.065 / 0.016, rtol=0.25)
    np.testing.assert_allclose(sigmas[:-1], np.median(sigmas[:-1]), rtol=0.2)


@pytest.mark.parametrize("noise_px", [0.0, 1e-9])
def test_views_without_noise_weigh_alike(noise_px: float) -> None:
    """Advice counts what views would tell that nobody took: computed, without noise."""
    views = [noise_px * np.ones(48), np.zeros(96), np.zeros(200)]
    np.testing.assert_allclose(estimate_view_sigmas(views), 1.0)


def test_of_a_shape_motion_is_known_and_size_as_little_as_its_strains_say() -> None:
    x, y = np.meshgrid(np.arange(8) * 40.0, np.arange(6) * 40.0)
    points = np.stack([x, y, np.zeros_like(x)], axis=-1).reshape(-1, 3)
    arms = points - points.mean(axis=0)
    shape = BoardShape(points, arms * [1e-4, -1e-4, 0.0])
    known = shape.compute_prior_jacobian(shape.size_sigma)
    covariance = np.linalg.inv(known.T @ known)
    size = arms.ravel() / np.linalg.norm(arms)
    expected = shape.size_sigma * float(np.linalg.norm(arms))
    assert shape.size_sigma == pytest.approx(1e-4 / np.sqrt(2.0), rel=1e-6)
    assert np.sqrt(size @ covariance @ size) == pytest.approx(expected, rel=1e-2)
    turn = twist_jacobian(arms).reshape(-1, 6)[:, 2]
    assert np.sqrt(turn @ covariance @ turn) / np.linalg.norm(turn) < 1e-3
    bend = np.zeros_like(arms)
    bend[:, 2] = (arms[:, 0] / 140.0) ** 2 - np.mean((arms[:, 0] / 140.0) ** 2)
    bend /= np.linalg.norm(bend)
    sigma = np.sqrt(bend.ravel() @ covariance @ bend.ravel())
    assert sigma == pytest.approx(PRIOR * shape.diagonal, rel=1e-3)
