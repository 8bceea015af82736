"""Quadratic fits of windows, against numpy's least squares over the samples that belong."""

from __future__ import annotations

import numpy as np
import pytest

from bodyscan.arrays import Array, Mask
from bodyscan.fusion.quadratic_fit import (
    QuadraticFit,
    close_holes,
    compute_noise_gain,
    convolve_quadratics,
    fit_quadratics,
    fit_trimmed_windows,
)

REACH = 3
SIDE = 2 * REACH + 1
DV, DU = np.mgrid[-REACH : REACH + 1, -REACH : REACH + 1].astype(float)
CENTRE, SIGMA = 1e-3, 1e-7  # a metre away, known to a tenth of a millimetre
PIXEL_MM = 0.8
TERMS = np.stack([np.ones_like(DU), DU, DV, DU**2, DU * DV, DV**2], axis=-1).reshape(-1, 6)
# A surface of 6 mm radius curves by one sigma of the prior: half its curvature, in noise.
SHARPEST = PIXEL_MM**2 * CENTRE**2 / SIGMA / (2.0 * 6.0)


def fitted(offset: Array, valid: Mask | None = None) -> tuple[Array, float, bool]:
    """Value and slopes at the middle of a window, the value's sigma, and whether it is accepted.

    offset: (7, 7) sigmas from CENTRE; so are the results.
    """
    there = np.ones_like(offset, bool) if valid is None else valid
    image = np.where(there, CENTRE + SIGMA * offset, 0.0).astype(np.float32)
    fit = QuadraticFit(*np.zeros((4, SIDE, SIDE), np.float32))
    accepted = np.zeros((SIDE, SIDE), bool)
    noise = np.full((SIDE, SIDE), SIGMA, np.float32)
    middle = np.array([SIDE * REACH + REACH])
    fit_trimmed_windows(image, noise, middle, REACH, PIXEL_MM, fit, accepted)
    value, *slopes, sigma = (
        float(part[REACH, REACH]) / SIGMA
        for part in (fit.value, fit.slope_u, fit.slope_v, fit.sigma)
    )
    return np.array([value - CENTRE / SIGMA, *slopes]), sigma, bool(accepted[REACH, REACH])


def by_numpy(offset: Array, kept: Mask) -> tuple[Array, float]:
    """The same by least squares over some samples, held by how sharply surfaces curve."""
    ridge = np.diag([0.0, 0.0, 0.0] + [SHARPEST**-2.0] * 3)
    some = TERMS[kept.ravel()]
    inverse = np.linalg.inv(some.T @ some + ridge)
    return (inverse @ some.T @ offset[kept])[:3], float(np.sqrt(inverse[0, 0]))


def curved(noise: float = 0.3) -> Array:
    """A surface that leans and curves, with noise; 0 at the middle."""
    rng = np.random.default_rng(2)
    offset = 2.0 * DU - 1.0 * DV + 0.11 * DU**2 - 0.07 * DU * DV + 0.05 * DV**2
    offset = offset + noise * rng.standard_normal(offset.shape)
    offset[REACH, REACH] = 0.0
    return offset


def same(found: tuple[Array, float, bool], truth: tuple[Array, float]) -> None:
    # A float32 of 1e-3 ends at 1e-10, a thousandth of a sigma.
    np.testing.assert_allclose(found[0], truth[0], atol=3e-3)
    assert found[1] == pytest.approx(truth[1], rel=2e-3)
    assert found[2]


EVERY = np.ones((SIDE, SIDE), bool)


def test_a_smooth_surface_is_fitted_by_all_of_the_window() -> None:
    same(fitted(curved()), by_numpy(curved(), EVERY))


def test_what_is_missing_counts_for_nothing() -> None:
    there = (DU > -2) & (DV < 3)
    same(fitted(curved(), there), by_numpy(curved(), there))


def test_curvature_that_no_surface_has_is_held_back() -> None:
    """With half of a window, where noise bends a fit most."""
    there = (DU >= 0) & (np.abs(DV) <= 2)
    sharp = curved(0.0) + 1.5 * DU**2
    same(fitted(sharp, there), by_numpy(sharp, there))


@pytest.mark.parametrize(("residual", "belongs"), [(2.7, True), (3.3, False), (-3.3, False)])
@pytest.mark.parametrize("place", [(0, 3), (3, 6), (5, 5)])
def test_a_sample_three_sigmas_off_the_others_is_left_out(
    residual: float, belongs: bool, place: tuple[int, int]
) -> None:
    ridge = np.diag([0.0, 0.0, 0.0] + [SHARPEST**-2.0] * 3)
    term = TERMS[SIDE * place[0] + place[1]]
    drawn = term @ np.linalg.solve(TERMS.T @ TERMS + ridge, term)  # the fit follows by so much
    offset = curved(0.0)
    offset[place] += residual / (1.0 - drawn)
    kept = EVERY.copy()
    kept[place] = belongs
    same(fitted(offset), by_numpy(offset, kept))


@pytest.mark.parametrize(("beside", "sigmas"), [(2, 100.0), (3, 40.0)])
def test_a_surface_behind_takes_no_part_however_large(beside: int, sigmas: float) -> None:
    """From two pixels beside the middle on it is no slope (ten sigmas a pixel are 45 degrees); from
    three on the closest neighbours tell."""
    offset = curved(0.1)
    behind = beside <= DU
    offset[behind] -= sigmas
    same(fitted(offset), by_numpy(offset, ~behind))


def test_a_window_cut_by_a_rim_is_fitted_exactly() -> None:
    """A quadratic in the pixels fits a quadratic exactly, however much of the window is missing."""
    v, u = np.mgrid[:60, :60].astype(np.float32)
    truth = 3e-3 + 2e-6 * u - 3e-6 * v + 1e-8 * u * u - 2e-8 * u * v + 1.5e-8 * v * v
    inverse = np.where(u + 0.5 * v < 50, truth, 0.0).astype(np.float32)
    noise = np.where(inverse > 0, 1e-6, 0.0).astype(np.float32)
    fit, fitted = fit_quadratics(inverse, noise, 4, 0.75)
    assert fitted[inverse > 0].mean() > 0.99
    # float32 resolves 2e-10 of these values; at sharp corners the prior takes a hundredth of sigma.
    error = np.abs(fit.value - truth)[fitted]
    assert np.mean(error > 3e-9) < 0.01
    assert (error < 0.02 * fit.sigma[fitted]).all()
    slope = 2e-6 + 2e-8 * u - 2e-8 * v
    np.testing.assert_allclose(fit.slope_u[fitted], slope[fitted], atol=1e-8)
    # What a window lacks shows in its sigma: 1/4 of the noise in a full one.
    inside, rim = fit.sigma[5:20, 5:20], fit.sigma[:, 0]
    assert 0.2e-6 < inside.max() < 0.3e-6
    assert np.median(rim) > 1.5 * inside.max()


def test_correlated_noise_is_averaged_less() -> None:
    """Over half a pixel none is correlated; noise common to the window is not averaged at all."""
    assert compute_noise_gain(4, (0.0, 0.5)) == pytest.approx(1.0)
    white = convolve_quadratics(np.zeros((9, 9), np.float32), np.ones((9, 9), np.float32), 4).sigma
    assert compute_noise_gain(4, (1e6, 1e6)) == pytest.approx(1.0 / white[4, 4], rel=1e-3)


def test_holes_of_a_few_pixels_are_closed_as_a_plane_goes_on() -> None:
    """By opposite neighbours, of which four pairs have to be there."""
    v, u = np.mgrid[:20, :24].astype(np.float32)
    plane = (1.0 + 0.01 * u - 0.02 * v).astype(np.float32)
    valid = np.ones(plane.shape, bool)
    valid[8, 9] = valid[12, 5] = valid[12, 6] = valid[0, 3] = False
    closed, whole = close_holes(plane * valid, valid)
    assert whole[valid].all()
    assert whole[8, 9]
    assert whole[12, 5:7].all()
    assert not whole[0, 3]  # at the picture's rim two pairs, in its own row
    np.testing.assert_allclose(closed[whole], plane[whole], rtol=1e-6)
    # A column of two pixels to one side and none to the other has no opposite pairs at all.
    half = np.zeros(plane.shape, bool)
    half[:, :10] = True
    assert not close_holes(plane * half, half)[1][:, 10:].any()
    for pairs, closes in ((3, False), (4, True)):
        few = np.zeros(plane.shape, bool)
        for step in ((0, 1), (1, 0), (1, 1), (2, 2))[:pairs]:
            few[8 + step[0], 9 + step[1]] = few[8 - step[0], 9 - step[1]] = True
        few[6, 9] = few[6, 10] = True  # without their opposites
        closed, whole = close_holes(plane * few, few)
        assert whole[8, 9] == closes
    assert closed[8, 9] == pytest.approx(plane[8, 9], rel=1e-6)


def test_full_windows_are_fitted_as_least_squares_would() -> None:
    rng = np.random.default_rng(5)
    image = (1.0 + 0.1 * rng.standard_normal((15, 17))).astype(np.float32)
    noise = np.full(image.shape, 0.1, np.float32)
    fit = convolve_quadratics(image, noise, 3)
    dv, du = np.mgrid[-3:4, -3:4].astype(float)
    terms = np.stack([np.ones(49), *(t.ravel() for t in (du, dv, du**2, du * dv, dv**2))], axis=1)
    inverse = np.linalg.inv(terms.T @ terms)
    truth = inverse @ terms.T @ image[4:11, 5:12].ravel().astype(float)
    assert fit.value[7, 8] == pytest.approx(truth[0], abs=1e-5)
    assert fit.slope_u[7, 8] == pytest.approx(truth[1], abs=1e-5)
    assert fit.slope_v[7, 8] == pytest.approx(truth[2], abs=1e-5)
    assert fit.sigma[7, 8] == pytest.approx(0.1 * np.sqrt(inverse[0, 0]), rel=1e-5)
