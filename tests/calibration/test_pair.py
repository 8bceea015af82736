"""What a pair's calibration does with shots whose stripes disagree."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from bodyscan.calibration import pair
from bodyscan.calibration.board_views import LocatedView
from bodyscan.calibration.boundary_points import BoardBoundaries, StripedView
from bodyscan.calibration.model_selection import HeldOutModel
from bodyscan.calibration.pair import PairQuality, ProjectorMotion, drop_inconsistent
from bodyscan.errors import PairFailed
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.outcome import Outcome
from bodyscan.rig.board import Board

NOTHING = np.zeros((0, 3))
BOARD = Board(name="board", columns=8, rows=5, square_mm=30.0)
STRIPES = BoardBoundaries(np.zeros(0, np.int64), np.zeros((0, 2)), np.zeros(0))
SHOTS = [
    StripedView(
        LocatedView("p1-1", shot, "board", NOTHING, NOTHING, RigidTransform.identity(), ()),
        BOARD,
        STRIPES,
    )
    for shot in ("a", "b", "c", "d", "e")
]


def drop(
    monkeypatch: pytest.MonkeyPatch, split: ProjectorMotion | None
) -> Outcome[tuple[StripedView, ...]]:
    """Drop shots of SHOTS as a split of their boards says."""
    monkeypatch.setattr(pair, "boundaries_on_boards", lambda *_: None)
    monkeypatch.setattr(pair, "find_projector_motion", lambda *_: split)
    nothing: Any = SimpleNamespace(stripes=64, direction="vertical")
    return drop_inconsistent("p1-1", nothing, nothing, SHOTS)


def test_shots_that_do_not_fit_the_others_are_dropped_and_named(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    found = ProjectorMotion(np.array([0, 1, 3, 4]), np.array([2]), 2.5, 0.1)
    kept = drop(monkeypatch, found)
    assert [shot.view.shot for shot in kept.value] == ["a", "b", "d", "e"]
    (note,) = kept.notes
    assert note.startswith("p1-1: the stripes of shot c do not fit the others'")
    assert "2.5 px" in note
    two = ProjectorMotion(np.array([0, 1, 3]), np.array([2, 4]), 2.5, 0.1)
    (note,) = drop(monkeypatch, two).notes
    assert note.startswith("p1-1: the stripes of shots c, e do not fit the others'")


def test_a_projector_that_moved_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    found = ProjectorMotion(np.array([0, 1, 2]), np.array([3, 4]), 2.5, 0.1, moved=True)
    with pytest.raises(PairFailed, match="changed between shots c and d") as error:
        drop(monkeypatch, found)
    assert error.value.where == "pair p1-1"


def test_light_that_another_program_calibrated_is_called_so_and_other_light_by_its_model() -> None:
    tried = tuple(
        HeldOutModel(name, 0.1, 0.1, 0.1, 1.0, name == "lens") for name in ("planes", "lens")
    )
    assert PairQuality(0.1, 5, held_out=tried).light_model == "lens"
    assert PairQuality(0.1, 5, held_out=tried[:1]).light_model is None
    assert (
        PairQuality(None, 0, imported="theirs.json", stripes_projected=63).light_model == "imported"
    )
    # A camera alone, without light of its own.
    camera = PairQuality(None, 0, imported="theirs.json")
    assert camera.light_model is None
    # Nothing is known of the accuracy of what was imported without a sigma.
    assert camera.unjudged
    assert not PairQuality(None, 0, imported="theirs.json", imported_sigma_px=0.0).unjudged
    assert not PairQuality(0.1, 5).unjudged
