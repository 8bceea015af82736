"""One grade and its reasons, whoever is judged."""

from __future__ import annotations

from typing import get_args

from bodyscan.verdict import Grade, Verdict


def test_every_grade_is_good_usable_or_bad() -> None:
    marks = {grade: Verdict(grade).mark for grade in get_args(Grade)}
    assert marks == {
        **dict.fromkeys(("good", "accepted"), "good"),
        **dict.fromkeys(("usable", "not judged"), "usable"),
        **dict.fromkeys(("repeat", "recalibrate", "not accepted"), "bad"),
    }
    assert str(Verdict("usable", ("dark hair", "a hand on the hip"))) == (
        "verdict: usable\n  dark hair\n  a hand on the hip"
    )
