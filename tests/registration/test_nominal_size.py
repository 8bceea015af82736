"""The limits by which a calibrated pair is good, and a rig's size against its nominal places."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from bodyscan.errors import FailedWork
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.registration.calibration_verdict import PairFigures
from bodyscan.registration.rig_calibration import find_nominal_size, refuse_wrong_size
from bodyscan.rig.board import Board
from bodyscan.rig.rig import Rig

PLACES = {"a": (1000.0, 0.0, 500.0), "b": (0.0, 1000.0, 500.0), "c": (-1000.0, 0.0, 900.0)}
BOARDS = (
    Board(name="seen", columns=9, rows=7, square_mm=50),
    Board(name="unseen", columns=10, rows=7, square_mm=20),
)


def rig_of(places: dict[str, tuple[float, float, float]]) -> Rig:
    pairs = [
        {
            "name": name,
            "camera": {"width": 640, "height": 480},
            "nominal": {"position_mm": place, "look_at_mm": (0, 0, 500)},
        }
        for name, place in places.items()
    ]
    return Rig.model_validate({"name": "some", "boards": BOARDS, "pairs": tuple(pairs)})


RIG = rig_of(PLACES)


def placed(factor: float) -> dict[str, RigidTransform]:
    return {n: RigidTransform(np.eye(3), factor * np.array(p)) for n, p in PLACES.items()}


def test_squares_of_another_size_show_in_the_size_of_the_rig() -> None:
    for factor, mark in ((1.04, "usable"), (1.02, "good"), (0.96, "usable")):
        size = find_nominal_size(RIG, placed(factor))
        assert size is not None
        assert size.mark == mark
        assert f"{factor:.3f} times" in size.words
        refuse_wrong_size(RIG, placed(factor))
        if factor == 1.04:
            assert "48.08 would fit" in size.remedy
            # What another program calibrated: only `nominal` can be mended here.
            boardless = find_nominal_size(RIG.model_copy(update={"boards": ()}), placed(factor))
            assert boardless is not None
            assert "correct `nominal`" in boardless.remedy


@pytest.mark.parametrize("factor", [0.1, 0.89, 1.11, 10.0])
def test_a_size_that_no_tape_measure_errs_by_is_refused(factor: float) -> None:
    """Centimetres for millimetres; a print scaled to another paper."""
    with pytest.raises(FailedWork, match=f"{factor:.3f} times as far apart") as refused:
        refuse_wrong_size(RIG, placed(factor))
    assert "square_mm may be wrong" in str(refused.value)


def test_one_camera_whose_nominal_place_is_wrong_hides_no_size() -> None:
    """Of five: six of ten distances are right."""
    places = {**PLACES, "d": (0.0, -1000.0, 500.0), "e": (700.0, 700.0, 1500.0)}
    stand = {n: RigidTransform(np.eye(3), 1.04 * np.array(p)) for n, p in places.items()}
    size = find_nominal_size(rig_of({**places, "e": (700.0, 3700.0, 1500.0)}), stand)
    assert size is not None
    assert size.ratio == pytest.approx(1.04, abs=0.01)
    assert find_nominal_size(RIG, {"a": placed(1.0)["a"]}) is None  # one alone has no size


AT_THE_LIMITS = PairFigures("p", 0.3, 6, 40.0, 0.3, 0.5, 4, 50.0, 0.5)
NOTHING_KNOWN = PairFigures("p", None, None, None, None, None, None, None, None)


def test_a_pair_at_its_limits_is_good_and_what_is_not_known_is_not_judged() -> None:
    assert [*AT_THE_LIMITS.beyond(), *NOTHING_KNOWN.beyond()] == []


@pytest.mark.parametrize(
    ("name", "value", "times", "words"),
    [
        ("corners_rms_px", 0.33, 1.1, "corner residuals are 0.33 px RMS (at most 0.3 is good)"),
        ("poses", 3, 2.0, "was calibrated from 3 board poses (at least 6 is good)"),
        ("covered_percent", 16.0, 2.5, "boards covered 16 % of its image (at least 40 is good)"),
        (
            "sheets_rms_mm",
            0.6,
            2.0,
            "light sheets have residuals of 0.6 mm RMS (at most 0.3 is good)",
        ),
        ("held_out_mm", 1.5, 3.0, "held-out boards are missed by 1.5 mm (at most 0.5 is good)"),
        ("stripe_shots", 2, 2.0, "stripes were decoded on 2 boards (at least 4 is good)"),
        ("stripe_shots", 0, 4e9, "stripes were decoded on 0 boards (at least 4 is good)"),
        ("stripes_percent", 40.0, 1.25, "has planes for 40 % of its stripes (at least 50 is good)"),
        ("sigma_mm", 0.51, 1.02, "its position has a sigma of 0.51 mm (at most 0.5 is good)"),
    ],
)
def test_a_limit_that_is_not_kept_is_told_with_how_far_it_is_missed(
    name: str, value: float, times: float, words: str
) -> None:
    for others in (AT_THE_LIMITS, NOTHING_KNOWN):
        changed: dict[str, Any] = {name: value}
        ((missed_by, error, said),) = replace(others, **changed).beyond()
        assert missed_by == pytest.approx(times)
        assert said == words
        assert error == ("at most" in words)
