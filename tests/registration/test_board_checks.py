"""Notes on boards that look otherwise than the rig file describes them, or were not found."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from ring import CHARUCO, board_poses, ring_of_cameras, ring_rig, ring_views

from bodyscan.boards.board_layout import compute_corner_grid, compute_corner_points
from bodyscan.boards.view import Appearance, BoardView
from bodyscan.calibration.board_views import match_corners
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.registration.board_checks import (
    correct_stretch,
    describe_findings,
    find_common_aspect,
    list_boards_not_found,
    note_appearance,
)
from bodyscan.rig.board import Board
from bodyscan.rig.rig import Rig
from bodyscan.workflows.find_boards import calibrate_cameras

MARKED = Board(name="m", kind="charuco", columns=9, rows=8, square_mm=50, marker_mm=40)
PAIR = {"name": "p", "camera": {"width": 9, "height": 9}}
RIG = Rig.model_validate({"name": "r", "boards": (MARKED,), "pairs": [PAIR]})
COLUMNS, ROWS = compute_corner_grid(MARKED)


def view(columns: int, rows: int, appearance: Appearance | None = None) -> BoardView:
    """The first corners of the board."""
    ids = (np.arange(rows)[:, None] * COLUMNS + np.arange(columns)).ravel()
    of = () if appearance is None else (False, appearance)
    return BoardView("p", "s", "m", ids, np.zeros((len(ids), 2)), *of)


def said(*views: BoardView) -> Sequence[str]:
    return note_appearance(RIG, views)


def test_every_other_look_is_told_with_how_many_views_had_it() -> None:
    looks = {
        "white on black in 2 views (p)": Appearance(inverted=True),
        "mirrored in 2 views (p)": Appearance(mirrored=True),
        "legacy_layout: true) in 2 views (p)": Appearance(other_layout=True),
    }
    for words, look in looks.items():
        plain, other = view(COLUMNS, ROWS), view(COLUMNS, ROWS, look)
        (note,) = said(plain, other, other)
        assert words in note
        assert "Other cameras" not in note  # the same camera saw it both ways
    assert not said(view(COLUMNS, ROWS))


BOARDS = (
    Board(name="seen", columns=9, rows=7, square_mm=50),
    Board(name="unseen", columns=10, rows=7, square_mm=20),
)
TWO_BOARDS = Rig.model_validate({"name": "one", "boards": BOARDS, "pairs": [PAIR]})


def partial_view(count: int) -> BoardView:
    return BoardView("a", "s1", "seen", np.arange(count), np.zeros((count, 2)))


def test_a_board_never_found_is_named_with_what_the_rig_file_says() -> None:
    (note,) = list_boards_not_found(TWO_BOARDS, [partial_view(48)], 30)
    assert "board unseen" in note
    assert "10 columns x 7 rows" in note
    assert "none of 30 images" in note


def test_a_board_of_which_little_is_found_is_doubted() -> None:
    said = describe_findings(TWO_BOARDS, [partial_view(10), partial_view(12), partial_view(48)], 30)
    assert "found in 3 of 30 images, with 25 % of its corners in the median view" in said
    assert "may not be those" in said


@pytest.mark.parametrize(("stretch", "roll"), [(1.02, 0), (0.92, 0), (0.993, 1), (1.0, 1)])
def test_a_stretched_print_is_told_from_oblong_pixels(stretch: float, roll: int) -> None:
    placings, cameras = ring_of_cameras(heights=(700, 1200))
    placings = {name: placings[name] for name in ("p1-1", "p1-2")}
    cameras = {name: cameras[name] for name in placings}
    points = compute_corner_points(printed := CHARUCO.model_copy(update={"stretch": stretch}))
    middle = RigidTransform.from_translation([315, 245, 0])
    rolls = (RigidTransform.from_rotation_vector([0, 0, roll * k], [0, 0, 0]) for k in range(12))
    placed = zip(board_poses(12, np.random.default_rng(0)), rolls, strict=True)
    poses = [pose @ middle @ turn @ middle.inverse() for pose, turn in placed]
    views = [
        BoardView(v.pair, v.shot, v.board, match_corners(v.points, points), v.pixels)
        for v in ring_views(placings, cameras, poses=poses, board=printed)[0]
    ]
    found = calibrate_cameras(ring_rig(placings), views).value
    corrected, notes = correct_stretch(ring_rig(placings), views, found)
    assert corrected.boards[0].stretch == pytest.approx(stretch, abs=5e-4)
    assert len(notes) == (stretch != 1.0)
    found = calibrate_cameras(corrected, views).value
    assert max(one.rms_px for one in found.values()) < 0.06, "with noise of 0.04"
    assert find_common_aspect((one.camera, one.covariance) for one in found.values()) == 1.0
