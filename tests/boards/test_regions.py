"""Pictures without a lattice of saddles are left alone, and no board's picture is."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from bodyscan.boards.checkerboard import find_board_regions, find_checkerboard, shows_lattice
from bodyscan.rig.board import Board

BOARD = Board(name="b", kind="checkerboard", columns=10, rows=7, square_mm=30.0)
SIZE = (9, 6)


def board_picture(square_px: float) -> np.ndarray:
    """A board, slanted, in a picture of 640 x 480 with light from one side."""
    even = np.add.outer(np.arange(7), np.arange(10)) % 2
    flat = np.kron(np.pad(even, 1, constant_values=1), np.ones((40, 40))) * 150.0 + 30.0
    corners = np.array([[0, 0], [480, 0], [480, 360], [0, 360]], np.float32)
    slanted = np.array([[0, 0.5], [11.5, 0], [12, 8.5], [0.5, 8]], np.float32) * square_px + 30.0
    warp = cv2.getPerspectiveTransform(corners, slanted)
    image = cv2.warpPerspective(flat, warp, (640, 480), flags=cv2.INTER_AREA, borderValue=90.0)
    return image * np.linspace(0.5, 1.2, 640)


def grey(image: np.ndarray, blur_px: float = 0.7, noise: float = 3.0) -> np.ndarray:
    blurred = cv2.GaussianBlur(image, (0, 0), blur_px)
    noisy = blurred + np.random.default_rng(0).normal(0.0, noise, image.shape)
    return np.clip(noisy, 0, 255).astype(np.uint8)


@pytest.mark.parametrize(
    ("square_px", "blur_px", "noise"),
    [(45.0, 0.7, 3.0), (10.0, 0.7, 3.0), (45.0, 8.0, 3.0), (45.0, 0.7, 30.0), (25.0, 3.0, 12.0)],
    ids=["plain", "fine", "blurred", "noisy", "both"],
)
def test_boards_show_a_lattice(square_px: float, blur_px: float, noise: float) -> None:
    assert shows_lattice(grey(board_picture(square_px), blur_px, noise), SIZE)


def skin_and_cloth() -> np.ndarray:
    """Soft shapes, stripes, and a texture of spots: saddles by the hundred."""
    rng = np.random.default_rng(1)
    spots = cv2.GaussianBlur(rng.normal(0.0, 1.0, (480, 640)), (0, 0), 4.0)
    stripes = 40.0 * np.sign(np.sin(np.arange(640) / 6.0)) * (np.arange(640) > 400)
    return 90.0 + 500.0 * spots + stripes


@pytest.mark.parametrize("picture", [skin_and_cloth(), np.full((480, 640), 60.0)])
def test_slow_detectors_do_not_run_without_a_lattice(
    picture: np.ndarray, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise AssertionError("a slow detector ran")

    monkeypatch.setattr(cv2, "findChessboardCornersSB", refuse)
    assert find_checkerboard(grey(picture, noise=6.0), BOARD) is None


def test_a_large_board_out_of_focus_shows_its_lattice() -> None:
    even = np.add.outer(np.arange(7), np.arange(10)) % 2
    flat = np.pad(np.kron(even, np.ones((100, 100))) * 150.0 + 40.0, 50, constant_values=150.0)
    assert shows_lattice(grey(flat, blur_px=30.0, noise=1.0), SIZE)


def sides(region: tuple[slice, slice]) -> list[int]:
    rows, columns = region
    return [columns.start, rows.start, columns.stop, rows.stop]


def test_regions_hold_boards_with_a_margin_the_larger_first() -> None:
    """Two boards far apart; corners of the first lie from 220 to 360 px and from 120 to 210 px,
    its own outermost among them."""
    image = np.full((480, 640), 150, np.uint8)
    for left, top, columns, rows in ((220, 120, 14, 9), (500, 350, 8, 6)):
        even = np.add.outer(np.arange(rows), np.arange(columns)) % 2
        part = np.kron(even, np.ones((10, 10))) * 150 + 40
        image[top : top + 10 * rows, left : left + 10 * columns] = part
    found = find_board_regions(image, 13 * 8)
    # 104 corners are asked for; seven tenths of that would be more than the second board has.
    assert len(found) == 1
    (one,) = found
    expected = (220 - 21 - 20, 120 - 13 - 20, 360 + 21 + 20, 210 + 13 + 20)
    assert np.abs(np.array(sides(one)) - expected).max() <= 3
    both = find_board_regions(image, 45)
    assert len(both) == 2
    assert both[0] == one
    expected = (500 - 12 - 20, 350 - 9 - 20, 580 + 12 + 20, 410 + 9 + 20)
    assert np.abs(np.array(sides(both[1])) - expected).max() <= 3
