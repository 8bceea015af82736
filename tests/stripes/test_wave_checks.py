"""Checks that the images of waves are consistent."""

from __future__ import annotations

import re
from types import SimpleNamespace

import numpy as np
import pytest

from bodyscan.arrays import Array
from bodyscan.errors import DecodingFailed
from bodyscan.stripes.phase.decoding import (
    check_agreement,
    check_phase,
    check_several_waves,
    check_wave_images,
)
from bodyscan.stripes.phase.waves import (
    balance_images,
    describe_gains,
    estimate_gains,
    measure_wave,
)
from bodyscan.stripes.scan_lines import ScanLines
from bodyscan.stripes.stripe_code import Wave

PERIOD, STEPS = 8.0, 4
S = np.tile(np.linspace(0.0, 64.0, 801)[:-1], (3, 1))
EVERY = np.ones(S.shape, bool)
COARSE = ((np.floor(2.0 * S / PERIOD) + 0.5) / 2.0).astype(np.float32)


def shares(steps: int = STEPS) -> Array:
    """(steps, 3, 800) how bright each image is between dark and lit."""
    turns = S / PERIOD - np.arange(steps)[:, None, None] / steps
    return np.asarray(0.5 + 0.5 * np.cos(2.0 * np.pi * turns))


def check_images(share: Array) -> None:
    lit, dark = np.full(S.shape, 220.0, np.float32), np.full(S.shape, 20.0, np.float32)
    images = (20.0 + 200.0 * share).astype(np.float32)
    check_wave_images(ScanLines(lit, dark, images[:0], None, False), images, EVERY)


@pytest.mark.parametrize("bright", [0.81, 0.19])
def test_each_image_is_about_half_as_bright_as_lit(bright: float) -> None:
    check_images(shares())
    share = shares()
    share[2] = bright
    with pytest.raises(DecodingFailed, match=f"phase image 2 is {bright:.0%} as bright as lit"):
        check_images(share)


@pytest.mark.parametrize("steps", [3, 4])
@pytest.mark.parametrize(
    ("gain", "added", "message"),
    [
        (1.2, 0, r"image 2 .* 1\.(19|20) times .*"),
        (1, 0.3, r"image 2 .*(29|30)% .*"),
        (1.05, 0, ""),
    ],
)
def test_what_one_image_of_a_wave_has_and_the_others_have_not_is_named_and_removed(
    steps: int, gain: float, added: float, message: str
) -> None:
    right = np.repeat(20.0 + 200.0 * shares(steps) ** 1.4, 20, axis=1).astype(np.float32)
    images = right.copy()
    images[2] += (gain - 1.0) * (right[2] - 20.0) + 200.0 * added
    black, contrast = (np.full(right.shape[1:], grey, np.float32) for grey in (20.0, 200.0))
    wave = measure_wave(images, Wave(PERIOD, steps))
    gains = estimate_gains(images, wave, black, contrast, contrast > 0.0)
    assert re.fullmatch(message, "".join(describe_gains(gains, PERIOD)))
    found, _ = balance_images(images, wave, black, contrast, gains)
    np.testing.assert_allclose(found, right, atol=4.0)


def test_phases_lie_in_their_half_periods_and_do_not_jump_between_them() -> None:
    turn = (S / PERIOD % 1.0).astype(np.float32)
    check_phase(turn + np.float32(0.11), COARSE, EVERY)
    for wrong in (turn + np.float32(0.14), turn - np.float32(0.14)):
        with pytest.raises(DecodingFailed, match=r"does not match the Gray code at 1[6-9]% of the"):
            check_phase(wrong, COARSE, EVERY)
    with pytest.raises(DecodingFailed, match="does not match"):  # running the other way
        check_phase(np.float32(1.0) - turn, COARSE, EVERY)


def check_waves(bright: float = 1.0, copied: float | None = None) -> None:
    """Check waves of 8 and of 20 stripes; of the second the mean is so bright, and its
    second image the first plus so many grey levels."""
    waves, images = [Wave(8.0, STEPS), Wave(20.0, STEPS)], []
    for wave, times in zip(waves, (1.0, bright), strict=True):
        turns = S / wave.period - np.arange(STEPS)[:, None, None] / STEPS
        images.append((times * (120.0 + 100.0 * np.cos(2.0 * np.pi * turns))).astype(np.float32))
    if copied is not None:
        images[1][1] = images[1][0] + copied
    measured = [measure_wave(*each) for each in zip(images, waves, strict=True)]
    check_several_waves(measured, images, EVERY, 64)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_waves_are_as_bright_as_each_other_to_a_seventh(sign: float) -> None:
    check_waves(1.0 + sign * 0.14)
    with pytest.raises(DecodingFailed, match=r"of 20 stripes are on average (1\.16|0\.84) times"):
        check_waves(1.0 + sign * 0.16)


@pytest.mark.parametrize(
    ("agreed", "offset", "message"),
    [(0.59, 0.0, "agree at only 59%"), (1.0, -0.061, "begin -0.06 of a period apart")],
)
def test_waves_that_disagree_or_are_shifted_as_a_whole_are_refused(
    agreed: float, offset: float, message: str
) -> None:
    check_agreement(SimpleNamespace(agreed=0.61, offsets=(0.01, 0.059)))  # type: ignore[arg-type]
    with pytest.raises(DecodingFailed, match=message):
        check_agreement(SimpleNamespace(agreed=agreed, offsets=(0.01, offset)))  # type: ignore[arg-type]
