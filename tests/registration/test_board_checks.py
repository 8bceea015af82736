"""A board that is not what the rig file says is named, and what to look at."""

from __future__ import annotations

import numpy as np

from bodyscan.boards.view import BoardView
from bodyscan.registration.board_checks import boards_not_found, describe_findings
from bodyscan.rig.board import Board
from bodyscan.rig.rig import Rig

RIG = Rig.model_validate(
    {
        "name": "one",
        "boards": (
            Board(name="seen", columns=9, rows=7, square_mm=50),
            Board(name="unseen", columns=10, rows=7, square_mm=20),
        ),
        "pairs": ({"name": "a", "camera": {"width": 640, "height": 480}},),
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
    said = describe_findings(RIG, [view(10), view(12), view(48)], 30)
    assert "found in 3 of 30 images, with 25 % of its corners in the usual one" in said
    assert "may not be those" in said
    assert "may not be those" in describe_findings(RIG, [view(23)], 30)
    assert "may not be those" not in describe_findings(RIG, [view(24)], 30)
    assert "may not be those" not in describe_findings(RIG, [view(45)], 30)
