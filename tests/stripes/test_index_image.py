"""What one image of stripe numbers tells, on rows of numbers laid out by hand."""

from __future__ import annotations

import numpy as np
import pytest

from bodyscan.arrays import Indices
from bodyscan.errors import DecodingFailed
from bodyscan.stripes.numbered_stripes import decode_index
from bodyscan.stripes.stripe_map import StripeMap


def read(numbers: Indices, stripes: int = 40) -> StripeMap:
    image = np.tile(numbers, (40, 1)).astype(np.uint8)
    return decode_index(np.full_like(image, 200), image[None], "vertical", stripes)


def test_boundaries_of_an_index_image_lie_halfway_between_its_numbers() -> None:
    """Number n is stripe n - 1; between two of its middles s is a line."""
    found = read(np.arange(1, 31).repeat(4))
    own = found.boundary_pixels[:, 1] == 20.0
    np.testing.assert_array_equal(found.boundary_index[own], np.arange(1, 30))
    np.testing.assert_allclose(found.boundary_pixels[own, 0], 4.0 * np.arange(1, 30) - 0.5)
    np.testing.assert_allclose(found.boundary_sigma_px[own], 12.0**-0.5, rtol=1e-6)
    inner = np.arange(8, 112)
    np.testing.assert_allclose(found.s[20, inner], (inner + 0.5) / 4.0, atol=1e-5)


def test_a_stripe_between_no_two_boundaries_has_its_middle() -> None:
    """Beside pixels that show none, of which nothing is known."""
    numbers = np.arange(1, 31).repeat(4)
    numbers[:40], numbers[80:] = 0, 255
    found = read(numbers)
    assert np.isnan(found.s[20, :40]).all()
    assert np.isnan(found.s[20, 80:]).all()
    assert np.isfinite(found.s[20, 40:80]).all()


def test_beside_pixels_without_a_number_there_is_no_boundary() -> None:
    """Though none, 0, is one less than the first."""
    numbers = np.r_[np.arange(1, 16).repeat(4), np.zeros(8, int), np.arange(1, 14).repeat(4)]
    found = read(numbers)
    assert set(found.boundary_index.tolist()) == set(range(1, 15))
    assert not np.any((found.boundary_pixels[:, 0] > 59.0) & (found.boundary_pixels[:, 0] < 68.0))


@pytest.mark.parametrize(("most", "refused"), [(30, False), (29, True)])
def test_the_last_number_is_that_of_the_last_stripe(most: int, refused: bool) -> None:
    numbers = np.arange(1, 31).repeat(4)
    if refused:
        with pytest.raises(DecodingFailed, match="3% of the pixels have a stripe number above 29"):
            read(numbers, most)
    else:
        assert np.nanmax(read(numbers, most).s) > 29.0
