"""The limits by which a calibrated pair is good, each by itself."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from bodyscan.registration.calibration_verdict import PairFigures

AT_THE_LIMITS = PairFigures("p", 0.3, 6, 40.0, 0.3, 0.5, 4, 50.0, 0.5)
NOTHING_KNOWN = PairFigures("p", None, None, None, None, None, None, None, None)


def test_a_pair_at_its_limits_is_good_and_what_is_not_known_is_not_judged() -> None:
    assert list(AT_THE_LIMITS.beyond()) == []
    assert list(NOTHING_KNOWN.beyond()) == []


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


def test_of_nothing_at_all_a_limit_is_missed_without_end() -> None:
    ((times, _, _),) = replace(AT_THE_LIMITS, stripe_shots=0).beyond()
    assert times > 1e6
