"""Waves of several periods without Gray code: which s, how sure, when they repeat, what is refused."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
import pytest
from stripe_rendering import code_light, render, rms

from bodyscan.errors import DecodingFailed
from bodyscan.stripes.codes import parse_stripe_code
from bodyscan.stripes.codes.phase_shift import PhaseShift, find_repetition
from bodyscan.stripes.decoding import decode_stripes
from bodyscan.stripes.stripe_map import StripeMap

STRIPES = 240
Keys = dict[str, Any]  # as a rig file gives them
HIERARCHICAL: Keys = {"period": (20, 240), "steps": 3}
THREE_LEVELS: Keys = {"period": (240, 60, 12), "steps": (4, 3, 8)}
HETERODYNE: Keys = {"period": (18, 20, 23), "steps": 4}
TWO_BEAT: Keys = {"period": (17, 18.3), "steps": 4}
ALL = [HIERARCHICAL, THREE_LEVELS, HETERODYNE, TWO_BEAT]


def s_at(u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Across a picture of 200 x 160 px, one stripe a pixel and bent."""
    return 12 + 1.15 * (u + 0.08 * v + 3.0 * np.sin(v / 23) + 2.5 * np.sin(u / 31))


def captured(
    keys: Keys, *, gamma: float = 1.0, **scene: Any
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Lit and coded images, and the true s; what several tests look at is rendered once."""
    return _captured(tuple(keys.items()), gamma, tuple(scene.items()))


@lru_cache(16)
def _captured(
    keys: tuple[tuple[str, Any], ...], gamma: float, scene: tuple[tuple[str, Any], ...]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    lights = code_light("phase-shift", STRIPES, **dict(keys)) ** gamma
    whole = {"shape": (160, 200), "ambient": 10.0, **dict(scene)}
    lit, _, coded, s = render(s_at, lights, stripes=STRIPES, **whole)
    for images in (lit, coded, s):
        images.flags.writeable = False
    return lit, coded, s


def described(keys: Keys) -> PhaseShift:
    """As a rig file has it."""
    named = {key: list(value) if isinstance(value, tuple) else value for key, value in keys.items()}
    if named.pop("backward", False):
        named["shift"] = "backward"
    common = {"code": "phase-shift", "stripes": STRIPES, "direction": "vertical"}
    code = parse_stripe_code({**common, **named})
    assert isinstance(code, PhaseShift)
    return code


def read(keys: Keys, lit: np.ndarray, coded: np.ndarray) -> StripeMap:
    return decode_stripes(described(keys), lit, None, np.ascontiguousarray(coded))


def inner(s: np.ndarray) -> np.ndarray:
    """Without the picture's border, beyond which the rendering's lens has nothing to blur with."""
    return s[3:-3, 3:-3]


def errors(seen: StripeMap, s: np.ndarray) -> np.ndarray:
    found: np.ndarray = inner(seen.s - s)
    return found[np.isfinite(found)]


@pytest.mark.parametrize("keys", ALL, ids=str)
def test_s_is_right_and_its_sigma_too(keys: Keys) -> None:
    lit, coded, s = captured(keys)
    seen = read(keys, lit, coded)
    off = errors(seen, s)
    assert len(off) > 0.98 * np.isfinite(inner(s)).sum()
    assert np.abs(off).max() < 2.0  # no wrong order: that would be 12 stripes or more
    # Noise of 1 of an amplitude of 90: sqrt(2 / N) / 90 of a radian, times the period / 2 pi.
    waves = sorted(described(keys).waves, key=lambda wave: wave.period)
    fine = [wave for wave in waves if wave.period < 2 * waves[0].period]
    weight = sum((90 * 2 * np.pi / wave.period) ** 2 * wave.steps / 2 for wave in fine)
    assert rms(off) < 1.0 * weight**-0.5 + 0.005  # smoothing takes a quarter of it
    known = np.isfinite(inner(seen.s - s))
    assert 0.8 < rms(off / inner(seen.sigma)[known]) < 1.2


@pytest.mark.parametrize(
    "more",
    [
        {"backward": True},
        {"start_deg": -90.0},
        {"origin": 0.5},
        {"backward": True, "start_deg": 120.0, "origin": -7.0},
    ],
    ids=str,
)
@pytest.mark.parametrize("keys", [HIERARCHICAL, HETERODYNE], ids=str)
def test_other_shifts_starts_and_origins(keys: Keys, more: Keys) -> None:
    lit, coded, s = captured(keys | more)
    off = errors(read(keys | more, lit, coded), s)
    assert len(off) > 0.98 * np.isfinite(inner(s)).sum()
    assert abs(off.mean()) < 0.02  # half a stripe of `origin` would show


def test_patterns_follow_the_keys() -> None:
    keys: Keys = {
        "period": (20, 240),
        "steps": (3, 5),
        "backward": True,
        "start_deg": 30,
        "origin": 4,
    }
    shown = described(keys).pattern_images(STRIPES, 4)[:, 0]
    light = code_light("phase-shift", STRIPES, **keys).reshape(8, STRIPES, 16)
    np.testing.assert_allclose(shown / 255.0, light.mean(axis=2), atol=0.004)


@pytest.mark.parametrize(("keys", "light"), [(HIERARCHICAL, 45.0), (TWO_BEAT, 60.0)], ids=str)
def test_an_ambiguous_order_is_not_guessed(keys: Keys, light: float) -> None:
    lit, coded, s = captured(keys, light=light, noise=2.0)
    seen = read(keys, lit, coded)
    off = np.abs(errors(seen, s))
    lost = 1.0 - len(off) / np.isfinite(inner(s)).sum()
    assert lost < 0.9
    assert np.mean(off > 8.0) < 5e-4  # 1e-4 is meant, of 30,000 pixels
    # Guessing would have been wrong more often than that, or nothing would have been left out.
    assert lost > 0.02


@pytest.mark.parametrize("gamma", [1.4, 2.2])
@pytest.mark.parametrize("keys", [HIERARCHICAL, HETERODYNE], ids=str)
def test_the_projectors_response_is_corrected(keys: Keys, gamma: float) -> None:
    lit, coded, s = captured(keys, gamma=gamma)
    straight = errors(read(keys, *captured(keys)[:2]), s)
    seen = read(keys, lit, coded)
    off = errors(seen, s)
    assert len(off) > 0.97 * np.isfinite(inner(s)).sum()
    # A quarter more than the noise of a straight projector: amplitudes are less at a gamma as well.
    assert rms(off) < 1.35 * rms(straight) + 0.01


def test_unevenly_distributed_phases_are_no_response() -> None:
    """Of a surface that shows some phases five times as often as others; histograms would be fooled."""

    def stepped(u: np.ndarray, v: np.ndarray) -> np.ndarray:
        slow = np.sin(2 * np.pi * u / 25.0)
        return np.asarray(20 + 0.8 * (u - 25.0 / (2 * np.pi) * 0.75 * slow) + 0.02 * v)

    lights = code_light("phase-shift", STRIPES, **HIERARCHICAL)
    lit, _, coded, s = render(stepped, lights, stripes=STRIPES, shape=(160, 200), ambient=10.0)
    off = errors(read(HIERARCHICAL, lit, coded), s)
    assert rms(off) < 0.06  # 0.043 is noise


@pytest.mark.slow
@pytest.mark.parametrize("keys", [HIERARCHICAL, HETERODYNE], ids=str)
def test_parts_of_grey_levels_are_used(keys: dict[str, Any]) -> None:
    """In dim light, of which a camera of 12 bits sees more than one of 8."""
    stacks = [captured(keys, light=10.0, ambient=3.0, noise=1.0, seed=seed) for seed in range(16)]
    s = stacks[0][2]
    lit, coded = (np.asarray(np.mean([each[k] for each in stacks], axis=0)) for k in (0, 1))
    lit, coded = lit.astype(np.float32), coded.astype(np.float32)
    seen = read(keys, lit, coded)
    assert seen.lit.dtype == np.uint8
    off = errors(seen, s)
    assert len(off) > 0.9 * np.isfinite(inner(s)).sum()
    # Noise of a quarter of a grey level and an amplitude of 5, of a period of 20.
    assert rms(off) < 1.3 * (2.0 / keys["steps"]) ** 0.5 * 0.27 / 5.0 * 20 / (2 * np.pi)
    whole = read(keys, np.rint(lit).astype(np.uint8), np.rint(coded).astype(np.uint8))
    assert rms(errors(whole, s)) > 1.2 * rms(off)  # rounding adds 0.29 of a grey level


def test_a_dim_background_does_not_make_waves_inconsistent() -> None:
    """Of 160 lines 30 are bright; the others show waves, but too dimly to tell their order."""

    def bright_below(u: np.ndarray, v: np.ndarray) -> np.ndarray:
        return np.where(v < 130, 0.1, 1.0)

    lit, coded, s = captured(HIERARCHICAL, albedo=bright_below)
    seen = read(HIERARCHICAL, lit, coded)
    assert np.isfinite(seen.s[134:-3, 3:-10]).mean() > 0.97
    known = np.isfinite(seen.s) & np.isfinite(s)
    assert np.mean(np.abs(seen.s - s)[known] > 8.0) < 5e-4
    with pytest.raises(DecodingFailed, match="agree at only"):
        read(HIERARCHICAL, lit, changed("exchanged", coded))


def test_a_small_subject_is_decoded_where_two_images_are_alike() -> None:
    """At s = 40 the wave of 240 stripes is as bright in image 0 as in image 1."""

    def small(u: np.ndarray, v: np.ndarray) -> np.ndarray:
        return 38.8 + 0.01 * u + 0.002 * v

    lights = code_light("phase-shift", STRIPES, **HIERARCHICAL)
    lit, _, coded, s = render(small, lights, stripes=STRIPES, shape=(160, 200), ambient=10.0)
    assert len(errors(read(HIERARCHICAL, lit, coded), s)) > 0.97 * inner(s).size


def test_one_wave_that_covers_all_needs_nothing_else() -> None:
    keys = {"period": 240, "steps": 8}
    lit, coded, s = captured(keys)
    off = errors(read(keys, lit, coded[-8:]), s)  # without the Gray code that was rendered as well
    assert len(off) > 0.9 * np.isfinite(inner(s)).sum()
    # 1 / 90 of a radian, over the square root of 4, of 240 stripes.
    assert rms(off) < 1.1 * 0.5 / 90.0 * 240 / (2 * np.pi)


def changed(change: str, coded: np.ndarray) -> np.ndarray:
    order = list(range(len(coded)))
    if change == "exchanged":
        order[0], order[2] = 2, 0
    elif change == "reversed":
        order[3:6] = [3, 5, 4]
    elif change == "waves":
        order = [3, 4, 5, 0, 1, 2]
    result: np.ndarray = coded[order].copy()
    return result


@pytest.mark.slow
@pytest.mark.parametrize("change", ["exchanged", "reversed", "waves"])
def test_images_in_another_order_are_refused(change: str) -> None:
    lit, coded, _ = captured(HIERARCHICAL)
    with pytest.raises(DecodingFailed, match="agree at only"):
        read(HIERARCHICAL, lit, changed(change, coded))


def test_wrong_periods_are_refused() -> None:
    lit, coded, _ = captured(HIERARCHICAL)
    with pytest.raises(DecodingFailed, match="agree at only"):
        read({"period": (21.5, 240), "steps": 3}, lit, coded)


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
