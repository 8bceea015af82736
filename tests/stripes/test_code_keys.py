"""What the keys of a code may be: the last value that passes, and the first that does not."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from bodyscan.stripes.codes import stripe_code
from bodyscan.stripes.codes.gray import bits_needed
from bodyscan.stripes.codes.light_section import LightSection
from bodyscan.stripes.codes.phase_shift import PhaseShift

ONE_WAVE = {"code": "phase-shift", "stripes": 240}
GRAY = {"code": "gray", "stripes": 240}


@pytest.mark.parametrize(
    ("keys", "key", "passes", "refused"),
    [
        (GRAY, "stripes", (2, 65535), (1, 65536)),
        (GRAY, "first_code", (0, 65536 - 240), (-1, 65537 - 240)),
        (ONE_WAVE, "steps", (3, 64), (2, 65)),
        (ONE_WAVE, "period", (2, 240), (1.9, 241)),
        (ONE_WAVE, "periods", (1, 120), (0, 121)),
        (ONE_WAVE, "start_deg", (-360, 360), (-361, 361)),
        (ONE_WAVE, "origin", (-65535, 65535), (-65536, 65536)),
        (ONE_WAVE, "period", ((16, 240),), ((), (1, 240))),
        (ONE_WAVE, "steps", ((5,),), ((), (2,), (65,))),
        (ONE_WAVE | {"steps": 4}, "period", ((240,) * 8,), ((240,) * 9,)),
        (ONE_WAVE | {"steps": 4}, "periods", ((1,) * 8,), ((1,) * 9,)),
        (ONE_WAVE | {"period": (240,) * 8}, "steps", ((4,) * 8,), ((4,) * 9,)),
    ],
    ids=str,
)
def test_keys_have_their_limits(
    keys: dict[str, Any], key: str, passes: tuple[Any, ...], refused: tuple[Any, ...]
) -> None:
    for value in passes:
        stripe_code({"direction": "vertical", **keys, key: value})
    for value in refused:
        with pytest.raises(ValidationError):
            stripe_code({"direction": "vertical", **keys, key: value})


def test_as_many_bits_as_the_words_take() -> None:
    assert [bits_needed(words) for words in (2, 3, 4, 5, 128, 129, 65536)] == [1, 2, 2, 3, 7, 8, 16]


def test_a_wave_that_repeats_needs_a_gray_code_of_its_half_periods() -> None:
    def code(**keys: Any) -> PhaseShift:
        return PhaseShift(stripes=60, direction="vertical", **keys)

    usual = code()
    assert [wave.period for wave in usual.waves] == [8.0]
    assert PhaseShift(stripes=6, direction="vertical").waves[0].period == 6.0
    assert (usual.needs_gray, usual.half_periods) == (True, 15)
    assert code(period=8.5).half_periods == 15  # 14.1, the last in part
    assert code(periods=6).half_periods == 12
    assert list(usual.image_counts.values()) == [4, 4, 4]
    assert list(code(inverses=False, steps=5).image_counts.values()) == [4, 5]
    assert not code(period=60).needs_gray
    assert list(code(period=60, steps=7).image_counts.values()) == [7]
    assert (code(inverses=False).needs_lit, code(inverses=False).needs_dark) == (True, True)
    assert (usual.needs_lit, usual.needs_dark) == (False, False)
    assert (code(period=60, inverses=False).needs_lit) is False


def test_the_moment_of_a_sequence_lies_halfway_between_its_first_image_and_its_last() -> None:
    code = LightSection(stripes=5, direction="vertical")
    times = {"a": np.array([30.0, 10.0, 20.0]), "b": np.array([25.0, 70.0])}
    assert code.moment(times) == 40.0


def test_stripes_that_cross_run_the_other_way() -> None:
    def crossed(direction: str, **more: Any) -> None:
        crossing = {"code": "gray", "stripes": 8, "direction": direction, **more}
        stripe_code({**GRAY, "direction": "vertical", "crossing": crossing})

    crossed("horizontal")
    with pytest.raises(ValidationError, match="must not be vertical as well"):
        crossed("vertical")
    with pytest.raises(ValidationError, match="stripes run two ways"):
        crossed("horizontal", crossing={**GRAY, "direction": "vertical"})
    with pytest.raises(ValidationError, match="is for projectors that show images"):
        stripe_code(
            {
                **GRAY,
                "direction": "vertical",
                "crossing": {"code": "stripe-index", "stripes": 8, "direction": "horizontal"},
            }
        )
