"""Stripes of both directions on boards: each family gets its sheets, and both measure the same."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from bodyscan.arrays import Array
from bodyscan.boards.board_layout import compute_corner_points
from bodyscan.calibration.board_views import LocatedView, PlanarView
from bodyscan.calibration.boundary_points import BoardBoundaries, StripedView
from bodyscan.calibration.camera import calibrate_camera
from bodyscan.calibration.pair import LocatedPair, PairCalibration, calibrate_pair
from bodyscan.geometry.camera import Camera
from bodyscan.geometry.lenses.opencv import Radial
from bodyscan.geometry.light_sheets import intersect_rays, triangulate_image
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.outcome import Outcome
from bodyscan.reconstruction.triangulation import combine_directions
from bodyscan.rig.board import Board
from bodyscan.stripes.codes.gray import Gray

BOARD = Board(name="board", columns=9, rows=7, square_mm=30.0)
CAMERA = Camera(800.0, 800.0, 0.0, 319.5, 239.5, Radial(0.0, 0.0), 640, 480)
PROJECTOR = np.array([[420.0, 0.0, 100.0], [0.0, 420.0, 80.0], [0.0, 0.0, 1.0]])
PLACE = RigidTransform.from_rotation_vector([-0.15, 0.25, 0.02], [-180.0, -110.0, 10.0])
CROSSING = Gray(stripes=160, direction="horizontal")
COLUMNS = Gray(stripes=200, direction="vertical", crossing=CROSSING)
SIGMA_PX = 0.05
POSES = [
    RigidTransform.from_rotation_vector(turn, [-130.0, -100.0, far])
    for turn, far in (
        ([0.0, 0.1, 0.0], 700.0), ([0.4, 0.0, 0.05], 680.0), ([-0.4, 0.1, 0.0], 720.0),
        ([0.1, 0.45, 0.0], 650.0), ([0.0, -0.4, -0.1], 750.0),
    )
]  # fmt: skip


def boundaries(pose: RigidTransform, axis: int, rng: np.random.Generator) -> BoardBoundaries:
    """Where s is whole on the board's plane, along every fourth line: s is a ratio of two forms that
    are linear in the pixel, the plane's homography from camera to projector."""
    normal = pose.rotation[:, 2]
    inverse = np.linalg.inv(CAMERA.matrix)
    distance = normal @ pose.translation
    onto = PROJECTOR @ (PLACE.rotation + np.outer(PLACE.translation, normal) / distance) @ inverse
    index = np.arange(1, (COLUMNS, CROSSING)[axis].stripes)
    lines = np.arange(0.0, (480, 640)[axis], 4.0)
    i, line = np.meshgrid(index, lines)
    form = onto[axis][:, None, None] - i * onto[2][:, None, None]
    place = -(form[1 - axis] * line + form[2]) / form[axis]
    pixels = np.stack([place, line] if axis == 0 else [line, place], axis=-1).reshape(-1, 2)
    shown = np.all((pixels > 0) & (pixels < (640, 480)), axis=1)
    pixels = pixels[shown]
    pixels[:, axis] += SIGMA_PX * rng.standard_normal(len(pixels))
    return BoardBoundaries(i.ravel()[shown], pixels, np.full(len(pixels), SIGMA_PX))


def calibrated(
    *,
    alone: bool,
    crossed: int = len(POSES),
    poses: Sequence[RigidTransform] = POSES,
    corner_px: float = 0.01,
    print_mm: float = 0.0,
    odd: int | None = None,
    seed: int = 5,
) -> Outcome[PairCalibration]:
    rng = np.random.default_rng(seed)
    shots, views = [], []
    points = compute_corner_points(BOARD)
    printed = points + print_mm * rng.standard_normal(points.shape) * [1.0, 1.0, 0.0]
    for number, pose in enumerate(poses):
        pixels = CAMERA.project(pose.apply(printed))
        pixels += corner_px * rng.standard_normal(pixels.shape)
        lit = poses[number - 1] if number == odd else pose
        across = boundaries(lit, 1, rng) if number < crossed else None
        seen = replace(boundaries(lit, 0, rng), crossing=across)
        view = LocatedView("p", f"b{number}", "board", points, pixels, pose)
        shots.append(StripedView(view, BOARD, seen))
        views.append(PlanarView(view.shot, points, pixels))
    own = calibrate_camera(views, 640, 480)
    camera = own.camera if alone else CAMERA
    if alone:
        shots = [
            replace(shot, view=replace(shot.view, camera_from_board=pose))
            for shot, pose in zip(shots, own.poses, strict=True)
        ]
    located = tuple(shot.view for shot in shots)
    known = (camera, own.covariance, None, (), 0.05, COLUMNS, located)
    return calibrate_pair(LocatedPair("p", *known, tuple(shots), (BOARD,), alone))


def measured(
    pair: PairCalibration, pose: RigidTransform, rng: np.random.Generator
) -> tuple[list[float], list[float]]:
    """Of a board that took no part, by columns, rows and both: RMS from flat, and the median sigma."""
    v, u = np.mgrid[:480, :640].astype(float)
    normal, true = pose.rotation[:, 2], CAMERA.rays(np.stack([u, v], axis=-1))
    true = true * (normal @ pose.translation / (true @ normal))[..., None]
    away = PLACE.apply(true) @ PROJECTOR.T
    s = away[..., :2] / away[..., 2:] + 0.02 * rng.standard_normal(true.shape[:2] + (2,))
    s[(np.abs(u - 320.0) > 170.0) | (np.abs(v - 240.0) > 140.0)] = np.nan
    sigma, ways = np.full(u.shape, 0.02), []
    for k, sheets in enumerate((pair.sheets, pair.crossing)):
        assert sheets is not None
        ways.append(triangulate_image(sheets, pair.camera, s[..., k], sigma))
    ways.append(combine_directions(*ways, alone=np.zeros(u.shape, bool))[0])
    flat, sigmas = [], []
    for points, sigma_mm, _ in ways:
        known = points[np.isfinite(sigma_mm)].astype(float)
        assert len(known) > 50_000
        flat.append(float(np.sqrt(np.linalg.eigvalsh(np.cov(known.T))[0])))
        sigmas.append(float(np.nanmedian(sigma_mm)))
    return flat, sigmas


def test_both_directions_of_a_pair_by_itself_are_better_than_either_with_sigmas_that_hold() -> None:
    """Few boards, rough corners and a poor print leave the camera open by a hundred times what the
    stripes do: as a motion of everything, which is no error of what a pair by itself measures."""
    ratios = []
    for seed in range(2):
        rng = np.random.default_rng(100 + seed)
        turns = 0.35 * rng.uniform(-1.0, 1.0, (5, 3)) * [1.0, 1.0, 0.3]
        far = rng.uniform(640.0, 760.0, 5)
        *poses, held = (
            RigidTransform.from_rotation_vector(turn, [-130.0, -100.0, z])
            for turn, z in zip(turns, far, strict=True)
        )
        found = calibrated(alone=True, poses=poses, corner_px=0.05, print_mm=0.05, seed=seed)
        flat, sigmas = measured(found.value, held, rng)
        assert flat[2] < 1.02 * min(flat[:2])
        ratios.append(np.divide(flat, sigmas))
    # Noise is most of it: of the calibration's error a plane shows what bends it.
    assert np.all(np.abs(np.log(np.sqrt(np.mean(np.square(ratios), axis=0)))) < np.log(1.4))


def depths(pair: PairCalibration) -> tuple[Array, Array, Array]:
    """True, by columns and by rows, of points before the camera."""
    rng = np.random.default_rng(6)
    points = rng.uniform([-90.0, -70.0, 660.0], [90.0, 70.0, 740.0], (300, 3))
    away = PLACE.apply(points) @ PROJECTOR.T
    s = away[:, :2] / away[:, 2:]
    shown = np.all((s > 5.0) & (s < (195.0, 155.0)), axis=1)
    rays = pair.camera.rays(CAMERA.project(points))
    assert pair.sheets is not None
    assert pair.crossing is not None
    found = (
        intersect_rays(own, rays, s[:, k]).depth
        for k, own in enumerate((pair.sheets, pair.crossing))
    )
    columns, rows = found
    assert shown.sum() > 200
    return points[shown, 2], columns[shown], rows[shown]


def test_both_families_measure_the_same() -> None:
    found = calibrated(alone=False)
    assert found.value.crossing is not None
    assert found.value.crossing.direction == "horizontal"
    assert found.value.crossing.stripes == 160
    assert any("crossing stripes: " in note for note in found.notes)
    true, columns, rows = depths(found.value)
    # Boundaries of 0.05 px on 5 boards: tens of thousands, so that the sheets are known to 0.02 mm.
    for depth in (columns, rows):
        assert np.median(np.abs(depth - true)) < 0.05


def test_a_pair_does_without_crossing_stripes_that_give_no_sheets() -> None:
    found = calibrated(alone=False, crossed=1)
    assert found.value.sheets is not None
    assert found.value.crossing is None
    assert any("crossing stripes are not used: stripes were decoded on 1" in n for n in found.notes)


def test_a_shot_with_stripes_of_another_is_left_out_and_named() -> None:
    found = calibrated(alone=False, odd=2)
    assert found.value.quality.stripe_shots == len(POSES) - 1
    assert any("p: the stripes of shot b2 do not fit the others'" in note for note in found.notes)
    true, *measured_by = depths(found.value)
    for depth in measured_by:
        assert np.median(np.abs(depth - true)) < 0.05
