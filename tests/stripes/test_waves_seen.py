"""Whether several waves of light tell s, or repeat before the last stripe."""

from __future__ import annotations

import pytest

from bodyscan.stripes.codes.phase_shift import find_repetition


@pytest.mark.parametrize(
    ("periods", "stripes", "again"),
    [
        ((20.0, 240.0), 240, None),
        ((20.0, 240.0), 241, 240.0),
        ((20.0,), 20, None),
        ((20.0,), 21, 20.0),
        ((12.0, 18.0), 100, 36.0),
        ((12.0, 18.0), 36, None),
        ((18.0, 12.0), 37, 36.0),
        # 17 / 17.17 is a hundredth of a period less than one.
        ((17.0, 17.17), 1000, 17.0),
    ],
)
def test_waves_repeat_after_their_common_multiple(
    periods: tuple[float, ...], stripes: int, again: float | None
) -> None:
    assert find_repetition(periods, stripes, 0.05) == again
