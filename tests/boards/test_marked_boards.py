"""Boards with markers that look otherwise than described, grids of AprilTags, and what is said where
none is found."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from board_rendering import render, true_corners, view_of
from small_captures import write

from bodyscan.arrays import Array, Bytes
from bodyscan.boards.board_layout import compute_corner_points
from bodyscan.boards.charuco import detect_markers
from bodyscan.boards.detection import find_boards
from bodyscan.boards.detection_failure import describe_unfound
from bodyscan.boards.view import BoardView
from bodyscan.captures.folder import open_captures
from bodyscan.errors import BadInput, BodyscanError
from bodyscan.outcome import Outcome
from bodyscan.registration.board_checks import note_appearance, refuse_other_pitch
from bodyscan.rig.board import Board
from bodyscan.rig.frame_names import CaptureFolder
from bodyscan.rig.pair import CameraSpec, Pair
from bodyscan.rig.rig import Rig
from bodyscan.workflows.find_boards import find_all_boards, require_cameras

MARKED = Board(
    name="marked", kind="charuco", columns=9, rows=8, square_mm=70, marker_mm=52, margin_mm=10
)
PLACE = view_of(MARKED, 30, 60, 20, fill=0.8)
CAMERA = Pair(name="p", camera=CameraSpec(width=640, height=512))
TAGS = Board(name="tags", kind="aprilgrid", columns=5, rows=4, square_mm=130, marker_mm=100)


def found(image: Bytes, board: Board) -> list[BoardView]:
    return find_boards(image, [board], pair="p", shot="s")


def rms(view: BoardView, true: Array) -> float:
    return float(np.sqrt(np.mean((view.pixels - true[view.corner_ids]) ** 2)))


@pytest.fixture(scope="module")
def picture() -> Bytes:
    return render([(MARKED, PLACE)], blur_px=0.8)


@pytest.mark.parametrize("inverted", [False, True])
@pytest.mark.parametrize("mirrored", [False, True])
def test_a_marked_board_is_recognised_whichever_way_it_is_seen(
    picture: Bytes, inverted: bool, mirrored: bool
) -> None:
    true = true_corners(MARKED, PLACE)
    image = 255 - picture if inverted else picture
    if mirrored:
        image = np.ascontiguousarray(image[:, ::-1])
        true = np.array([639.0, 0.0]) + np.array([-1.0, 1.0]) * true
    (view,) = found(image, MARKED)
    assert (view.appearance.inverted, view.appearance.mirrored) == (inverted, mirrored)
    assert len(view.corner_ids) >= 50
    assert rms(view, true) < 0.012, "as well as one seen as printed"


@pytest.mark.parametrize("dictionary", ["DICT_4X4_50", "DICT_4X4_1000", "DICT_6X6_250"])
def test_looking_for_few_markers_finds_those_as_well(dictionary: str) -> None:
    """The dictionary's others are not there; errors in bits are corrected as far, and not farther."""
    board = MARKED.model_copy(update={"dictionary": dictionary})
    image = render([(board, PLACE)], blur_px=1.6)
    every = detect_markers(image, board)
    some = detect_markers(image, board, first=20)
    concerned = every.ids < 20
    order = np.argsort(every.ids[concerned]), np.argsort(some.ids)
    assert 10 < len(some.ids) < len(every.ids)
    np.testing.assert_array_equal(every.ids[concerned][order[0]], some.ids[order[1]])
    np.testing.assert_array_equal(every.corners[concerned][order[0]], some.corners[order[1]])


def test_either_of_the_two_historic_layouts_is_recognised(picture: Bytes) -> None:
    described = MARKED.model_copy(update={"legacy_layout": True})
    (view,) = found(picture, described)
    assert view.appearance.other_layout
    # A square off, and half of the markers, is what the other layout makes of the same picture.
    assert rms(view, true_corners(MARKED, PLACE)) < 0.012
    rig = Rig(name="r", boards=(described,), pairs=(CAMERA,))
    assert "legacy_layout: false" in note_appearance(rig, [view])[0]


@pytest.mark.slow
def test_other_columns_and_another_dictionary_are_named(picture: Bytes) -> None:
    for wrong, named in (
        ({"columns": 10}, "board of 9 columns x 8 rows, not 10 x 8"),
        ({"dictionary": "DICT_5X5_1000"}, "0 markers of DICT_5X5_1000, but 3"),
    ):
        described = MARKED.model_copy(update=wrong)
        assert found(picture, described) == []
        assert named in describe_unfound(picture, described).text


def tag_picture(*, border_bits: int, turns: int, from_below: bool) -> tuple[Bytes, Array]:
    """A grid as Kalibr (2 bits, from below) or others print it, and its corners' pixels."""
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    side, gap, unit = 300, 90, 390
    sheet = np.full((4 * unit + gap, 5 * unit + gap), 255, np.uint8)
    for tag in range(20):
        row, column = divmod(tag, 5)
        row = 3 - row if from_below else row
        cells = cv2.aruco.generateImageMarker(
            dictionary, tag, (6 + 2 * border_bits) * 10, borderBits=border_bits
        )
        cells = cv2.resize(np.rot90(cells, turns), (side, side), interpolation=cv2.INTER_NEAREST)
        sheet[gap + row * unit :, gap + column * unit :][:side, :side] = cells
    for row in range(5):
        for column in range(6):
            sheet[row * unit : row * unit + gap, column * unit : column * unit + gap] = 0
    sheet = cv2.copyMakeBorder(sheet, 60, 60, 60, 60, cv2.BORDER_CONSTANT, value=(255,))
    height, width = sheet.shape
    corners = np.array([[0, 0], [width, 0], [width, height], [0, height]], np.float32) - 0.5
    seen = np.array([[450, 180], [1800, 300], [1680, 1320], [300, 1200]], np.float32)
    bend = cv2.getPerspectiveTransform(corners, seen)
    fine = cv2.warpPerspective(sheet, bend, (2100, 1536), borderValue=(90,))
    small = cv2.resize(
        cv2.GaussianBlur(fine, (0, 0), 2.1), (700, 512), interpolation=cv2.INTER_AREA
    )
    # 3 px of the sheet a mm, and half a gap and the rim before the first tag's square.
    on_sheet = 3.0 * compute_corner_points(TAGS)[:, :2] + 60 + gap / 2 - 0.5
    pixels = cv2.perspectiveTransform(on_sheet[None], bend)[0]
    noise = np.random.default_rng(0).normal(0, 1, small.shape)
    image = np.clip(0.7 * small + 20 + noise, 0, 255).astype(np.uint8)
    return image, (pixels + 0.5) / 3.0 - 0.5


@pytest.mark.parametrize(
    ("border_bits", "turns", "from_below"), [(2, 2, True), (1, 0, False), (2, 1, True)]
)
def test_grids_of_april_tags_are_found(border_bits: int, turns: int, from_below: bool) -> None:
    image, true = tag_picture(border_bits=border_bits, turns=turns, from_below=from_below)
    (view,) = found(image, TAGS)
    assert len(view.corner_ids) == 80
    # Tags of 40 px leave windows of 4 to 8 px: measured 0.004 to 0.008 px with noise of 1 level.
    assert rms(view, true) < 0.015


def test_tags_that_stand_otherwise_than_described_are_refused() -> None:
    image, _ = tag_picture(border_bits=2, turns=2, from_below=True)
    refuse_other_pitch(TAGS, found(image, TAGS))
    described = TAGS.model_copy(update={"square_mm": 127.0})
    with pytest.raises(BadInput, match=r"100 mm stand 130\.0.* not 127") as refused:
        refuse_other_pitch(described, found(image, described))
    assert "or marker_mm 97.69 square" in refused.value.remedy


@pytest.mark.parametrize(("first", "faces"), [(1, 1), (2, 2), (5, 1), (150, 1)])
def test_the_first_marker_is_read_off_the_markers(tmp_path: Path, first: int, faces: int) -> None:
    described = MARKED.model_copy(update={"faces": faces})
    printed = described.model_copy(update={"first_marker": first})
    for back in range(faces):
        place = view_of(MARKED, 30, 60, 20, fill=0.8, back=back == 1)
        write(tmp_path / "captures" / f"s{back}" / "p.png", render([(printed, place)], blur_px=0.8))
    rig = Rig(
        name="r", boards=(described,), pairs=(CAMERA,), files="{shot}/{pair}.png",
        calibration=(CaptureFolder(folder="captures"),),
    )  # fmt: skip
    captures = open_captures(rig, tmp_path / "rig.yaml")
    with pytest.raises(BodyscanError, match=f"on this board with first_marker {first}") as raised:
        require_cameras(rig, captures, find_all_boards(rig, captures), Outcome({}))
    assert "columns" not in str(raised.value)  # the cause is known
    right = rig.model_copy(update={"boards": (printed,)})
    assert len(find_all_boards(right, captures).value) == faces


def test_part_of_a_grid_is_enough() -> None:
    image, true = tag_picture(border_bits=2, turns=2, from_below=True)
    (view,) = found(np.ascontiguousarray(image[:, :400]), TAGS)
    assert 20 < len(view.corner_ids) < 80
    assert rms(view, true) < 0.015
