"""Sequences that cannot be decoded: each cause said once, a pair of which all fail by its cause."""

from pathlib import Path

from bodyscan.captures.folder import ImageSequence
from bodyscan.errors import DecodingFailed
from bodyscan.workflows.decode import failed_pairs, failure_notes


def failures(pair: str, what: str, *shots: str) -> list[tuple[ImageSequence, DecodingFailed]]:
    return [
        (
            ImageSequence(pair, shot, Path("lit.png"), None, (), ()),
            DecodingFailed(what, where=f"pair {pair}, shot {shot}", remedy="do something"),
        )
        for shot in shots
    ]


def test_a_pair_whose_stripes_all_run_the_other_way_fails_for_that_reason() -> None:
    same = failures("p1", "the stripes run vertically", "a", "b", "c")
    mixed = [*failures("p2", "one", "a"), *failures("p2", "other", "b")]
    assert failed_pairs([*same, *mixed], good={"p3"}) == {
        "p1": "the stripes run vertically\n  do something"
    }
    assert failed_pairs(same, good={"p1"}) == {}


def test_many_shots_with_one_fault_share_a_note() -> None:
    (note,) = failure_notes(failures("p1", "too dark", "a", "b", "c", "d"))
    assert note.count("too dark") == 1
    assert "in 4 shots: a, b, c, d" in note
    assert len(list(failure_notes(failures("p1", "too dark", "a", "b")))) == 2
