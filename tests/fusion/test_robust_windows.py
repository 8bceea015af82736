"""Single windows fitted robustly, against numpy's least squares over the samples that belong."""

from __future__ import annotations

import numpy as np
import pytest

from bodyscan.arrays import Array, Floats, Mask
from bodyscan.fusion.robust_windows import fit_windows

REACH = 3
SIDE = 2 * REACH + 1
DV, DU = np.mgrid[-REACH : REACH + 1, -REACH : REACH + 1].astype(float)
OWN, UNIT = 1e-3, 1e-7  # a metre away, known to a tenth of a millimetre
PIXEL_MM = 0.8
TERMS = np.stack([np.ones_like(DU), DU, DV, DU**2, DU * DV, DV**2], axis=-1).reshape(-1, 6)
# A surface of 6 mm radius curves by one sigma of what is expected: half its curvature, in noise.
SHARPEST = PIXEL_MM**2 * OWN**2 / UNIT / (2.0 * 6.0)


def blank(height: int, width: int) -> tuple[Floats, Floats, Floats, Floats]:
    a, b, c, d = np.zeros((4, height, width), np.float32)
    return a, b, c, d


def fitted(off: Array, there: Mask | None = None) -> tuple[Array, float, bool]:
    """Value and slopes at the middle of a window and the value's sigma, in sigmas of a sample, and
    whether it is believed; off: (7, 7) sigmas from OWN."""
    image = np.where(np.ones_like(off, bool) if there is None else there, OWN + UNIT * off, 0.0)
    padded = np.pad(image, REACH).astype(np.float32)
    fits = blank(SIDE, SIDE)
    believed = np.zeros((SIDE, SIDE), bool)
    noise = np.full((SIDE, SIDE), UNIT, np.float32)
    middle = np.array([SIDE * REACH + REACH])
    fit_windows(padded, noise, middle, REACH, PIXEL_MM, fits, believed)
    value, *rest = (float(fit[REACH, REACH]) / UNIT for fit in fits)
    return np.array([value - OWN / UNIT, *rest[:2]]), rest[2], bool(believed[REACH, REACH])


def by_numpy(off: Array, kept: Mask) -> tuple[Array, float]:
    """The same by least squares over some samples, held by how sharply surfaces curve."""
    ridge = np.diag([0.0, 0.0, 0.0] + [SHARPEST**-2.0] * 3)
    some = TERMS[kept.ravel()]
    inverse = np.linalg.inv(some.T @ some + ridge)
    return (inverse @ some.T @ off[kept])[:3], float(np.sqrt(inverse[0, 0]))


def bent(noise: float = 0.3) -> Array:
    """A surface that leans and curves, with noise; 0 at the middle."""
    rng = np.random.default_rng(2)
    off = 2.0 * DU - 1.0 * DV + 0.11 * DU**2 - 0.07 * DU * DV + 0.05 * DV**2
    off = off + noise * rng.standard_normal(off.shape)
    off[REACH, REACH] = 0.0
    return off


def same(found: tuple[Array, float, bool], truth: tuple[Array, float]) -> None:
    # A float32 of 1e-3 ends at 1e-10, a thousandth of a sigma.
    np.testing.assert_allclose(found[0], truth[0], atol=3e-3)
    assert found[1] == pytest.approx(truth[1], rel=2e-3)
    assert found[2]


EVERY = np.ones((SIDE, SIDE), bool)


def test_a_smooth_surface_is_fitted_by_all_of_the_window() -> None:
    same(fitted(bent()), by_numpy(bent(), EVERY))


def test_what_is_missing_counts_for_nothing() -> None:
    there = (DU > -2) & (DV < 3)
    same(fitted(bent(), there), by_numpy(bent(), there))


def test_curvature_that_no_surface_has_is_held_back() -> None:
    """With half of a window, where noise bends a fit most."""
    there = (DU >= 0) & (np.abs(DV) <= 2)
    sharp = bent(0.0) + 1.5 * DU**2
    same(fitted(sharp, there), by_numpy(sharp, there))


@pytest.mark.parametrize(("off_sigmas", "belongs"), [(2.7, True), (3.3, False), (-3.3, False)])
@pytest.mark.parametrize("place", [(0, 3), (3, 6), (5, 5)])
def test_a_sample_three_sigmas_off_the_others_is_left_out(
    off_sigmas: float, belongs: bool, place: tuple[int, int]
) -> None:
    ridge = np.diag([0.0, 0.0, 0.0] + [SHARPEST**-2.0] * 3)
    term = TERMS[SIDE * place[0] + place[1]]
    drawn = term @ np.linalg.solve(TERMS.T @ TERMS + ridge, term)  # the fit follows by so much
    off = bent(0.0)
    off[place] += off_sigmas / (1.0 - drawn)
    kept = EVERY.copy()
    kept[place] = belongs
    same(fitted(off), by_numpy(off, kept))


@pytest.mark.parametrize(("beside", "sigmas"), [(2, 100.0), (3, 40.0)])
def test_a_surface_behind_takes_no_part_however_large(beside: int, sigmas: float) -> None:
    """From two pixels beside the middle on it is no slope (ten sigmas a pixel are 45 degrees); from
    three on the closest neighbours tell."""
    off = bent(0.1)
    behind = beside <= DU
    off[behind] -= sigmas
    same(fitted(off), by_numpy(off, ~behind))


@pytest.mark.parametrize(("off_sigmas", "believed"), [(3.7, True), (-3.7, True), (4.3, False)])
def test_a_pixel_four_sigmas_off_its_own_fit_is_not_of_the_surface(
    off_sigmas: float, believed: bool
) -> None:
    off = 0.0 * DU - off_sigmas
    off[REACH, REACH] = 0.0
    found = fitted(off)
    assert found[0][0] == pytest.approx(-off_sigmas, abs=0.05)
    assert found[2] == believed


@pytest.mark.parametrize(("count", "believed"), [(14, False), (15, True)])
def test_fifteen_samples_make_a_fit(count: int, believed: bool) -> None:
    nearest = np.argsort(DU**2 + DV**2, axis=None, kind="stable")[:count]
    there = np.zeros(SIDE * SIDE, bool)
    there[nearest] = True
    assert fitted(bent(0.1), there.reshape(SIDE, SIDE))[2] == believed


def test_pixels_beside_each_other_are_fitted_each_by_its_own_window() -> None:
    """More of them than are fitted at a time."""
    height, width = 16, 20
    v, u = np.mgrid[:height, :width].astype(float)
    image = OWN + UNIT * (1.5 * u - 2.5 * v)
    fits = blank(height, width)
    believed = np.zeros((height, width), bool)
    noise = np.full((height, width), UNIT, np.float32)
    pixels = np.flatnonzero((u > 1).ravel())
    padded = np.pad(image, REACH).astype(np.float32)
    fit_windows(padded, noise, pixels, REACH, PIXEL_MM, fits, believed)
    asked = u > 1
    np.testing.assert_array_equal(believed, asked)
    assert np.all(fits[3][~asked] == 0.0)
    np.testing.assert_allclose(fits[0][asked], image[asked], atol=0.02 * UNIT)
    np.testing.assert_allclose(fits[1][asked], 1.5 * UNIT, atol=0.02 * UNIT)
    np.testing.assert_allclose(fits[2][asked], -2.5 * UNIT, atol=0.02 * UNIT)
