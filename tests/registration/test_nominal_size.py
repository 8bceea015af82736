"""The size that the boards give a rig is held against the nominal places of its cameras."""

from __future__ import annotations

import numpy as np
import pytest

from bodyscan.errors import FailedWork
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.registration.rig_calibration import nominal_size, refuse_wrong_size
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


def placed(factor: float) -> dict[str, RigidTransform]:
    return {n: RigidTransform(np.eye(3), factor * np.array(p)) for n, p in PLACES.items()}


def test_squares_of_another_size_show_in_the_size_of_the_rig() -> None:
    for factor, mark in ((1.04, "usable"), (1.02, "good"), (0.96, "usable")):
        size = nominal_size(RIG, placed(factor))
        assert size is not None
        assert size.mark == mark
        assert f"{factor:.3f} times" in size.words
        refuse_wrong_size(RIG, placed(factor))
        if factor == 1.04:
            assert "48.08 would fit" in size.remedy


@pytest.mark.parametrize("factor", [0.1, 0.89, 1.11, 10.0])
def test_a_size_that_no_tape_measure_errs_by_is_refused(factor: float) -> None:
    """Centimetres for millimetres; a print scaled to another paper."""
    with pytest.raises(FailedWork, match=f"{factor:.3f} times as far apart") as refused:
        refuse_wrong_size(RIG, placed(factor))
    assert "square_mm may be wrong" in str(refused.value)


def test_a_rig_without_boards_is_told_as_well() -> None:
    """What another program calibrated: only `nominal` can be mended here."""
    size = nominal_size(RIG.model_copy(update={"boards": ()}), placed(1.05))
    assert size is not None
    assert "correct `nominal`" in size.remedy


def rig_of(places: dict[str, tuple[float, float, float]]) -> Rig:
    pairs = [
        {
            "name": name,
            "camera": {"width": 640, "height": 480},
            "nominal": {"position_mm": place, "look_at_mm": (0, 0, 500)},
        }
        for name, place in places.items()
    ]
    return Rig.model_validate({"name": "some", "boards": RIG.boards, "pairs": tuple(pairs)})


def test_one_camera_whose_nominal_place_is_wrong_hides_no_size() -> None:
    """Of five: six of ten distances are right."""
    places = {**PLACES, "d": (0.0, -1000.0, 500.0), "e": (700.0, 700.0, 1500.0)}
    stand = {n: RigidTransform(np.eye(3), 1.04 * np.array(p)) for n, p in places.items()}
    size = nominal_size(rig_of({**places, "e": (700.0, 3700.0, 1500.0)}), stand)
    assert size is not None
    assert size.ratio == pytest.approx(1.04, abs=0.01)


def test_one_camera_alone_has_no_size() -> None:
    assert nominal_size(RIG, {"a": placed(1.0)["a"]}) is None
