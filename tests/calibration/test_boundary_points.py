"""Stripe boundaries carried onto boards: where they lie, what a pixel moves them by, and how many."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from bodyscan.calibration.boundary_points import (
    BoundaryPoints,
    boundary_points,
    concatenate,
    intersect_with_board,
    select,
    subsample,
)
from bodyscan.geometry.camera import Camera
from bodyscan.geometry.lenses.opencv import Radial
from bodyscan.geometry.light_planes import Axis
from bodyscan.geometry.transforms import RigidTransform

CAMERA = Camera(800.0, 790.0, 2.0, 330.0, 235.0, Radial(-0.1, 0.05), 640, 480)
BOARD = RigidTransform.from_rotation_vector([0.35, -0.5, 0.2], [-100.0, -60.0, 900.0])
PIXELS = np.array([[200.0, 150.0], [330.0, 235.0], [420.5, 300.25]])


def on_board(points: np.ndarray) -> np.ndarray:
    return BOARD.inverse().apply(points)


def test_pixels_are_carried_along_their_rays_onto_the_board() -> None:
    points = intersect_with_board(CAMERA.rays(PIXELS), BOARD)
    np.testing.assert_allclose(on_board(points)[:, 2], 0.0, atol=1e-9)
    np.testing.assert_allclose(CAMERA.project(points), PIXELS, atol=1e-6)


def test_of_a_bent_board_they_are_carried_onto_its_surface() -> None:
    def height(places: np.ndarray) -> np.ndarray:
        return np.asarray(0.5 - 2e-5 * np.sum((places - 100.0) ** 2, axis=-1))

    points = intersect_with_board(CAMERA.rays(PIXELS), BOARD, height)
    np.testing.assert_allclose(CAMERA.project(points), PIXELS, atol=1e-6)
    there = on_board(points)
    # After two liftings less than a ten-thousandth of a millimetre is left; after one a hundredth.
    np.testing.assert_allclose(there[:, 2], height(there[:, :2]), atol=2e-4)
    assert np.abs(there[:, 2]).max() > 0.2


@pytest.mark.parametrize(("direction", "across"), [("vertical", 0), ("horizontal", 1)])
def test_a_pixel_across_stripes_moves_a_point_on_its_board(direction: Axis, across: int) -> None:
    seen = np.array([4, 5, 9]), PIXELS, np.full(3, 0.1)
    found = boundary_points(CAMERA, BOARD, *seen, board=7, direction=direction)
    half = np.zeros(2)
    half[across] = 0.5
    ahead, behind = (
        intersect_with_board(CAMERA.rays(PIXELS + way * half), BOARD) for way in (1.0, -1.0)
    )
    np.testing.assert_allclose(found.per_pixel, ahead - behind, rtol=1e-3)
    np.testing.assert_allclose(found.points, intersect_with_board(CAMERA.rays(PIXELS), BOARD))
    assert found.board.tolist() == [7, 7, 7]
    assert found.index.tolist() == [4, 5, 9]


def many() -> BoundaryPoints:
    """On two flat boards, tilted, one a little farther away: 30 stripes, each in 20 points."""
    parts = []
    for board in range(2):
        index = np.repeat(np.arange(10, 40), 20)
        x = 8.0 * (index - 25.0)
        y = 10.0 * np.tile(np.arange(-10.0, 10.0), 30)
        z = 900.0 + 80.0 * board + 0.5 * x
        across = np.tile([1.0, 0.0, 0.5], (len(index), 1))
        points = np.column_stack([x, y, z])
        number = np.full(len(index), 3 * board)
        parts.append(BoundaryPoints(index, number, points, across, np.full(len(index), 0.1)))
    return concatenate(parts)


def test_every_nth_boundary_is_kept_whole() -> None:
    data = many()  # 1,200 points of 30 boundaries
    assert subsample(data, 1200) is data
    assert subsample(data, 5000) is data
    half = subsample(data, 1199)
    assert np.unique(half.index).tolist() == list(range(11, 40, 2))
    assert len(half.index) == 600
    third = subsample(data, 400)
    assert np.unique(third.index).tolist() == list(range(11, 40, 3))
    assert np.bincount(third.board)[[0, 3]].tolist() == [200, 200]
    # By their rank, not their number.
    gaps = replace(data, index=7 * data.index)
    assert np.unique(subsample(gaps, 400).index).tolist() == list(range(77, 280, 21))


@pytest.mark.parametrize(("most", "points"), [(200, 200), (60, 58)])
def test_boundaries_of_many_points_are_thinned_before_too_few(most: int, points: int) -> None:
    """Ten of 30 tell one model of the light from another; one alone would tell nothing."""
    few = subsample(many(), most)
    assert np.unique(few.index).tolist() == list(range(11, 40, 3))
    assert len(few.index) == points
    assert np.unique(few.board).tolist() == [0, 3], "on all boards"


def test_points_selected_and_joined_keep_all_that_is_known_of_them() -> None:
    data = many()
    kept = data.board == 3
    again = concatenate([select(data, kept), select(data, ~kept)])
    order = np.argsort(~kept, kind="stable")
    for name in ("index", "board", "points", "per_pixel", "sigma_px"):
        assert np.array_equal(getattr(again, name), getattr(data, name)[order])


def test_a_board_out_of_place_shifts_and_tilts_its_points() -> None:
    data = many()
    errors = data.board_errors
    normal = np.array([-0.5, 0.0, 1.0]) / np.sqrt(1.25)
    for board in (0, 3):
        own = data.board == board
        effects = errors.effects[own]
        # A shift and two tilts, of unit variance and independent of each other.
        np.testing.assert_allclose(effects.T @ effects / own.sum(), np.eye(3), atol=1e-9)
        np.testing.assert_array_equal(effects[:, 0], 1.0)
        # Along the ray, so far that it is a millimetre along the board's normal.
        np.testing.assert_allclose(np.abs(errors.along_ray[own] @ normal), 1.0)
        rays = data.points[own] / np.linalg.norm(data.points[own], axis=1)[:, None]
        moved = errors.along_ray[own]
        np.testing.assert_allclose(np.cross(moved, rays), 0.0, atol=1e-9)
        depth = data.points[own] / data.points[own][:, 2:]
        np.testing.assert_allclose(errors.facing[own], np.abs(depth @ normal))
