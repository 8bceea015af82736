"""What a check of a rig says, and which of its findings can be put right."""

from __future__ import annotations

from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any, cast

import pytest

from bodyscan.errors import FailedWork
from bodyscan.workflows.check_rig import Findings, _named_apart, _of_boards, _of_scans

CALIBRATION: Any = SimpleNamespace(
    pairs={
        "p": SimpleNamespace(quality=SimpleNamespace(imported="")),
        "q": SimpleNamespace(quality=SimpleNamespace(imported="theirs.json")),
    }
)


def offset(pair: str, mm: float, moved: bool = False) -> SimpleNamespace:
    return SimpleNamespace(pair=pair, offset_mm=mm, turned_mm=-0.31, moved=moved)


def boards(
    *stripes: SimpleNamespace, valid: bool = True, together: bool = True, **others: Any
) -> Findings:
    drift = SimpleNamespace(
        moves=(), rig_from_board={1: 1} if together else {}, misfit_before=1.26, misfit=0.94,
        lonely=others.pop("lonely", ()),
    )  # fmt: skip
    check = SimpleNamespace(
        drift=drift, valid=valid, stripes=stripes, seen=("p", "q"),
        unseen=others.pop("unseen", ()), notes=others.pop("notes", ()),
    )  # fmt: skip
    return _of_boards(CALIBRATION, cast(Any, check))


def test_a_rig_that_stood_still_says_by_how_much_it_is_known() -> None:
    found = boards(offset("p", 0.04), offset("q", -0.11))
    assert found.valid
    assert found.lines == (
        "valid: all that see the board agree",
        "2 pairs saw a board; their views are 1.3 sigmas off (root mean square)",
        "stripes of 2 pairs lie on the board to 0.11 mm (farthest: q)",
    )
    alone = boards(offset("p", 0.04), together=False)
    assert alone.lines[0] == "valid: stripes lie where the board's corners are"
    assert len(alone.lines) == 2


def test_a_projector_that_moved_is_told_and_not_put_right() -> None:
    found = boards(offset("p", 0.84, True), offset("q", -2.0, True), valid=False)
    assert not found.valid
    assert found.lines[:3] == (
        "NOT valid: what stripes measure is not where the board is",
        "projector of p moved against its camera: the board's surface is measured +0.84 mm off, "
        "tilted by -0.31 mm at its ends",
        "projector of q moved against its camera, or theirs.json is not its calibration: the board's "
        "surface is measured -2.00 mm off, tilted by -0.31 mm at its ends",
    )
    with pytest.raises(FailedWork, match="projector of p, q moved"):
        found.repaired(CALIBRATION)
    with pytest.raises(FailedWork, match="nothing moved"):
        boards(offset("p", 0.04)).repaired(CALIBRATION)


def test_what_was_not_checked_is_named() -> None:
    found = boards(unseen=("r", "s"), lonely=("t",), notes=("dim",))
    assert found.lines[2:] == (
        "not checked, for they saw no board: r, s",
        "not checked, for nobody shares their board: t",
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
        return list(_named_apart(cast(Any, folders)))

    assert named(one) == [one]
    assert named(one, other) == [
        Folder(("1/a", "1/b"), (Sequence("1/a"), Sequence("1/b"), Sequence("1/b"))),
        Folder(("2/a",), (Sequence("2/a"),)),
    ]


@pytest.mark.parametrize(("scans", "asked"), [(2, "3 scans or more"), (3, "more scans")])
def test_an_undecided_check_asks_for_more_scans(scans: int, asked: str) -> None:
    still = SimpleNamespace(pair="p", moved=False, shift_mm=0.1, sigma_mm=0.1)
    check = SimpleNamespace(
        search=SimpleNamespace(step=None), poles=(), pairs=(still,), valid=True, apart=(),
        decided=False, quiet=False, unseen_mm=1.84, before_mm=(0.4,) * scans, after_mm=(0.2,) * scans,
    )  # fmt: skip
    first = _of_scans(cast(Any, check)).lines[0]
    assert first.startswith(f"undecided: from {scans} scans a pair that moved by less than 1.8 mm")
    assert f"give {asked}, or a shot of the board" in first
