"""Corners and stripes of a pair in one solve: what it must better, on the chapter's own camera."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
import pytest
from lit_boards import Mirror, Scene, binned
from table_one import CAMERA

from bodyscan.arrays import Array, Indices
from bodyscan.calibration.board_views import PlanarView
from bodyscan.calibration.boundary_points import (
    boundary_points,
    concatenate,
    intersect_with_board,
    select,
    subsample,
)
from bodyscan.calibration.camera import CameraCalibration, calibrate_camera
from bodyscan.calibration.joint_refinement import (
    WARP_POWERS,
    BoardStripes,
    BoardWarp,
    JointFit,
    StripedBoard,
    refine_jointly,
)
from bodyscan.calibration.sheet_selection import fit_light_sheets
from bodyscan.geometry.camera import Camera
from bodyscan.geometry.light_planes import SmoothSheets
from bodyscan.geometry.transforms import RigidTransform, fit_rigid_transform

MIRROR = Mirror(
    254, np.array([-150.0, 0, 0]), np.array([150.0, 0, 420.0]), np.array([0, 1.0, 0])
)  # fmt: skip
SCENE = Scene(CAMERA, MIRROR, "vertical", 20.0, 9, 7)
TURNS = (
    (0.3, 0.25, 0.0),
    (-0.35, 0.2, 0.1),
    (0.1, -0.4, 0.0),
    (-0.2, -0.3, -0.1),
    (0.35, -0.1, 0.0),
)
CORNER_PX, STRIPE_PX, FLATNESS_MM = 0.015, 0.06, 0.1


def bow(xy: Array, bow_mm: float) -> Array:
    """Height (...) mm of a board bowed by so much at (..., 2) mm."""
    x, y = np.moveaxis((xy - SCENE.size / 2.0) / SCENE.size, -1, 0)
    return np.asarray(-bow_mm * (1.0 - 2.0 * (x**2 + y**2)), np.float64)


def crossings(pose: RigidTransform, bow_mm: float) -> tuple[Indices, Array]:
    """Boundaries and their pixels (N, 2) on a board bowed by so much."""
    index, pixels = SCENE.crossings(pose, 8)

    def stripe(pixels: Array) -> Array:
        points = intersect_with_board(CAMERA.rays(pixels), pose, lambda xy: bow(xy, bow_mm))
        return MIRROR.stripe(points)

    for _ in range(3 if bow_mm else 0):
        s = stripe(pixels)
        pixels[:, 0] += (index - s) * 0.5 / (stripe(pixels + [0.5, 0.0]) - s)
    return index, pixels


@dataclass(frozen=True, eq=False)
class Solved:
    """A pair solved in turn, and jointly; `boards` as the joint solve gets them."""

    in_turn: CameraCalibration
    sheets: SmoothSheets
    boards: list[StripedBoard]
    joint: JointFit


@cache
def solved(
    bow_mm: float, boards: int, seed: int = 0, print_mm: float = 0.0, unlit: int = 0
) -> Solved:
    """unlit: number of boards without stripes."""
    rng = np.random.default_rng(seed)
    poses = [
        SCENE.looking_at([5.0 * k - 10.0, 0.0, 390.0 + 8.0 * k], turn)
        for k, turn in enumerate(TURNS[:boards])
    ]
    column, row = np.meshgrid(np.arange(1, 9), np.arange(1, 7))
    corners = np.column_stack([20.0 * column.ravel(), 20.0 * row.ravel(), np.zeros(48)])
    true = corners + np.column_stack([np.zeros((48, 2)), bow(corners[:, :2], bow_mm)])
    true[:, :2] += print_mm * np.random.default_rng([seed, 48]).standard_normal((48, 2))
    views = [
        PlanarView(f"s{k}", corners, pixels + rng.normal(0.0, CORNER_PX, pixels.shape))
        for k, pixels in enumerate(CAMERA.project(pose.apply(true)) for pose in poses)
    ]
    camera = calibrate_camera(views, 640, 480)
    parts = []
    for k, pose in enumerate(poses[: boards - unlit]):
        index, pixels = crossings(pose, bow_mm)
        pixels[:, 0] += rng.normal(0.0, STRIPE_PX, len(pixels))
        means = binned(index, pixels, STRIPE_PX, "vertical")
        located = camera.poses[k]
        parts.append(boundary_points(camera.camera, located, *means, board=k, direction="vertical"))
    data = subsample(concatenate(parts), 6000)
    sheets = fit_light_sheets(data, 254, "vertical").sheets
    assert isinstance(sheets, SmoothSheets)
    striped = [
        StripedBoard(
            "b", view, (BoardStripes.from_points(camera.camera, select(data, data.board == k)),)
        )
        for k, view in enumerate(views)
    ]
    joint = refine_jointly(camera.camera, camera.poses, [sheets], striped, {"b": FLATNESS_MM})
    return Solved(camera, sheets, striped, joint)


def plate(camera: Camera, sheets: SmoothSheets) -> tuple[float, Array]:
    """RMS flatness error, mm, of a plate measured without noise, and the errors of its points, in
    sigmas, once it lies where it is: where the camera is, a pair by itself cannot know."""
    pose = SCENE.looking_at([0.0, 0.0, 405.0], [0.1, 0.1, 0.0])
    u, v = np.meshgrid(np.arange(220.0, 480.0, 20.0), np.arange(190.0, 390.0, 20.0))
    pixels = np.column_stack([u.ravel(), v.ravel()])
    true = SCENE.on_plane(pixels, pose)
    s = MIRROR.stripe(true)
    rays = camera.rays(pixels)
    depth = sheets.intersect(rays, s).depth
    points = rays * depth[:, None]
    centred = points - points.mean(axis=0)
    flatness = float(np.sqrt(np.linalg.eigvalsh(centred.T @ centred / len(centred))[0]))
    off = fit_rigid_transform(points, true).apply(points) - true
    return flatness, off[:, 2] / np.sqrt(sheets.intersect(rays, s).variance_mm2)


def test_a_plate_measured_with_a_bowed_board_becomes_flatter() -> None:
    one = solved(0.1, 5)
    # Corners stay explained to their noise of 0.015 px in each coordinate, 0.021 in both.
    assert one.joint.corners_rms_px < 0.03
    assert plate(one.joint.camera, one.joint.sheets[0])[0] < 0.003
    # Taken for flat the board bends the plate by a twelfth of its own bow.
    assert plate(one.in_turn.camera, one.sheets)[0] > 0.006


def test_a_plate_measured_with_flat_boards_becomes_flatter() -> None:
    before, after = [], []
    for one in (solved(0.0, 3, seed) for seed in range(2)):
        before.append(plate(one.in_turn.camera, one.sheets)[0])
        after.append(plate(one.joint.camera, one.joint.sheets[0])[0])
        exact = refine_jointly(
            one.in_turn.camera,
            one.in_turn.poses,
            [one.sheets],
            one.boards,
            {"b": 0.0},
            print_mm=0.0,
        )
        assert plate(exact.camera, exact.sheets[0])[0] < 0.002
    assert np.mean(after) < 0.75 * np.mean(before)


def test_the_bow_of_a_board_is_estimated() -> None:
    # Inner corners reach 70/90 of the way to the rims: of the bow of 0.1 mm in both directions
    # 2 * 0.1 * ((70/180)^2 + (50/140)^2) lie between the lowest and the highest.
    warp = solved(0.1, 5).joint.warps["b"]
    assert warp.out_of_plane_mm == pytest.approx(0.0558, abs=0.006)
    assert solved(0.0, 3).joint.warps["b"].out_of_plane_mm < 0.02


def test_boards_without_stripes_take_part_with_their_corners() -> None:
    found = solved(0.0, 5, unlit=2).joint
    assert found.corners_rms_px < 0.03
    assert plate(found.camera, found.sheets[0])[0] < 0.003


def test_depth_sigmas_are_consistent_with_the_errors() -> None:
    cases = [(0.0, 3, 0), (0.1, 5, 0), (0.0, 3, 1), (0.1, 4, 1)]
    pulls = [plate(one.joint.camera, one.joint.sheets[0])[1] for one in (solved(*c) for c in cases)]
    rms = [float(np.sqrt(np.mean(pull**2))) for pull in pulls]
    # Errors are common to the plate, so these are four draws, not 4 x 130: 1 +- 0.35. Prints are
    # exact here, which the sigmas do not presume.
    assert 0.2 < np.sqrt(np.mean(np.square(rms))) < 1.4, rms
    assert max(rms) < 3.0


def test_camera_sigmas_are_consistent_with_errors_of_the_print() -> None:
    pulls = []
    for seed in range(4):
        found = solved(0.0, 3, seed, print_mm=0.05).joint
        error = found.camera.parameters - CAMERA.parameters
        pulls.append((error / np.sqrt(np.diag(found.camera_covariance)))[:5])
    assert 0.5 < np.sqrt(np.mean(np.square(pulls))) < 1.6, np.round(pulls, 1)


def test_priors_of_warp_and_print_are_in_the_covariance() -> None:
    one = solved(0.0, 3)

    def sigma(flatness_mm: float, print_mm: float) -> float:
        found = refine_jointly(
            one.in_turn.camera,
            one.in_turn.poses,
            [one.sheets],
            one.boards,
            {"b": flatness_mm},
            print_mm=print_mm,
        )
        return float(np.sqrt(np.trace(found.camera_covariance[:2, :2])))

    assert sigma(0.0, 0.0) < sigma(0.3, 0.05) < sigma(0.3, 0.2)


def corners() -> Array:
    """9 x 6 every 40 mm, off the origin: x from 20 to 340, y from -30 to 170."""
    x, y = np.meshgrid(20.0 + 40.0 * np.arange(9), -30.0 + 40.0 * np.arange(6))
    return np.stack([x, y, np.zeros_like(x)], axis=-1).reshape(-1, 3)


def scaled(xy: Array) -> tuple[Array, Array]:
    """-1 and 1 at the outermost corners."""
    return (xy[..., 0] - 180.0) / 160.0, (xy[..., 1] - 70.0) / 100.0


def warp(*heights: float) -> BoardWarp:
    flat = BoardWarp.flat(corners(), 0.2, 0.05)
    return flat.retract(np.concatenate([heights, np.zeros(flat.count - 7)]))


@pytest.mark.parametrize("number", range(7))
def test_each_coefficient_lifts_by_its_power_less_the_best_plane(number: int) -> None:
    one = warp(*np.eye(7)[number])
    x, y = scaled(one.points)
    i, j = WARP_POWERS[number]
    power = x**i * y**j
    plane = np.stack([np.ones_like(x), x, y], axis=1)
    best = np.linalg.lstsq(plane, power, rcond=None)[0]
    np.testing.assert_allclose(one.height(one.points[:, :2]), power - plane @ best, atol=1e-12)
    np.testing.assert_allclose(
        one.basis(one.points[:, :2])[:, number], power - plane @ best, atol=1e-12
    )
    assert one.out_of_plane_mm == pytest.approx(np.ptp(power - plane @ best))
    beyond = np.array([[400.0, 100.0]])
    u, v = scaled(beyond)
    assert one.height(beyond) == pytest.approx(u**i * v**j - (best[0] + best[1] * u + best[2] * v))


def test_corners_are_displaced_by_warp_and_print() -> None:
    one = warp(0.4, 0, 0, 0, 0, 0, 0)
    step = np.zeros(one.count)
    some = corners()[[3, 50]]
    number = int(np.flatnonzero((one.points == some[0]).all(axis=1))[0])
    step[7 + 2 * number] = 0.1  # this corner's x
    one = one.retract(step)
    displaced = one.apply(some)
    np.testing.assert_allclose(displaced[:, :2] - some[:, :2], [[0.1, 0.0], [0.0, 0.0]])
    np.testing.assert_allclose(displaced[:, 2], one.height(some[:, :2]))
    assert one.count == 7 + 2 * 54


def test_the_prior_of_a_board_is_its_flatness_and_print() -> None:
    residuals, jacobian = warp(0.4, 0, 0, 0, 0, 0, 0.03).prior
    sigmas = 1.0 / np.diag(jacobian)
    np.testing.assert_allclose(sigmas[:3], 0.2)
    np.testing.assert_allclose(sigmas[3:7], 0.06)  # of third degree three tenths
    np.testing.assert_allclose(sigmas[7:], 0.05)
    np.testing.assert_allclose(residuals[:7], [2.0, 0, 0, 0, 0, 0, 0.5])
    exact = BoardWarp.flat(corners(), 0.0, 0.0).prior[1]
    np.testing.assert_allclose(1.0 / np.diag(exact), 1e-6)  # a nanometre


def test_corners_given_by_several_views_count_once() -> None:
    views = np.concatenate([corners(), corners()[:5] + 1e-8])
    assert len(BoardWarp.flat(views, 0.2, 0.05).points) == 54
