"""Stripes lie where the board is, flat or bent, on the face that was seen."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from lit_boards import CHAPTER_POSES, chapter_scene

from bodyscan.arrays import Array
from bodyscan.calibration.board_views import BoardFace, BoardShape, LocatedView
from bodyscan.calibration.boundary_points import (
    BIN_PX,
    BoardBoundaries,
    StripedView,
    compute_box,
    compute_print_box,
    locate_boundaries_on_boards,
    on_board,
    thin_bands,
)
from bodyscan.geometry.lenses.opencv import Radial
from bodyscan.rig.board import Board
from bodyscan.stripes.codes.gray import Gray

SCENE = chapter_scene()
BOARD = Board(name="board", columns=9, rows=7, square_mm=20.0, faces=2, thickness_mm=6.0)
X, Y = np.meshgrid(20.0 * np.arange(1, 9), 20.0 * np.arange(1, 7))
FRONT = np.column_stack([X.ravel(), Y.ravel(), np.zeros(X.size)])
CORNERS = np.concatenate([FRONT, FRONT + [0.0, 0.0, 6.0]])


def bow(places: Array) -> Array:
    """mm: a bowl of 0.8 mm, steeper towards one side."""
    x, y = places[..., 0] / 90.0 - 1.0, places[..., 1] / 70.0 - 1.0
    return 0.8 * (1.0 - x**2) - 0.3 * y**2 + 0.1 * x**3


def shape(noise_mm: float = 0.0) -> BoardShape:
    rng = np.random.default_rng(0)
    lifted = np.column_stack([np.zeros((len(CORNERS), 2)), bow(CORNERS[:, :2])])
    return BoardShape(CORNERS, lifted + rng.normal(0.0, noise_mm, lifted.shape))


def striped(face_mm: float) -> list[StripedView]:
    """Boundaries at known places of bent boards, seen by a camera; their truth is `bow` alone."""
    rng = np.random.default_rng(1)
    found = []
    for number, pose in enumerate(CHAPTER_POSES):
        camera_from_board = SCENE.looking_at(*pose)
        places = rng.uniform([15.0, 15.0], [165.0, 125.0], (200, 2))
        points = np.column_stack([places, face_mm + bow(places)])
        pixels = SCENE.camera.project(camera_from_board.apply(points))
        corners = shape().apply(CORNERS[CORNERS[:, 2] == face_mm])
        view = LocatedView("p1", f"b{number}", "board", corners, pixels, camera_from_board, ())
        boundaries = BoardBoundaries(np.arange(200), pixels, np.full(200, 0.1))
        found.append(StripedView(view, BOARD, boundaries, shape(0.01).face(corners)))
    return found


def off_mm(shots: list[StripedView], face_mm: float) -> Array:
    """How far carried points lie over the true board, in its own frame."""
    code = Gray(stripes=254, direction="vertical")
    carried = locate_boundaries_on_boards("p1", SCENE.camera, code, shots)
    heights = []
    for number, shot in enumerate(shots):
        points = carried.points[carried.board == number]
        x, y, z = shot.view.camera_from_board.inverse().apply(points).T
        heights.append(z - face_mm - bow(np.column_stack([x, y])))
    return np.concatenate(heights)


@pytest.mark.parametrize("face_mm", [0.0, 6.0])
def test_stripes_are_carried_onto_the_bent_face_that_was_seen(face_mm: float) -> None:
    shots = striped(face_mm)
    # 48 corners that are known to 0.01 mm each tell ten coefficients: 0.005 mm, twice that at a rim
    # one square beyond them.
    assert np.abs(off_mm(shots, face_mm)).max() < 0.03
    flat = [replace(shot, face=None) for shot in shots]
    assert np.abs(off_mm(flat, face_mm)).max() > 0.5


def test_a_face_goes_through_its_corners_and_no_further_than_they_say() -> None:
    face = BoardFace.fit(FRONT + [0.0, 0.0, 2.0])
    beyond = np.array([[0.0, 0.0], [180.0, 140.0]])
    np.testing.assert_allclose(face.z_mm + face.height(beyond), 2.0, atol=1e-9)
    few = BoardFace.fit(FRONT[:6])  # one row, which says nothing of the other direction
    np.testing.assert_allclose(few.height(beyond), 0.0, atol=1e-9)


def test_the_box_of_a_print_holds_it_all_and_little_else() -> None:
    place = SCENE.looking_at(*CHAPTER_POSES[0])
    rim = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [1.0, 1.0]])
    area = np.array([BOARD.columns, BOARD.rows]) * BOARD.square_mm
    # Straight edges: corners are extreme.
    print_px = SCENE.camera.project(place.apply(np.column_stack([rim * area, np.zeros(4)])))
    corners = SCENE.camera.project(place.apply(FRONT))
    view = LocatedView("p1", "b1", "board", FRONT, corners, place, ())
    low, high = compute_print_box(SCENE.camera, BOARD, view)
    np.testing.assert_allclose(low, print_px.min(axis=0) - 16.0, atol=1.0)  # the lens bends them
    np.testing.assert_allclose(high, print_px.max(axis=0) + 16.0, atol=1.0)
    folded = replace(SCENE.camera, lens=Radial(k1=-1.0 / 3.0 / 0.01))  # one to one up to 0.1 alone
    assert np.array_equal(compute_print_box(folded, BOARD, view), compute_box(view))


def test_boundaries_are_averaged_in_pieces_on_the_print_alone() -> None:
    code, place = Gray(stripes=254, direction="vertical"), SCENE.looking_at(*CHAPTER_POSES[0])
    index, pixels = SCENE.crossings(place, 1)
    rim = 0.1 * BOARD.square_mm
    area = np.array([BOARD.columns, BOARD.rows]) * BOARD.square_mm
    met = SCENE.on_board(pixels, place)
    inside = np.all((met > rim) & (met < area - rim), axis=1)
    assert np.sum(~inside) > 50
    seen = BoardBoundaries(index, pixels, np.full(len(index), 0.2))
    found = on_board(SCENE.camera, code, BOARD, place, seen, 0)
    assert 0.8 * BIN_PX < inside.sum() / len(found.index) < BIN_PX
    # A mean of n of them is known 1 / sqrt(n) as well.
    np.testing.assert_allclose(np.sum(1.0 / found.sigma_px**2), inside.sum() / 0.2**2)
    # Over 16 px a boundary bends by less than a hundredth of a stripe.
    assert np.abs(SCENE.projector.stripe(found.points) - found.index).max() < 0.01


def test_more_views_need_fewer_bands_of_each_but_four() -> None:
    """30 bins along each of 320 boundaries; a fit takes 25,000."""
    along, index = (part.ravel() for part in np.meshgrid(np.arange(30), np.arange(320)))
    pixels = np.column_stack([16.0 * along + 8.0, index])
    seen = BoardBoundaries(index, pixels, np.ones(len(index)))
    left = [thin_bands(seen, "horizontal", views, 0).index for views in (2, 8, 200)]
    assert [len(some) / 320 for some in left] == [30, 10, 5]
    assert all(len(np.unique(some)) == 320 for some in left), "every boundary is in each view"


def test_views_take_turns_in_bands_along_the_stripes_of_either_direction() -> None:
    pixels = np.argwhere(np.ones((192, 192))).astype(float)
    every = BoardBoundaries(np.arange(len(pixels)), pixels, np.ones(len(pixels)))
    boundaries = replace(every, crossing=every)
    parts = [thin_bands(boundaries, "horizontal", 3, turn) for turn in (3, 1, 2)]
    crossing = [part.crossing for part in parts if part.crossing]
    for along, found in enumerate((parts, crossing)):
        index = np.concatenate([part.index for part in found])
        assert np.array_equal(np.sort(index), every.index)
        assert set(found[0].pixels[:, along]) >= {*range(16), *range(48, 64)}
