"""A board that is not what the rig file says is named, and what to look at."""

from __future__ import annotations

import numpy as np
import pytest

from bodyscan.boards.view import BoardView
from bodyscan.errors import FailedWork
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.registration.board_checks import boards_not_found, check_board_size, describe_findings
from bodyscan.rig.board import Board
from bodyscan.rig.rig import Rig

PLACES = {"a": (1000.0, 0.0, 500.0), "b": (0.0, 1000.0, 500.0), "c": (-1000.0, 0.0, 900.0)}
RIG = Rig.model_validate(
    {
        "name": "three",
        "boards": (
            Board(name="seen", columns=9, rows=7, square_mm=50),
            Board(name="unseen", columns=10, rows=7, square_mm=20),
        ),
        "pairs": tuple(
            {
                "name": name,
                "camera": {"width": 640, "height": 480},
                "nominal": {"position_mm": place, "look_at_mm": (0, 0, 500)},
            }
            for name, place in PLACES.items()
        ),
    }
)


def view(count: int) -> BoardView:
    return BoardView("a", "s1", "seen", np.arange(count), np.zeros((count, 2)))


def test_a_board_never_found_is_named_with_what_the_rig_file_says() -> None:
    (note,) = boards_not_found(RIG, [view(48)], 30)
    assert "board unseen" in note
    assert "10 columns x 7 rows" in note
    assert "none of 30 images" in note


def test_a_board_of_which_little_is_found_is_doubted() -> None:
    assert "may not be those" in describe_findings(RIG, [view(10)], 30)
    assert "may not be those" not in describe_findings(RIG, [view(45)], 30)


def placed(factor: float) -> dict[str, RigidTransform]:
    return {n: RigidTransform(np.eye(3), factor * np.array(p)) for n, p in PLACES.items()}


def test_squares_of_another_size_show_in_the_size_of_the_rig() -> None:
    (note,) = check_board_size(RIG, placed(1.04))
    assert "1.040 times" in note
    assert "48.08 would fit" in note
    assert not check_board_size(RIG, placed(1.02))
    (note,) = check_board_size(RIG, placed(0.96))
    assert "0.960 times" in note


@pytest.mark.parametrize("factor", [0.1, 0.89, 1.11, 10.0])
def test_a_size_that_no_tape_measure_errs_by_is_refused(factor: float) -> None:
    """Centimetres for millimetres; a print scaled to another paper."""
    with pytest.raises(FailedWork, match=f"{factor:.3f} times as far apart") as refused:
        check_board_size(RIG, placed(factor))
    assert "square_mm may be wrong" in str(refused.value)
