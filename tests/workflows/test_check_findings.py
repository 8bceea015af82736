"""What a check of a rig says, and which of its findings can be put right."""

from __future__ import annotations

from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from bodyscan.errors import FailedWork
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.geometry.uncertainty import PoseCovariance
from bodyscan.registration.drift import Move
from bodyscan.workflows.check_rig import BoardCheck, ScanCheck, apply_moves, number_shots


@dataclass(frozen=True)
class Placed:
    """Of a calibration, what a repair changes."""

    rig: Any
    rig_from_camera: dict[str, RigidTransform]
    covariance: PoseCovariance
    notes: tuple[str, ...]


def offset(pair: str, mm: float, moved: bool = False) -> SimpleNamespace:
    imported = "theirs.json" if pair == "q" else ""
    return SimpleNamespace(pair=pair, offset_mm=mm, tilt_mm=-0.31, moved=moved, imported=imported)


def boards(*stripes: SimpleNamespace, together: bool = True, **others: Any) -> BoardCheck:
    drift = SimpleNamespace(
        moves=(), rig_from_board={1: 1} if together else {}, misfit_before=1.26, misfit=0.94,
        lonely=others.pop("lonely", ()),
    )  # fmt: skip
    unseen, notes = others.pop("unseen", ()), others.pop("notes", ())
    return BoardCheck(cast(Any, drift), cast(Any, stripes), ("p", "q"), unseen, notes)


def test_a_rig_that_stood_still_says_by_how_much_it_is_known() -> None:
    found = boards(offset("p", 0.04), offset("q", -0.11))
    assert found.valid
    assert found.lines == (
        "valid: all that see the board agree",
        "2 pairs saw a board; their views differ by 1.3 sigmas RMS",
        "stripes of 2 pairs lie within 0.11 mm of the board (worst: q)",
    )
    alone = boards(offset("p", 0.04), together=False)
    assert alone.lines[0] == "valid: the stripes lie on the board"
    assert len(alone.lines) == 2


def test_a_projector_that_moved_is_told_and_not_put_right() -> None:
    found = boards(offset("p", 0.84, True), offset("q", -2.0, True))
    assert not found.valid
    assert found.lines[:3] == (
        "NOT valid: the stripes do not lie on the board",
        "p: the stripes measure the board +0.84 mm from its corners, tilted by -0.31 mm at its ends. "
        "Possible causes: the projector moved against its camera",
        "q: the stripes measure the board -2.00 mm from its corners, tilted by -0.31 mm at its ends. "
        "Possible causes: the projector moved against its camera, or theirs.json is not its "
        "calibration",
    )
    with pytest.raises(FailedWork, match="projector of p, q moved"):
        found.repair(cast(Any, None))
    with pytest.raises(FailedWork, match="nothing moved"):
        boards(offset("p", 0.04)).repair(cast(Any, None))


def test_what_was_not_checked_is_named() -> None:
    found = boards(unseen=("r", "s"), lonely=("t",), notes=("dim",))
    assert found.lines[2:] == (
        "not checked, because they saw no board: r, s",
        "not checked, because no other pair saw their board: t",
        "note: dim",
    )


@dataclass(frozen=True)
class Sequence:
    shot: str


@dataclass(frozen=True)
class Folder:
    shots: tuple[str, ...]
    sequences: tuple[Sequence, ...]


def test_shots_of_several_folders_are_told_apart_by_their_folders_number() -> None:
    one = Folder(("a", "b"), (Sequence("a"), Sequence("b"), Sequence("b")))
    other = Folder(("a",), (Sequence("a"),))

    def named(*folders: Folder) -> list[Any]:
        return list(number_shots(cast(Any, folders)))

    assert named(one) == [one]
    assert named(one, other) == [
        Folder(("1/a", "1/b"), (Sequence("1/a"), Sequence("1/b"), Sequence("1/b"))),
        Folder(("2/a",), (Sequence("2/a"),)),
    ]


@pytest.mark.parametrize(("scans", "asked"), [(2, "3 scans or more"), (3, "more scans")])
def test_an_undecided_check_asks_for_more_scans(scans: int, asked: str) -> None:
    still = SimpleNamespace(pair="p", moved=False, shift_mm=0.1, sigma_mm=0.1)
    check = SimpleNamespace(
        search=SimpleNamespace(found=None), pairs=(still,), moved=False, groups=(),
        decided=False, quiet=False, detectable_mm=1.84, before_mm=(0.4,) * scans,
        after_mm=(0.2,) * scans,
    )  # fmt: skip
    first = cast(Any, ScanCheck.lines).fget(check)[0]
    assert first.startswith(f"undecided: in {scans} scans, a pair that moved by less than 1.8 mm")
    assert f"give {asked}, or a shot of the board" in first


def test_pairs_of_a_repaired_pole_are_as_well_known_to_each_other_as_before() -> None:
    """They were carried by one motion: its error is shared by all of them, and by the third of them,
    p1-3, which saw no board and went along."""
    names = ("p1-1", "p1-2", "p2-1", "p1-3")
    mixing = 0.1 * np.random.default_rng(2).standard_normal((24, 24))
    known = PoseCovariance(names, mixing @ mixing.T)
    placing = {name: RigidTransform.identity() for name in names}
    rig = SimpleNamespace(poles={name: name[:2] for name in names})
    calibration: Any = Placed(rig, placing, known, ("as it was",))
    motion = RigidTransform(np.eye(3), np.array([3.0, 0.0, 4.0]))
    move = Move("pole p1", names[:2], motion, np.diag([1e-6] * 3 + [0.25] * 3), 5.0, 0.9)
    mended = apply_moves(calibration, [move])
    after = mended.covariance
    np.testing.assert_allclose(after.relative("p1-1", "p1-2"), known.relative("p1-1", "p1-2"))
    for name in (*move.pairs, "p1-3"):
        np.testing.assert_allclose(after.marginal(name), known.marginal(name) + move.covariance)
        grown = after.relative(name, "p2-1") - known.relative(name, "p2-1")
        np.testing.assert_allclose(grown, move.covariance, atol=1e-12)
        assert mended.rig_from_camera[name].translation.tolist() == [3.0, 0.0, 4.0]
    np.testing.assert_array_equal(after.marginal("p2-1"), known.marginal("p2-1"))
    assert mended.rig_from_camera["p2-1"] is placing["p2-1"]
    assert mended.notes[0] == "as it was"
    assert "pole p1 moved by 5.00 mm" in mended.notes[1]
