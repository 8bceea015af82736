"""Codes without a dark image, those that no projector shows, and pictures for those that one does."""

from __future__ import annotations

import numpy as np
import pytest
from pydantic import ValidationError

from bodyscan.errors import BadInput
from bodyscan.geometry.light_planes import Axis
from bodyscan.stripes.codes.gray import Gray
from bodyscan.stripes.codes.light_section import LightSection
from bodyscan.stripes.codes.stripe_index import StripeIndex


def test_a_stripe_index_image_is_one_of_an_instrument() -> None:
    code = StripeIndex(stripes=254, direction="vertical")
    assert sum(code.image_counts.values()) == 1
    assert not code.uses_dark
    assert not code.is_projected
    assert not code.has_edges
    with pytest.raises(ValidationError, match="must be 254 or less"):
        StripeIndex(stripes=255, direction="vertical")
    with pytest.raises(BadInput, match="the output of an instrument"):
        code.pattern_images(640, 480)


def test_of_a_light_section_each_stripe_is_lit_in_its_own_image() -> None:
    code = LightSection(stripes=5, direction="vertical")
    assert not code.uses_dark
    frames = code.pattern_images(10, 3)
    np.testing.assert_array_equal(frames[:, 1], 255 * np.eye(5, dtype=np.uint8).repeat(2, axis=1))


@pytest.mark.parametrize("direction", ["vertical", "horizontal"])
def test_stripes_divide_the_projectors_picture_evenly(direction: Axis) -> None:
    code = Gray.model_validate({"stripes": 8, "direction": direction, "inverses": False})
    size = (16, 4) if direction == "vertical" else (4, 16)
    frames = code.pattern_images(*size)
    assert frames.shape == (3, size[1], size[0])
    lines = frames[:, 0] if direction == "vertical" else frames[:, :, 0]
    np.testing.assert_array_equal(lines[0], [0] * 8 + [255] * 8)
    np.testing.assert_array_equal(lines[2], ([0] * 2 + [255] * 4 + [0] * 2) * 2)
    crossed = frames if direction == "vertical" else frames.transpose(0, 2, 1)
    assert np.all(crossed == crossed[:, :1])


def test_stripes_are_a_pixel_wide_at_least() -> None:
    code = Gray.model_validate({"stripes": 16, "direction": "vertical", "inverses": False})
    assert code.pattern_images(16, 2).shape == (4, 2, 16)
    with pytest.raises(BadInput, match="16 stripes do not fit on 15 projector pixels"):
        code.pattern_images(15, 2)
