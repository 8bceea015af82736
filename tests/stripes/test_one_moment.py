"""Stripe sequences of a surface that moves while they are taken, rendered image by image."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from stripe_rendering import gray_bits, render

from bodyscan.arrays import Array, Indices
from bodyscan.errors import DecodingFailed
from bodyscan.geometry.velocity import SurfaceSpeeds, Velocity
from bodyscan.stripes.boundaries import Boundaries
from bodyscan.stripes.codes.gray import Gray
from bodyscan.stripes.comb import Comb, _window_starts
from bodyscan.stripes.decoding import decode_stripes
from bodyscan.stripes.one_moment import Moments, StripeMotion
from bodyscan.stripes.stripe_map import StripeMap

STRIPES, BITS, SHAPE = 64, 6, (110, 90)
SPEED = -0.03
"""Stripes an image: a body at 8 mm/s in depth, 120 images a second."""
MM_PER_STRIPE = 8.0
FINEST = {True: (5.0 + 11.0) / 2, False: 5.0}
"""Where the patterns come first and then their inverses, or no inverses at all."""


def s_at(time: float, u: Array | Indices, v: Array | Indices) -> Array:
    return 2.0 + (v + 0.08 * u + 1.5 * np.sin(v / 25)) / 1.9 + SPEED * time


def told(comb: Comb) -> StripeMotion:
    """One speed for all of the picture."""
    weight = comb.sigma**-2.0
    speed = float(np.sum(weight * comb.speed) / np.sum(weight))
    grid = np.full((1, 1), speed)
    none = np.empty((0, 3))
    unseen = SurfaceSpeeds(none, none, none[:, 0], none[:, 0], none[:, :1])
    still = Velocity(np.zeros(6), np.eye(6), unseen)
    return StripeMotion(grid, 0.0 * grid, 200, still, abs(speed), MM_PER_STRIPE, 0.0, 100.0, True)


@pytest.fixture(scope="module", params=[True, False], ids=["with inverses", "without"])
def seen(request: pytest.FixtureRequest) -> tuple[bool, list[np.ndarray]]:
    """Whether there are inverses; lit, dark, patterns (and inverses) by the code's order, each at its
    own moment."""
    bits = gray_bits(np.arange(STRIPES))
    lights = np.concatenate([bits, 1 - bits]) if request.param else bits
    images = []
    for time, light in enumerate(lights):
        moving = partial(s_at, float(time))
        images.append(render(moving, light[None], stripes=STRIPES, shape=SHAPE, seed=time))
    lit, dark = images[0][:2]
    return request.param, [lit, dark, np.concatenate([image[2] for image in images])]


def test_where_no_boundaries_are_no_window_begins() -> None:
    number, place = np.empty(0, np.int64), np.empty(0)
    none = Boundaries(number, number, place, place, place, number, number > 0, 1.0)
    assert not len(_window_starts(none))


def errors(found: StripeMap, time: float) -> Array:
    v, u = np.indices(SHAPE)
    true = s_at(time, u, v)
    inner = np.isfinite(found.s) & (true > 6.0) & (true < STRIPES - 6.0)
    return (found.s - true)[inner]


def test_what_moved_meanwhile_is_taken_out_of_s(seen: tuple[bool, list[np.ndarray]]) -> None:
    inverses, images = seen
    code = Gray(stripes=STRIPES, direction="horizontal", inverses=inverses)
    kinds = enumerate(code.image_counts)
    times = {kind.name: np.linspace(0.0, BITS - 1.0, BITS) + BITS * k for k, kind in kinds}
    moments = Moments(times, code.moment(times), told)
    assert moments.moment == FINEST[inverses]
    torn = decode_stripes(code, *images)
    whole = decode_stripes(code, *images, moments=(moments,))
    assert whole.motion is not None
    assert whole.motion.speed[0, 0] == pytest.approx(SPEED, rel=0.1)
    before, after = (errors(found, moments.moment) for found in (torn, whole))
    # 0.032 with teeth; at rest the same surface is decoded to 0.0028 (0.0045 without inverses).
    assert np.sqrt(np.mean(before**2)) > 0.03
    assert np.sqrt(np.mean(after**2)) < (0.0033 if inverses else 0.005)
    assert len(after) > 0.995 * len(before)


def test_a_rim_that_moves_meanwhile_leaves_no_s_beyond_it() -> None:
    """A surface before a dark room whose rim comes in by a tenth of a pixel an image."""

    def rim(time: float, u: Array | Indices) -> Array:
        return np.asarray(70.0 - 0.1 * time + 0.15 * u, np.float64)

    def moving(time: float, u: Array | Indices, v: Array | Indices) -> Array:
        return np.where(v < rim(time, u), s_at(time, u, v), np.nan)

    bits, images = gray_bits(np.arange(STRIPES)), []
    for time, light in enumerate(np.stack([bits, 1 - bits], axis=1).reshape(2 * BITS, STRIPES)):
        s = partial(moving, float(time))
        images.append(render(s, light[None], stripes=STRIPES, shape=SHAPE, seed=time))
    patterns = [image[2] for image in images]
    given = *images[0][:2], np.concatenate([*patterns[::2], *patterns[1::2]])
    code = Gray(stripes=STRIPES, direction="horizontal")
    firsts: Array = np.arange(0.0, 2.0 * BITS, 2.0, dtype=np.float64)
    times: dict[str, Array] = {"pattern": firsts, "inverse": np.asarray(firsts + 1.0, np.float64)}
    moments = Moments(times, code.moment(times), told)
    v, u = np.indices(SHAPE)
    beyond = v - np.floor(rim(moments.moment, u))
    carried = np.isfinite(decode_stripes(code, *given, moments=(moments,)).s)
    assert not carried[beyond >= 1].any()
    assert carried[beyond < -2].mean() > 0.98
    # Of what is not known to move, as of a still body, all pixels stay: 3 in 10 of the first beyond.
    assert np.isfinite(decode_stripes(code, *given).s)[beyond == 1].mean() > 0.2


def told_in_mm(comb: Comb) -> StripeMotion | None:
    if not len(comb.speed):
        return None
    speed = float(told(comb).speed[0, 0])
    left = np.median(np.abs(comb.speed - speed)) / 0.6745
    explained = len(comb.speed) * float(speed / left) ** 2
    return replace(told(comb), speed_mm=MM_PER_STRIPE * abs(speed), explained=explained)


@pytest.mark.parametrize(("leap", "most_mm"), [(0.4, 2.0), (0.4, 7.0), (0.0, 2.0)])
def test_a_sequence_of_two_moments_is_named(leap: float, most_mm: float) -> None:
    """The images of bits 3 to 5, in which the body stands 3.2 mm elsewhere, which people reach as fast
    but not at once; or in which it moves on."""
    bits, images = gray_bits(np.arange(STRIPES)), []
    for place, light in enumerate(np.stack([bits, 1 - bits], axis=1).reshape(2 * BITS, STRIPES)):
        time = float(place) if not leap else leap / SPEED * (place >= 6)
        s = partial(s_at, time)
        images.append(render(s, light[None], stripes=STRIPES, shape=SHAPE, seed=place))
    patterns = [image[2] for image in images]
    code = Gray(stripes=STRIPES, direction="horizontal", inverses=True)
    beside = np.arange(0.0, 2.0 * BITS, 2.0, dtype=np.float64)
    times: dict[str, Array] = {"pattern": beside, "inverse": np.asarray(beside + 1.0, np.float64)}
    moments = Moments(times, code.moment(times), told_in_mm, most_mm=most_mm)
    given = *images[0][:2], np.concatenate([*patterns[::2], *patterns[1::2]])
    if not leap:
        assert decode_stripes(code, *given, moments=(moments,)).motion is not None
        return
    with pytest.raises(
        DecodingFailed, match=r"from about bit 3 on, patterns show the subject some 3\.2 mm"
    ):
        decode_stripes(code, *given, moments=(moments,))


def test_leaps_too_small_to_be_named_are_not_looked_for() -> None:
    asked: list[Comb] = []

    def counted(comb: Comb) -> StripeMotion | None:
        asked.append(comb)
        return told_in_mm(comb)

    code = Gray(stripes=STRIPES, direction="horizontal", inverses=False)
    bits = gray_bits(np.arange(STRIPES))
    seen = [
        render(partial(s_at, float(t)), b[None], stripes=STRIPES, shape=SHAPE, seed=t)
        for t, b in enumerate(bits)
    ]
    given = *seen[0][:2], np.concatenate([image[2] for image in seen])
    times: dict[str, Array] = {"pattern": np.arange(float(BITS))}
    for most_mm, expected in ((1000.0, 1), (0.5, BITS)):
        asked.clear()
        moments = Moments(times, code.moment(times), counted, most_mm=most_mm)
        decode_stripes(code, *given, moments=(moments,))
        assert len(asked) == expected
