"""A camera whose boards fill too little of its picture is named."""

from pathlib import Path

import numpy as np
import pytest

from bodyscan.boards.view import BoardView
from bodyscan.calibration.coverage import coverage_notes, covered_share
from bodyscan.rig.rig_file import load_rig


def corners(left: float, top: float, width: float, height: float) -> np.ndarray:
    u, v = np.meshgrid(np.linspace(left, left + width, 8), np.linspace(top, top + height, 6))
    return np.column_stack([u.ravel(), v.ravel()])


@pytest.mark.parametrize(("width", "height", "share"), [(320, 240, 0.25), (143, 107, 0.05)])
def test_the_share_of_the_picture_is_that_of_the_hull(
    width: int, height: int, share: float
) -> None:
    # The picture is divided into 64 cells each way: a rim of half a cell is in doubt.
    doubt = (width / 640 + height / 480) / 64 + 0.001
    assert covered_share([corners(100, 90, width, height)], 640, 480) == pytest.approx(
        share, abs=doubt
    )


def test_a_board_from_rim_to_rim_covers_all() -> None:
    assert covered_share([corners(0, 0, 639, 479)], 640, 480) == 1.0


def test_views_in_the_same_place_cover_no_more() -> None:
    one, beside = corners(0, 0, 320, 240), corners(320, 240, 319, 239)
    assert covered_share([one, one], 640, 480) == covered_share([one], 640, 480)
    assert covered_share([one, beside], 640, 480) == pytest.approx(0.5, abs=0.04)


@pytest.mark.parametrize(("size", "named"), [(0.22, True), (0.6, False)])
def test_only_a_small_board_is_noted(tmp_path: Path, size: float, named: bool) -> None:
    rig = load_rig(Path("rigs/one-pair.yaml"))
    (pair,) = rig.pairs
    width, height = pair.camera.width, pair.camera.height
    views = [
        BoardView(
            pair=pair.name,
            shot=f"shot{number}",
            board=rig.boards[0].name,
            corner_ids=np.arange(48),
            pixels=corners(0.2 * width, 0.2 * height, size * width, size * height),
        )
        for number in range(3)
    ]
    notes = coverage_notes(rig, views)
    assert bool(notes) == named
    if named:
        assert pair.name in notes[0]
        assert "5 %" in notes[0]
        assert "closer" in notes[0]
