"""The right model of the light is found for projectors of known make, and measures as well."""

from collections.abc import Sequence
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from lit_boards import (
    BODY_POSES,
    CHAPTER_POSES,
    Lens,
    Pose,
    Scene,
    Uneven,
    body_scene,
    chapter_scene,
)
from sheet_models import PINHOLE

from bodyscan.arrays import Array
from bodyscan.calibration.boundary_points import BoundaryPoints, concatenate, select
from bodyscan.calibration.sheet_fit import count_boards
from bodyscan.calibration.sheet_selection import SheetsFit, fit_light_sheets
from bodyscan.errors import PairFailed
from bodyscan.geometry.lens_sheets import LensSheets
from bodyscan.geometry.light_planes import LightPlanes, SmoothSheets
from bodyscan.geometry.light_sheets import intersect_rays


def boards(
    scene: Scene, poses: Sequence[Pose], corner_px: float = 0.03, seed: int = 1
) -> BoundaryPoints:
    placed = [scene.looking_at(*pose) for pose in poses]
    return scene.boundaries(placed, corner_px=corner_px, seed=seed)


def fitted(scene: Scene, data: BoundaryPoints) -> SheetsFit:
    return fit_light_sheets(data, scene.projector.stripes, scene.direction)


def figure(fit: SheetsFit, model: str) -> float:
    return next(held.mean_mm for held in fit.held_out if held.model == model)


def flatness(scene: Scene, fit: SheetsFit, distance: float) -> float:
    """RMS about the best plane of a board measured without noise: what is left is systematic."""
    pose = scene.looking_at([0.0, 0.0, distance], [0.05, -0.1, 0.0])
    index, pixels = scene.crossings(pose)
    rays = scene.camera.rays(pixels)
    depth = intersect_rays(fit.sheets, rays, index.astype(float)).depth
    assert np.isfinite(depth).mean() > 0.95
    points = (rays * depth[:, None])[np.isfinite(depth)]
    points -= points.mean(axis=0)
    return float(np.sqrt(np.linalg.eigvalsh(points.T @ points)[0] / len(points)))


@cache
def mirror() -> tuple[Scene, SheetsFit]:
    scene = chapter_scene()
    return scene, fitted(scene, boards(scene, CHAPTER_POSES))


def test_planes_win_for_a_rotating_mirror() -> None:
    scene, fit = mirror()
    assert fit.model.startswith("bowed sheets")
    # The mirror's planes share no line: no centre, with whatever lens, comes near.
    assert figure(fit, "lens k1 k2 p1 p2") > 2.0 * figure(fit, "free planes")
    # The chapter's set-up: the board's places, from 48 corners of 0.03 px, leave the most of it.
    assert flatness(scene, fit, 400.0) < 0.008


def test_a_mirror_is_known_to_microns_on_boards_that_are() -> None:
    scene = chapter_scene()
    fit = fitted(scene, boards(scene, CHAPTER_POSES, corner_px=0.0))
    # 20,000 boundary points of 0.05 px (0.06 mm each) determine some twenty numbers.
    assert flatness(scene, fit, 400.0) < 0.002


def test_thousands_of_points_a_boundary_are_fitted_as_well_as_a_hundred() -> None:
    """As images of five megapixels have them. Whole boundaries alone would be two to start from, which
    any projector fits; the sheets were then anywhere, and the calibration could not be written."""
    scene, usual = mirror()
    data = boards(scene, CHAPTER_POSES)
    dense = select(data, np.repeat(np.arange(len(data.index)), 12))
    fit = fitted(scene, dense)
    assert fit.model.startswith("bowed sheets")
    assert flatness(scene, fit, 400.0) < 1.5 * flatness(scene, usual, 400.0) + 0.002


def test_stripes_out_of_step_keep_their_own_planes() -> None:
    even = chapter_scene()
    scene = replace(even, projector=Uneven(even.projector, 0.4))
    fit = fitted(scene, boards(scene, CHAPTER_POSES))
    assert isinstance(fit.sheets, LightPlanes)
    assert fit.model == "free planes"
    assert fit.stripes_calibrated == np.count_nonzero(fit.sheets.calibrated)
    # A boundary 0.23 stripes off (RMS of +-0.4) is some 0.5 mm; smoothed planes keep that error.
    assert figure(fit, "bowed sheets") > 3.0 * figure(fit, "free planes")


def test_bowed_sheets_of_a_mirror() -> None:
    scene = chapter_scene(smile=1.5)
    fit = fitted(scene, boards(scene, CHAPTER_POSES))
    assert fit.sheets.kind == "bowed"
    assert figure(fit, "free planes") > 1.2 * figure(fit, fit.model)
    assert figure(fit, "lens k1 k2 p1 p2") > 2.0 * figure(fit, fit.model)
    assert flatness(scene, fit, 400.0) < 0.01


@cache
def lens(k1: float = -0.035, k2: float = 0.0, axis: float = 330.0) -> tuple[Scene, SheetsFit]:
    scene = body_scene(k1, k2, axis)
    return scene, fitted(scene, boards(scene, BODY_POSES, corner_px=0.02))


def body(scene: Scene, noise_px: float) -> tuple[np.ndarray, ...]:
    """Rays on an upright cylinder of 170 mm radius 1.3 m away, its s with noise, its normals."""
    u, v = np.meshgrid(np.arange(300.0, 980.0, 6.0), np.arange(20.0, 1010.0, 6.0))
    pixels = np.column_stack([u.ravel(), v.ravel()])

    def hit(pixels: Array) -> tuple[Array, Array]:
        rays = scene.camera.rays(pixels)
        square = rays[:, 0] ** 2 + 1.0
        root = np.sqrt(np.maximum(1300.0**2 - square * (1300.0**2 - 170.0**2), 0.0))
        points = rays * ((1300.0 - root) / square)[:, None]
        return rays, points

    rays, points = hit(pixels)
    normals = (points - [0.0, 0.0, 1300.0]) * [1.0, 0.0, 1.0] / 170.0
    s = scene.projector.stripe(points)
    lit = (normals[:, 2] < -0.5) & (s > 1) & (s < scene.projector.stripes - 1)
    below = pixels + np.array([0.0, 0.5])
    slope = (scene.projector.stripe(hit(below)[1]) - s) / 0.5
    noise = slope * np.random.default_rng(3).normal(0.0, noise_px, len(s))
    return rays[lit], points[lit], (s + noise)[lit], normals[lit]


def errors_on_body(scene: Scene, fit: SheetsFit) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Distances from the body as calibrated and as with perfect sheets, and boards at each s."""
    rays, points, s, normals = body(scene, 0.03)
    perfect = scene.true_depth(rays, s, points[:, 2])
    depth = intersect_rays(fit.sheets, rays, s).depth
    true = np.sum((rays * perfect[:, None] - points) * normals, axis=1)
    got = np.sum((rays * depth[:, None] - points) * normals, axis=1)
    return got, true, fit.board_counts[np.rint(s).astype(int)]


@pytest.mark.parametrize(("k1", "k2", "axis"), [(-0.035, 0.0, 330.0), (-0.12, 0.05, 800.0)])
def test_a_lens_measures_as_well_as_perfect_sheets(k1: float, k2: float, axis: float) -> None:
    scene, fit = lens(k1, k2, axis)
    assert fit.sheets.kind == "lens"
    assert figure(fit, "free planes") > 2.0 * figure(fit, fit.model)
    assert isinstance(fit.sheets, LensSheets)
    assert isinstance(scene.projector, Lens)
    # Planes alone hardly tell the axis; 4 boards and the bow do, to a hundredth of the image.
    assert abs(fit.sheets.parameters[1] - scene.projector.centre) < 20.0
    got, true, seen = errors_on_body(scene, fit)
    for boards_seen in (seen >= 3, seen == 2, seen <= 1, seen >= 0):
        assert boards_seen.sum() > 500
        known = got[boards_seen]
        assert np.isfinite(known).all()
        # The figure, also where two boards reached, or one, or none.
        assert np.median(np.abs(known)) < 1.1 * np.median(np.abs(true[boards_seen]))
        assert np.sqrt(np.mean(known**2)) < 1.1 * np.sqrt(np.mean(true[boards_seen] ** 2))


def test_sigma_tells_how_far_off_the_sheets_are() -> None:
    pulls = []
    for seed in range(2, 6):
        scene = chapter_scene()
        fit = fitted(scene, boards(scene, CHAPTER_POSES, seed=seed))
        pose = scene.looking_at([0.0, 0.0, 400.0], [0.05, -0.1, 0.0])
        index, pixels = scene.crossings(pose, every_px=40)
        rays = scene.camera.rays(pixels)
        measured = intersect_rays(fit.sheets, rays, index.astype(float))
        off = measured.depth - scene.on_plane(pixels, pose)[:, 2]
        pulls.append(np.sqrt(np.nanmean(off**2 / measured.variance_mm2)))
    # Errors are common to the plane, so these are four draws: 1 +- 0.35.
    assert 0.5 < np.sqrt(np.mean(np.square(pulls))) < 1.7


def test_one_board_is_refused() -> None:
    scene = chapter_scene()
    with pytest.raises(PairFailed, match="1 boards"):
        fitted(scene, boards(scene, CHAPTER_POSES[:1]))


def test_outliers_do_not_matter() -> None:
    scene, clean = mirror()
    data = boards(scene, CHAPTER_POSES)
    spoilt = data.points.copy()
    spoilt[::50] *= 1.01
    fit = fitted(scene, replace(data, points=spoilt))
    assert fit.model == clean.model
    # One in fifty points 4 mm off would bend unweighted planes by a tenth of a millimetre.
    assert flatness(scene, fit, 400.0) < flatness(scene, clean, 400.0) + 0.004


def test_the_order_of_points_does_not_matter_and_nothing_is_drawn() -> None:
    scene, fit = mirror()
    data = boards(scene, CHAPTER_POSES)
    again = fitted(scene, data)
    assert isinstance(fit.sheets, SmoothSheets)
    assert isinstance(again.sheets, SmoothSheets)
    assert np.array_equal(again.sheets.parameters, fit.sheets.parameters)
    late = concatenate([select(data, data.board == board) for board in (2, 0, 1)])
    shuffled = fitted(scene, late)
    assert shuffled.model == fit.model
    assert isinstance(shuffled.sheets, SmoothSheets)
    # Sums in another order round otherwise, by far less than a step that is not worth taking.
    off = shuffled.sheets.parameters - fit.sheets.parameters
    assert np.all(np.abs(off) < 1e-3 * np.sqrt(np.diag(fit.sheets.covariance)))


def test_boundaries_between_two_stripes_count_and_not_those_at_the_pictures_ends() -> None:
    """Of ten stripes: planes are counted by themselves, smooth sheets by where boards were seen."""
    planes = np.full((11, 4), np.nan)
    planes[[0, 1, 4, 9, 10]] = [0.0, 1.0, 0.0, -200.0]
    seen = np.array([3, 0, 1, 2, 0, 0, 3, 0, 0, 1, 2])

    def count(sheets: LightPlanes | LensSheets) -> int:
        return SheetsFit(sheets, "", (), 0.1, seen).stripes_calibrated

    assert count(LightPlanes(planes, np.zeros((11, 4, 4)), "vertical")) == 3
    assert count(PINHOLE) == 4


def test_a_boundary_is_counted_once_on_each_board_that_shows_it() -> None:
    index, board = np.array([0, 0, 1, 3, 3, 3, 3]), np.array([0, 1, 1, 0, 2, 2, 0])
    nowhere = np.zeros((7, 3))
    data = BoundaryPoints(index, board, nowhere, nowhere, np.ones(7))
    assert count_boards(data, 4).tolist() == [2, 1, 0, 2, 0]
    assert count_boards(select(data, index > 5), 4).tolist() == [0] * 5


def test_two_boards_and_fifty_points_are_enough() -> None:
    scene = body_scene(-0.035)
    data = boards(scene, BODY_POSES[1:3])
    fit = fitted(scene, data)
    assert fit.sheets.kind in ("lens", "bowed")
    assert flatness(scene, fit, 1300.0) < 0.1
    some = np.linspace(0, len(data.index) - 1, 50).astype(int)
    fitted(scene, select(data, some))
    with pytest.raises(PairFailed, match="49 points of stripe boundaries on 2 boards are too few"):
        fitted(scene, select(data, some[1:]))
