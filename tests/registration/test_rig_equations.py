"""The normal equations of a small rig, against differences of its reprojection errors."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from bodyscan.arrays import Array
from bodyscan.calibration.board_views import LocatedView
from bodyscan.geometry.camera import Camera
from bodyscan.geometry.lenses.opencv import Radial
from bodyscan.geometry.transforms import RigidTransform, twist_jacobian
from bodyscan.registration.normal_equations import (
    FreeShape,
    NormalEquations,
    normal_equations,
    view_sigmas,
)
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


def views(noise_px: float = 0.0) -> list[LocatedView]:
    rng = np.random.default_rng(4)
    found = []
    for pair, shot in SEEN:
        camera_from_board = PLACED[pair].inverse() @ BOARDS[shot, "board"]
        pixels = CAMERAS[pair].project(camera_from_board.apply(POINTS))
        pixels = pixels + noise_px * rng.standard_normal(pixels.shape)
        found.append(LocatedView(pair, shot, "board", POINTS, pixels, camera_from_board))
    return found


def equations(
    seen: list[LocatedView], *, free: bool = False, prior: bool = False
) -> NormalEquations:
    return normal_equations(
        seen, CAMERAS, PLACED, BOARDS, fixed_pair="a", fixed_target=None, cameras_free=free,
        camera_prior=prior,
    )  # fmt: skip


def errors(seen: list[LocatedView], step: Array, free: bool) -> Array:
    """All reprojection errors (N,) px after a step in all unknowns."""
    pairs, boards, of_cameras = np.split(step, [12, 30])
    placed = {n: PLACED[n].retract(t) for n, t in zip("ab", pairs.reshape(2, 6), strict=True)}
    boarded = {
        t: at.retract(s) for (t, at), s in zip(BOARDS.items(), boards.reshape(3, 6), strict=True)
    }
    cameras = dict(CAMERAS)
    if free:
        for name, own in zip("ab", np.split(of_cameras, 2), strict=True):
            cameras[name] = CAMERAS[name].retract(own)
    parts = []
    for view in seen:
        points = placed[view.pair].inverse().apply(boarded[view.target].apply(view.points))
        parts.append((cameras[view.pair].project(points) - view.pixels).ravel())
    return np.concatenate(parts)


def jacobian(seen: list[LocatedView], free: bool) -> Array:
    count = 30 + (sum(len(c.parameters) for c in CAMERAS.values()) if free else 0)
    columns = []
    for k, one in enumerate(np.eye(count)):
        size = 1e-6 if k % 6 < 3 or k >= 30 else 1e-3
        columns.append(
            (errors(seen, size * one, free) - errors(seen, -size * one, free)) / (2 * size)
        )
    return np.stack(columns, axis=1)


@pytest.mark.parametrize("number", range(3))
def test_a_board_that_holds_the_frame_is_held_whichever_it_is(number: int) -> None:
    target = tuple(BOARDS)[number]
    found = normal_equations(
        views(), CAMERAS, PLACED, BOARDS, fixed_pair=None, fixed_target=target, cameras_free=False
    )
    assert found.fixed.tolist() == found.parts[number].columns[-6:].tolist()


@pytest.mark.parametrize("free", [False, True])
def test_they_are_those_of_all_errors_by_all_unknowns(free: bool) -> None:
    """With noise so even that every corner counts alike."""
    seen = views(1e-3)
    found = equations(seen, free=free)
    assert found.names == ("a", "b")
    assert found.targets == tuple(BOARDS)
    by = jacobian(seen, free)
    residuals = errors(seen, np.zeros(by.shape[1]), free)
    spread = np.sqrt(np.mean(residuals**2))
    corner = np.linalg.norm(residuals.reshape(-1, 2), axis=1)
    assert corner.max() < 4.0 * spread
    scale = np.sqrt(np.diag(by.T @ by))
    # Weights of corners two or three spreads off are 0.7 to 1, near them 1.
    information = found.system.information / np.outer(scale, scale)
    truth = (by.T @ by) / np.outer(scale, scale)
    assert np.abs(information - truth).max() < 0.15
    # The noise of a view is known from 40 residuals, to 22 % of its variance.
    assert np.all(np.diag(information) <= 1.15)
    np.testing.assert_allclose(information[truth == 0.0], 0.0, atol=1e-12)
    assert np.linalg.norm((-found.system.vector - by.T @ residuals) / scale) < 0.2 * np.linalg.norm(
        by.T @ residuals / scale
    )
    assert found.fixed.tolist() == list(range(6))
    assert found.first_board == 12
    assert found.first_camera == 30
    assert found.cameras_free == free
    assert np.sqrt(found.variance_px2) == pytest.approx(1e-3, rel=0.25)


def test_a_corner_that_is_far_off_counts_for_next_to_nothing() -> None:
    seen = views(1e-3)
    before = equations(seen)
    pixels = seen[0].pixels.copy()
    pixels[7] += 0.2  # two hundred times the noise
    after = equations([replace(seen[0], pixels=pixels), *seen[1:]])
    scale = np.sqrt(np.diag(before.system.information))
    change = (after.system.information - before.system.information) / np.outer(scale, scale)
    assert np.abs(change).max() < 0.12, "one corner of twenty of a board less"
    # At most 16 variances, as Cauchy's loss has it, of 200 residuals: all others count 8 % more.
    assert np.all(np.diag(change) < 0.1), "and its view not more"


def test_without_boards_is_what_is_left_once_they_may_move() -> None:
    found = equations(views(1e-3))
    left = found.without_boards().information
    whole = np.linalg.inv(found.system.information[6:, 6:])  # pair a held
    np.testing.assert_allclose(np.linalg.inv(left[6:, 6:]), whole[:6, :6], rtol=1e-6)


def test_what_is_known_of_cameras_beforehand_is_added_to_their_own_unknowns() -> None:
    seen = views(1e-3)
    bare, told = equations(seen, free=True), equations(seen, free=True, prior=True)
    added = told.system.information - bare.system.information
    own = np.concatenate(told.camera_columns)
    sigmas = np.concatenate([CAMERAS[name].prior_sigmas for name in "ab"])
    expected = np.zeros(len(added))
    expected[own] = told.variance_px2 / sigmas**2
    np.testing.assert_allclose(np.diag(added), expected, rtol=1e-4, atol=1e-6)
    np.testing.assert_array_equal(added[:30, :30], 0.0)


def test_a_view_at_a_slant_counts_by_its_own_noise() -> None:
    rng = np.random.default_rng(0)
    views = [0.016 * rng.standard_normal(96) for _ in range(9)] + [0.065 * rng.standard_normal(96)]
    sigmas = view_sigmas(views)
    # Of 96 residuals a sigma is known to 7 %; a tenth of the view's is that of all views together.
    np.testing.assert_allclose(sigmas[-1] / np.median(sigmas[:-1]), 0.065 / 0.016, rtol=0.25)
    np.testing.assert_allclose(sigmas[:-1], np.median(sigmas[:-1]), rtol=0.2)


@pytest.mark.parametrize("noise_px", [0.0, 1e-9])
def test_views_without_noise_weigh_alike(noise_px: float) -> None:
    """Advice counts what views would tell that nobody took: computed, without noise."""
    views = [noise_px * np.ones(48), np.zeros(96), np.zeros(200)]
    np.testing.assert_allclose(view_sigmas(views), 1.0)


def test_of_a_free_shape_motion_is_known_and_size_as_little_as_said() -> None:
    x, y = np.meshgrid(np.arange(8) * 40.0, np.arange(6) * 40.0)
    points = np.stack([x, y, np.zeros_like(x)], axis=-1).reshape(-1, 3)
    shape = FreeShape(points, sigma_mm=1.0, size_sigma=1e-4)
    covariance = np.linalg.inv(shape.prior_information)
    arms = points - points.mean(axis=0)
    size = arms.ravel() / np.linalg.norm(arms)
    expected = 1e-4 * float(np.linalg.norm(arms))
    assert np.sqrt(size @ covariance @ size) == pytest.approx(expected, rel=1e-2)
    turn = twist_jacobian(arms).reshape(-1, 6)[:, 2]
    assert np.sqrt(turn @ covariance @ turn) / np.linalg.norm(turn) < 1e-3
    bend = np.zeros_like(arms)
    bend[:, 2] = (arms[:, 0] / 140.0) ** 2 - np.mean((arms[:, 0] / 140.0) ** 2)
    bend /= np.linalg.norm(bend)
    assert np.sqrt(bend.ravel() @ covariance @ bend.ravel()) == pytest.approx(1.0, rel=1e-3)
