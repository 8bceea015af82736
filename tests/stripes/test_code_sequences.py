"""Sequences of every code that do not add up are refused, and the image to blame is named."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from stripe_rendering import code_light, render

from bodyscan.arrays import Bytes, Indices
from bodyscan.errors import DecodingFailed
from bodyscan.geometry.light_planes import Axis
from bodyscan.stripes.codes import parse_stripe_code
from bodyscan.stripes.codes.phase_shift import PhaseShift
from bodyscan.stripes.codes.stripe_index import StripeIndex
from bodyscan.stripes.decoding import decode_stripes
from bodyscan.stripes.stripe_code import StripeCode
from bodyscan.stripes.stripe_map import StripeMap

STRIPES = 60


Images = dict[str, Bytes]
Change = Callable[[Images], None]
Read = Callable[..., StripeMap]
"""Takes a Change of the images, and in place of its own another code (spec) or lit image (lit)."""


def rendered(**code: Any) -> Read:
    """A function that reads a good sequence after `change` has been at its images."""
    spec = parse_stripe_code({**code, "stripes": STRIPES, "direction": "horizontal"})
    lights = code_light(stripes=STRIPES, **code)
    lit, dark, coded, _ = render(
        lambda u, v: 1.2 + (v + 0.1 * u + 2 * np.sin(u / 20)) / 2.3,
        lights,
        stripes=STRIPES,
        shape=(130, 130),
    )

    def read(
        change: Change = lambda images: None, *, spec: StripeCode = spec, lit: Bytes = lit
    ) -> StripeMap:
        images = {"coded": coded.copy(), "dark": dark, "lit": lit}
        change(images)
        return decode_stripes(spec, images["lit"], images["dark"], images["coded"], where="pair a")

    assert np.isfinite(read().s).mean() > 0.8
    return read


def exchanged(first: int, second: int) -> Change:
    def change(images: Images) -> None:
        images["coded"][[first, second]] = images["coded"][[second, first]]

    return change


def replaced(place: int | slice, by: int | str) -> Change:
    def change(images: Images) -> None:
        images["coded"][place] = images[by] if isinstance(by, str) else images["coded"][by]

    return change


@pytest.fixture(scope="module")
def plain_gray() -> Read:
    return rendered(code="gray", inverses=False)


@pytest.fixture(scope="module")
def section() -> Read:
    return rendered(code="light-section")


@pytest.fixture(scope="module")
def phase() -> Read:
    return rendered(code="phase-shift", steps=4, period=8)


@pytest.mark.parametrize("bit", range(6))
def test_a_missing_pattern_without_inverse_is_noticed(plain_gray: Read, bit: int) -> None:
    with pytest.raises(DecodingFailed, match="do not form a valid code") as caught:
        plain_gray(replaced(bit, "dark"))
    assert caught.value.where == "pair a"


@pytest.mark.parametrize(("one", "other"), [(10, 30), (5, 50)])
def test_exchanged_images_of_a_sweep_are_named(section: Read, one: int, other: int) -> None:
    with pytest.raises(DecodingFailed, match=f"lines of stripes {one}, {other} are not next to"):
        section(exchanged(one, other))


@pytest.mark.parametrize("late", [2, -1])
def test_a_sweep_out_of_step_says_by_how_many(section: Read, late: int) -> None:
    def change(images: Images) -> None:
        shown = np.roll(np.stack([images["lit"], *images["coded"]]), late, axis=0)
        images["lit"], images["coded"] = shown[0], shown[1:]

    with pytest.raises(DecodingFailed, match=f"out of step by {abs(late)}: each file holds"):
        section(change)


def test_images_of_a_sweep_that_are_missing_or_double_are_named(section: Read) -> None:
    with pytest.raises(DecodingFailed, match="stripe 25 shows no line"):
        section(replaced(25, "dark"))
    with pytest.raises(DecodingFailed, match="stripe 26 shows no line"):
        section(replaced(26, 25))
    with pytest.raises(DecodingFailed, match="lights only"):
        section(replaced(slice(None), "dark"))


@pytest.mark.parametrize("order", [[2, 1, 0, 3], [0, 2, 1, 3], [3, 2, 1, 0], [1, 2, 3, 0]])
def test_phase_images_in_another_order_are_refused(phase: Read, order: list[int]) -> None:
    def change(images: Images) -> None:
        images["coded"][-4:] = images["coded"][-4:][order]

    with pytest.raises(DecodingFailed, match="the phase does not match the Gray code"):
        phase(change)


def test_a_wrong_period_is_noticed(phase: Read) -> None:
    spec = PhaseShift(stripes=STRIPES, direction="horizontal", steps=4, period=6)
    with pytest.raises(DecodingFailed):
        phase(spec=spec)


def read_index(image: Indices, stripes: int = STRIPES, direction: Axis = "horizontal") -> StripeMap:
    spec = StripeIndex(stripes=stripes, direction=direction)
    lit = np.full(image.shape, 200, np.uint8)
    return decode_stripes(spec, lit, None, image.astype(np.uint8)[None])


def test_a_stripe_index_image_is_read_or_refused() -> None:
    v, u = np.mgrid[:130, :130]
    s = 1.2 + (v + 0.1 * u) / 2.3
    image = np.where(s < STRIPES, s.astype(int) + 1, 0)
    image[:5], image[5:9] = 0, 255  # both are no stripe
    seen = read_index(image)
    assert np.isnan(seen.s[:9]).all()
    assert np.isfinite(seen.s[10:]).mean() > 0.98
    assert np.nanmax(np.abs(seen.s - (image - 0.5))[10:]) <= 0.7  # number n is stripe n - 1
    with pytest.raises(DecodingFailed, match="have a stripe number above 30"):
        read_index(image, stripes=30)
    with pytest.raises(DecodingFailed, match="the stripes run horizontally"):
        read_index(image, direction="vertical")
    with pytest.raises(DecodingFailed, match="lights only"):
        read_index(np.zeros_like(image))
    with pytest.raises(DecodingFailed, match="neighbouring stripes in"):
        read_index(np.where(image > 0, (image * 37) % 60 + 1, 0))
