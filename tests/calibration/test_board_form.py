"""Forms of boards: bent sheets whose heights are known in closed form."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from bodyscan.arrays import Array
from bodyscan.calibration.board_form import POWERS, BoardFace, BoardForm, PrintSpread


def corners() -> Array:
    """9 x 6 every 40 mm, off the origin: x from 20 to 340, y from -30 to 170."""
    x, y = np.meshgrid(20.0 + 40.0 * np.arange(9), -30.0 + 40.0 * np.arange(6))
    return np.stack([x, y, np.zeros_like(x)], axis=-1).reshape(-1, 3)


def scaled(places: Array) -> tuple[Array, Array]:
    """-1 and 1 at the outermost corners."""
    return (places[..., 0] - 180.0) / 160.0, (places[..., 1] - 70.0) / 100.0


def bent(*heights: float) -> BoardForm:
    flat = BoardForm.flat(corners(), 0.2, PrintSpread(0.05))
    return flat.moved(np.concatenate([heights, np.zeros(flat.count - 7)]))


@pytest.mark.parametrize("number", range(7))
def test_each_coefficient_lifts_by_its_power_less_the_best_plane(number: int) -> None:
    form = bent(*np.eye(7)[number])
    x, y = scaled(form.points)
    i, j = POWERS[number]
    power = x**i * y**j
    plane = np.stack([np.ones_like(x), x, y], axis=1)
    expected = power - plane @ np.linalg.lstsq(plane, power, rcond=None)[0]
    np.testing.assert_allclose(form.height(form.points[:, :2]), expected, atol=1e-12)
    np.testing.assert_allclose(form.basis(form.points[:, :2])[:, number], expected, atol=1e-12)
    assert form.out_of_plane_mm == pytest.approx(np.ptp(expected))
    # Between corners and beyond them it goes on.
    place = np.array([[400.0, 100.0]])
    u, v = scaled(place)
    fitted = np.linalg.lstsq(plane, power, rcond=None)[0]
    assert form.height(place) == pytest.approx(
        u**i * v**j - (fitted[0] + fitted[1] * u + fitted[2] * v)
    )


def test_corners_are_where_the_form_says() -> None:
    form = bent(0.4, 0, 0, 0, 0, 0, 0)
    step = np.zeros(form.count)
    step[7 + 2 * 3] = 0.1  # the fourth corner's x
    form = form.moved(step)
    some = corners()[[3, 50]]
    numbers = form.numbers(some)
    np.testing.assert_array_equal(form.points[numbers], some)
    there = form.applied(some, numbers)
    np.testing.assert_allclose(
        there[:, :2] - some[:, :2], np.where(numbers == 3, 0.1, 0.0)[:, None] * [1, 0]
    )
    np.testing.assert_allclose(there[:, 2], form.height(some[:, :2]))
    np.testing.assert_allclose(form.unknowns[:8], [0.4, 0, 0, 0, 0, 0, 0, 0])
    assert form.count == 7 + 2 * 54


def expected_covariance(form: BoardForm) -> Array:
    """Of the unknowns, beforehand."""
    _, jacobian = form.prior
    return np.asarray(np.linalg.inv(jacobian.T @ jacobian))


def test_what_is_expected_beforehand_is_the_flatness_and_the_print() -> None:
    form = bent(0, 0, 0, 0, 0, 0, 0)
    sigmas = np.sqrt(np.diag(expected_covariance(form)))
    np.testing.assert_allclose(sigmas[:3], 0.2)
    np.testing.assert_allclose(sigmas[3:7], 0.06)  # of third degree three tenths
    np.testing.assert_allclose(sigmas[7:], 0.05)
    exact = np.sqrt(np.diag(expected_covariance(form.exact)))
    np.testing.assert_allclose(exact, 1e-6)  # a nanometre
    known, jacobian = bent(0.4, 0, 0, 0, 0, 0, 0.03).prior
    np.testing.assert_allclose(known[:7], [2.0, 0, 0, 0, 0, 0, 0.5])
    np.testing.assert_allclose(jacobian @ bent(0.4, 0, 0, 0, 0, 0, 0.03).unknowns, known)


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize(("power", "share"), [((1, 0), 1.0), ((0, 1), 1.0), ((1, 1), 0.3)])
def test_corners_share_a_print_s_stretch_and_skew(
    power: tuple[int, int], share: float, axis: int
) -> None:
    """Each has the size asked for, RMS over the corners, and three tenths of it a degree higher."""
    form = replace(bent(0, 0, 0, 0, 0, 0, 0), print_spread=PrintSpread(0.01, 0.08))
    x, y = scaled(form.points)  # a regular grid, on which these are orthogonal
    pattern = np.zeros((54, 2))
    pattern[:, axis] = x ** power[0] * y ** power[1]
    pattern /= np.linalg.norm(pattern)
    there = pattern.ravel() @ expected_covariance(form)[7:, 7:] @ pattern.ravel()
    # Of a unit vector over 54 corners: the pattern's mean square, 54 times, and one corner's own.
    assert there == pytest.approx(54 * (share * 0.08) ** 2 + 0.01**2, rel=1e-6)


def test_corners_given_by_several_views_count_once() -> None:
    form = BoardForm.flat(np.concatenate([corners(), corners()[:5] + 1e-8]), 0.2, PrintSpread(0.05))
    assert len(form.points) == 54


def test_a_face_goes_through_corners_that_lie_on_a_cubic() -> None:
    points = corners()
    x, y = scaled(points)
    points[:, 2] = 7.0 + 0.3 * x**2 - 0.2 * x * y + 0.1 * y**3 + 0.05 * x * x * y
    face = BoardFace.through(points)
    np.testing.assert_allclose(face.z_mm + face.height(points[:, :2]), points[:, 2], atol=1e-9)
    np.testing.assert_allclose(face.middle, [180.0, 70.0])
    np.testing.assert_allclose(face.half, [160.0, 100.0])
    assert face.z_mm == pytest.approx(np.median(points[:, 2]))
    # Of fourth degree it knows nothing: what is left of x^4 then is no more than a quadratic leaves.
    points[:, 2] = x**4
    off = face.through(points).height(points[:, :2]) + face.through(points).z_mm - x**4
    assert 0.05 < np.abs(off).max() < 0.3
