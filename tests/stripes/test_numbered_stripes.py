"""Codes whose images number the stripes: a swept line, a stripe-index image, and their order."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import erf

from bodyscan.arrays import Indices
from bodyscan.errors import DecodingFailed
from bodyscan.stripes.numbered_stripes import check_order, decode_index, decode_sweep
from bodyscan.stripes.stripe_map import StripeMap

STRIPES = 40
SHAPE = (60, 240)
S = np.linspace(2.5, 37.0, SHAPE[1]) + 0.8 * np.sin(np.arange(SHAPE[0]) / 9.0)[:, None]


def swept(blur: float, noise: float = 0.0, *, ramp: float = 0.0, flash: float = 0.0) -> StripeMap:
    """A stripe at a time, its edges blurred by so many stripes."""
    edges = np.arange(STRIPES + 1)[:, None, None]
    past = 0.5 * (1.0 + erf((S - edges) / (np.sqrt(2.0) * blur)))
    light = 160.0 * (past[:-1] - past[1:])
    light[20] += flash
    rng = np.random.default_rng(0)
    sigma = np.sqrt(noise**2 + ramp * light)
    frames = np.clip(20.0 + light + sigma * rng.normal(size=light.shape), 0.0, 255.0)
    lit = np.full(SHAPE, 180.0) + noise * rng.normal(size=SHAPE)
    return decode_sweep(np.rint(lit).astype(np.uint8), np.rint(frames).astype(np.uint8), "vertical")


def off(found: StripeMap) -> np.ndarray:
    return np.asarray(found.s - S)[3:-3, 12:-12]


@pytest.mark.parametrize("blur", [0.5, 0.8])
def test_s_is_exact_whatever_the_blur(blur: float) -> None:
    found = swept(blur)
    known = np.isfinite(off(found))
    assert known.mean() > 0.98
    # Whole grey levels: of 160, a fifth of a percent; a line three stripes wide is not seen whole.
    assert np.sqrt(np.mean(off(found)[known] ** 2)) < 0.01


@pytest.mark.parametrize(("noise", "ramp"), [(1.5, 0.0), (3.5, 0.0), (0.7, 0.03)])
def test_sigma_matches_the_noise(noise: float, ramp: float) -> None:
    found = swept(0.6, noise, ramp=ramp)
    known = np.isfinite(off(found))
    assert known.mean() > 0.9
    sigma = found.sigma[3:-3, 12:-12][known]
    # The median of what is off over its sigma, for which outliers do not count.
    ratio = np.median(np.abs(off(found)[known]) / sigma) / 0.6745
    assert ratio == pytest.approx(1.0, abs=0.25)


def read(numbers: Indices, stripes: int = 40) -> StripeMap:
    image = np.tile(numbers, (40, 1)).astype(np.uint8)
    return decode_index(np.full_like(image, 200), image[None], "vertical", stripes)


def test_boundaries_of_an_index_image_lie_halfway_between_its_numbers() -> None:
    """Number n is stripe n - 1; between two of its middles s is a line."""
    found = read(np.arange(1, 31).repeat(4))
    own = found.boundary_pixels[:, 1] == 20.0
    np.testing.assert_array_equal(found.boundary_index[own], np.arange(1, 30))
    np.testing.assert_allclose(found.boundary_pixels[own, 0], 4.0 * np.arange(1, 30) - 0.5)
    np.testing.assert_allclose(found.boundary_sigma_px[own], 12.0**-0.5, rtol=1e-3)
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


ORDERED = 12


def shown_in_order(width: int = 4, lines: int = 30) -> np.ndarray:
    return np.tile(np.repeat(np.arange(ORDERED), width), (lines, 1))


def check(numbers: np.ndarray, good: np.ndarray | None = None, *, transposed: bool = False) -> None:
    known = np.ones(numbers.shape, bool) if good is None else good
    check_order(numbers, known, transposed, ORDERED)


def test_stripes_that_follow_each_other_are_in_order_either_way() -> None:
    check(shown_in_order())
    check(shown_in_order()[:, ::-1])
    check(np.zeros((30, 40), int))


def test_images_in_any_order_are_refused_and_rims_are_not() -> None:
    with pytest.raises(DecodingFailed, match="in 0% of the cases only"):
        check(np.array([0, 6, 1, 7, 3, 9, 4, 10, 5, 11, 8, 2])[shown_in_order()][:, :48])
    broken = shown_in_order()
    broken[:, 20:] = np.roll(broken[:, 20:], 8, axis=1)  # one leap, the same everywhere
    check(broken)
    # Of few changes nothing is said: here one, in 19 lines.
    check(np.tile([2, 2, 9, 9], (19, 1)))
    with pytest.raises(DecodingFailed, match="in 0% of the cases only"):
        check(np.tile([2, 2, 9, 9], (20, 1)))


def test_bad_pixels_are_ignored() -> None:
    numbers, good = shown_in_order(), np.ones((30, 48), bool)
    numbers[:, 21], good[:, 21] = 11, False
    check(numbers, good)


def test_an_image_of_a_sweep_that_a_flash_reached_is_named_and_not_used() -> None:
    found = swept(0.6, 1.5, flash=60.0)
    assert "the image of stripe 20, as of a flash" in found.flash
    known = np.isfinite(off(found))
    assert known.mean() > 0.75
    assert np.abs(off(found)[known]).max() < 0.3
