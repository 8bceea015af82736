"""From how much on images of waves do not add up, and which mistakes are tried: each limit from both
sides."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from bodyscan.arrays import Array, Floats
from bodyscan.errors import DecodingFailed
from bodyscan.stripes.phase_steps import _check_phase, _check_waves, _mistakes
from bodyscan.stripes.phase_waves import _check_images, _in_order, _orders, _other_periods
from bodyscan.stripes.scan_lines import ScanLines
from bodyscan.stripes.wave import Wave

PERIOD, STEPS = 8.0, 4
S = np.tile(np.linspace(0.0, 64.0, 801)[:-1], (3, 1))
EVERY = np.ones(S.shape, bool)
WAVE = Wave(PERIOD, STEPS)


def shares(phase: Array | float = 0.0) -> Array:
    """(4, 3, 800) how bright each image is between dark and lit; phase: of a period, ahead."""
    turns = S / PERIOD + phase - np.arange(STEPS)[:, None, None] / STEPS
    return np.asarray(0.5 + 0.5 * np.cos(2.0 * np.pi * turns))


def levels(share: Array) -> Floats:
    return (20.0 + 200.0 * share).astype(np.float32)


def checked(share: Array) -> None:
    lit, dark = np.full(S.shape, 220.0, np.float32), np.full(S.shape, 20.0, np.float32)
    _check_waves(ScanLines(lit, dark, levels(share)[:0], None, False), levels(share), EVERY)


@pytest.mark.parametrize(
    ("bright", "wrong"), [(0.79, False), (0.81, True), (0.21, False), (0.19, True)]
)
def test_each_image_is_about_half_as_bright_as_lit(bright: float, wrong: bool) -> None:
    share = shares()
    share[2] = bright
    if wrong:
        with pytest.raises(DecodingFailed, match=f"phase image 2 is {bright:.0%} as bright as lit"):
            checked(share)
    else:
        checked(share)


@pytest.mark.parametrize(
    ("off", "wrong"), [(0.14, False), (0.16, True), (-0.14, False), (-0.16, True)]
)
@pytest.mark.parametrize("way", [np.ones_like(S), np.where(S < 32.0, 1.0, -1.0)])
def test_all_images_together_are_half_as_bright_at_each_pixel(
    off: float, wrong: bool, way: Array
) -> None:
    share = shares() + off * way
    if wrong:
        with pytest.raises(
            DecodingFailed, match=r"mean is not the middle of lit and dark \(off by 16"
        ):
            checked(share)
    else:
        checked(share)


@pytest.mark.parametrize(("apart", "alike"), [(0.030, True), (0.040, False)])
def test_two_images_that_differ_by_a_tenth_of_what_neighbours_do_look_alike(
    apart: float, alike: bool
) -> None:
    """Neighbours of four differ by sin(45 degrees), of half the contrast: a tenth is 0.035."""
    share = shares()
    share[1] = share[0] + apart
    if alike:
        with pytest.raises(DecodingFailed, match="phase images 0 and 1 look alike"):
            checked(share)
    else:
        checked(share)


def test_where_nothing_is_usable_nothing_is_said() -> None:
    nothing: Any = None
    _check_waves(nothing, levels(shares()), EVERY & False)


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_phases_lie_in_their_half_periods(side: float) -> None:
    """The middle of a half period is a quarter of one away at most. Ahead by 0.05 more than nothing,
    from 0.3 on phases are afar: of 0.11, 12 % of them, of 0.14, 18 %."""
    coarse = ((np.floor(2.0 * S / PERIOD) + 0.5) / 2.0).astype(np.float32)
    _check_phase(levels(shares(side * 0.11)), coarse, EVERY, WAVE)
    with pytest.raises(DecodingFailed, match=r"does not go with the Gray code at 1[6-9]% of the"):
        _check_phase(levels(shares(side * 0.14)), coarse, EVERY, WAVE)
    # A Gray code without a change says nothing.
    _check_phase(levels(shares(0.5)), np.full_like(coarse, 0.25), EVERY, WAVE)


def test_phases_that_run_the_other_way_leap_between_half_periods() -> None:
    coarse = ((np.floor(2.0 * S / PERIOD) + 0.5) / 2.0).astype(np.float32)
    with pytest.raises(DecodingFailed, match="it would fit if phase images 1 and 3 were exchanged"):
        _check_phase(levels(shares())[[0, 3, 2, 1]], coarse, EVERY, WAVE)


def test_mistakes_with_the_order_undo_themselves() -> None:
    found = dict(_mistakes(4))
    assert len(found) == 6 + 1 + 3
    assert found["phase images 1 and 3 were exchanged"] == [0, 3, 2, 1]
    assert found["the phase images came in reverse order"] == [3, 2, 1, 0]
    began = np.roll(np.arange(4), -1)  # images 1, 2, 3, 0 were taken
    assert began[found["the phase images began with number 1"]].tolist() == [0, 1, 2, 3]
    waves = dict(_orders(4))
    assert len(waves) == 1 + 3 + 6 - 1  # of one swap the reverse order is another name
    assert waves["the images came in reverse order"] == [0, 3, 2, 1]
    assert began[waves["the images began with number 1"]].tolist() == [0, 1, 2, 3]
    assert waves["images 0 and 2 were exchanged"] == [2, 1, 0, 3]


def test_periods_near_one_twice_and_half_of_it_are_tried() -> None:
    """Of 240 stripes twelve periods of twenty: four more and fewer of either."""
    found = dict(_other_periods(20.0, 240))
    counted = [k for k in (*range(8, 17), 24, 6) if k != 12]
    long = [k for k in (*range(16, 25), 40, 10) if k != 20]
    expected = {f"`periods` had {k} in place of 12": 240.0 / k for k in counted}
    expected |= {f"`period` had {k} in place of 20": float(k) for k in long}
    assert found == expected
    # A tenth of a hundred; a period that is no whole number, of which there are, is not counted.
    many = dict(_other_periods(2.4, 240))
    assert set(many.values()) == {240.0 / k for k in (*range(90, 111), 50) if k != 100}
    # Two are the fewest.
    assert {f"`periods` had {k} in place of 2" for k in (3, 4, 5, 6)} < set(
        dict(_other_periods(120.0, 240))
    )
    # One over everything is no period to mistake, and none is longer than half of all.
    assert all(value <= 120.0 for _, value in _other_periods(60.0, 240))
    assert dict(_other_periods(240.0, 240)) == {
        f"`period` had {k} in place of 240": float(k) for k in (120,)
    }


def reading(
    bright: float = 1.0, copied: float | None = None, period: float = 20.0
) -> tuple[Any, list[Floats]]:
    """Two waves of 8 and of `period` stripes; of the second the mean is so bright, and its second
    image is the first and so many grey levels more."""
    parts, images = [], []
    for length, times in ((8.0, 1.0), (period, bright)):
        turns = S / length - np.arange(STEPS)[:, None, None] / STEPS
        stack = times * (120.0 + 100.0 * np.cos(2.0 * np.pi * turns))
        mean, amplitude = np.full(S.shape, 120.0 * times), np.full(S.shape, 100.0)
        parts.append(SimpleNamespace(wave=Wave(length, STEPS), mean=mean, amplitude=amplitude))
        images.append(stack.astype(np.float32))
    if copied is not None:
        images[1][1] = images[1][0] + copied
    shown = SimpleNamespace(
        waves=parts, images=images, finest=parts[0], shown=EVERY, brightest=np.full(S.shape, 220)
    )
    return shown, images


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_waves_are_as_bright_as_each_other_to_a_seventh(side: float) -> None:
    _check_images(reading(1.0 + side * 0.14)[0], 64)
    with pytest.raises(DecodingFailed, match=r"of 20 stripes are on the mean (1\.16|0\.84) times"):
        _check_images(reading(1.0 + side * 0.16)[0], 64)


def test_images_of_a_wave_that_differ_by_next_to_nothing_look_alike() -> None:
    """Of an amplitude of 100 neighbours among four differ by 71: a tenth is 7."""
    _check_images(reading(copied=7.5, period=16.0)[0], 64)
    with pytest.raises(DecodingFailed, match="images 0 and 1 of the wave of 16 stripes look alike"):
        _check_images(reading(copied=6.5, period=16.0)[0], 64)
    # A small subject may show less than a wave of which there are not four.
    _check_images(reading(copied=0.0, period=16.5)[0], 64)


@pytest.mark.parametrize(
    ("agreed", "apart", "sound"),
    [(0.61, 0.0, True), (0.59, 0.0, False), (1.0, 0.059, True), (1.0, -0.061, False)],
)
def test_six_of_ten_pixels_agree_and_not_by_being_off_alike(
    agreed: float, apart: float, sound: bool
) -> None:
    order: Any = SimpleNamespace(agreed=agreed, apart=(0.01, apart))
    assert _in_order(order) == sound
    alone: Any = SimpleNamespace(agreed=agreed, apart=())
    assert _in_order(alone) == (agreed > 0.6)
