"""One grade and its reasons, whoever is judged."""

from __future__ import annotations

import pytest

from bodyscan.verdict import Grade, Mark, Verdict


@pytest.mark.parametrize(
    ("grade", "mark"),
    [
        ("good", "good"),
        ("accepted", "good"),
        ("usable", "usable"),
        ("not judged", "usable"),
        ("repeat", "bad"),
        ("recalibrate", "bad"),
        ("not accepted", "bad"),
    ],
)
def test_every_grade_is_good_usable_or_bad(grade: Grade, mark: Mark) -> None:
    assert Verdict(grade).mark == mark


def test_reasons_follow_the_grade_line_by_line() -> None:
    assert str(Verdict("usable", ("dark hair", "a hand on the hip"))) == (
        "verdict: usable\n  dark hair\n  a hand on the hip"
    )
