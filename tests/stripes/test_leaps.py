"""A sequence that shows the body in two places: from how much on that is said; and what is carried by
how much at which place."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from bodyscan.errors import DecodingFailed
from bodyscan.stripes import one_moment
from bodyscan.stripes.one_moment import Moments, _at_places, _check_whole, _stripe_widths

STEADY = 10.0  # by how much steady motion lowers chi-square
FAST, MM_PER_STRIPE = 0.1, 8.0
TIMES = np.arange(6.0)


def leaps(
    monkeypatch: pytest.MonkeyPatch,
    *,
    explained: float = 50.0,
    apart_mm: float = 5.0,
    motion_mm: float = 1.0,
    seen_mm: float = 3.0,
    most_mm: float = 4.0,
) -> str:
    """What is said of a leap, "" if nothing, where a subject went motion_mm while the patterns were
    taken, and none goes farther than most_mm.

    A leap between two patterns explains so much, and puts what is before and behind it apart_mm apart;
    windows show seen_mm of it in the mean.
    """
    lasted = float(np.ptp(TIMES))
    comb = SimpleNamespace(speed=np.array([1.0, -1.0]) * seen_mm / (lasted * MM_PER_STRIPE))
    monkeypatch.setattr(one_moment, "find_comb", lambda *_, turned: comb)
    leap = SimpleNamespace(explained=explained, speed_mm=apart_mm / lasted)
    moments: Any = Moments({"pattern": TIMES}, 5.0, lambda comb: leap, most_mm=most_mm)  # type: ignore[arg-type,return-value]
    motion: Any = SimpleNamespace(
        speed_mm=0.6 * motion_mm / lasted, doubt_mm=0.8 * motion_mm / lasted,
        mm_per_stripe=MM_PER_STRIPE, explained=STEADY,
    )  # fmt: skip
    nothing: Any = None
    try:
        _check_whole(nothing, np.zeros(1, np.int64), (moments, motion), turned=False)
    except DecodingFailed as error:
        return str(error)
    return ""


def test_a_leap_farther_than_any_subject_goes_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    assert not leaps(monkeypatch, apart_mm=3.9)
    assert "some 4.1 mm in depth" in leaps(monkeypatch, apart_mm=4.1)
    assert not leaps(monkeypatch, most_mm=np.inf), "where nobody says how long it took"


def test_it_explains_four_times_what_steady_motion_does(monkeypatch: pytest.MonkeyPatch) -> None:
    assert not leaps(monkeypatch, explained=39.0)
    assert leaps(monkeypatch, explained=41.0)


def test_one_that_explains_thirty_times_as_much_is_none_of_a_body(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    assert not leaps(monkeypatch, explained=299.0, apart_mm=2.1)
    assert leaps(monkeypatch, explained=301.0, apart_mm=2.1)
    assert not leaps(monkeypatch, explained=301.0, apart_mm=1.9)


def test_a_quarter_of_a_millimetre_of_motion_cannot_have_leapt(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    assert not leaps(monkeypatch, motion_mm=0.24)
    assert leaps(monkeypatch, motion_mm=0.26)


def test_windows_have_to_show_a_quarter_of_the_least_leap(monkeypatch: pytest.MonkeyPatch) -> None:
    assert not leaps(monkeypatch, seen_mm=0.98)
    assert leaps(monkeypatch, seen_mm=1.02)


def test_between_cells_a_grid_is_linear_and_beyond_their_middles_as_there() -> None:
    row, column = np.mgrid[:3, :4].astype(float)
    grid = np.stack([2.0 + 3.0 * column - 1.5 * row, column * row])
    u, v = np.meshgrid(np.linspace(-3.0, 45.0, 25), np.linspace(-4.0, 36.0, 21))
    found = _at_places(grid, 10, u.ravel(), v.ravel())
    x = np.clip(
        (u.ravel() + 0.5) / 10.0 - 0.5, 0.0, 3.0
    )  # a cell of ten pixels has its middle at 4.5
    y = np.clip((v.ravel() + 0.5) / 10.0 - 0.5, 0.0, 2.0)
    np.testing.assert_allclose(found[0], 2.0 + 3.0 * x - 1.5 * y, atol=1e-12)
    np.testing.assert_allclose(found[1], x * y, atol=1e-12)
    one = _at_places(np.full((2, 1, 1), 7.0), 10, u.ravel(), v.ravel())
    assert np.all(one == 7.0)


def test_stripes_are_as_wide_as_joined_neighbours_lie_apart() -> None:
    position = np.array([1.0, 3.0, 6.0, 20.0, 24.0, 50.0])
    index = np.array([4, 5, 6, 9, 8, 3])
    joined = np.array([True, True, False, True, False])
    # 2 and 3 px beside each other, the mean in their middle; then stripes that fall, 4 px wide.
    np.testing.assert_allclose(
        _stripe_widths(position, index, joined), [2.0, 2.5, 3.0, -4.0, -4.0, 0.0]
    )
