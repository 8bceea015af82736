"""Planes in cells of a picture, and a field of speeds over them no larger than it has to be."""

from __future__ import annotations

import numpy as np
import pytest

from bodyscan.reconstruction.speed_field import CellSpeeds, Knots, fit_field, unexplained
from bodyscan.reconstruction.surface_cells import Cells, fit_planes

CELLS = Cells(width=100, height=70, px=16)


def test_a_picture_is_cut_into_cells_the_last_ones_smaller() -> None:
    assert CELLS.shape == (5, 7)
    assert CELLS.count == 35
    columns, rows = CELLS.middles
    np.testing.assert_allclose(columns, 7.5 + 16.0 * np.arange(7))
    np.testing.assert_allclose(rows, 7.5 + 16.0 * np.arange(5))
    places = np.array([[-0.5, -0.5], [15.49, 0.0], [15.5, 0.0], [0.0, 15.5], [99.0, 69.0]])
    assert CELLS.of(places).tolist() == [0, 0, 1, 7, 34]
    # Beside the picture counts as its rim.
    assert CELLS.of(np.array([[-40.0, 33.0], [500.0, 33.0], [33.0, -9.0], [33.0, 900.0]])).tolist() == [
        14, 20, 2, 30,
    ]  # fmt: skip


def seen(plane: np.ndarray, noise_mm: float = 0.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pixels, rays and depths on p.P = 1."""
    v, u = np.indices((70, 100))
    pixels = np.stack([u, v], axis=-1).reshape(-1, 2).astype(float)
    rays = np.column_stack([(pixels - [50.0, 35.0]) / 200.0, np.ones(len(pixels))])
    depth = 1.0 / (rays @ plane)
    return pixels, rays, depth + noise_mm * np.random.default_rng(0).normal(size=len(depth))


PLANE = np.array([3e-4, -2e-4, 1e-3])


def test_each_cell_has_the_plane_that_lies_in_it() -> None:
    pixels, rays, depth = seen(PLANE)
    weights = np.random.default_rng(1).uniform(0.5, 2.0, len(depth))
    planes, points = fit_planes(CELLS, pixels, rays, depth, weights)
    whole, narrow = np.split(planes.reshape(5, 7, 3), [6], axis=1)
    np.testing.assert_allclose(whole, np.tile(PLANE, (5, 6, 1)), rtol=1e-6, atol=1e-10)
    assert np.isnan(narrow).all()  # 4 px across: they tell no slope
    np.testing.assert_allclose(points @ PLANE, 1.0, rtol=1e-9)
    cell = CELLS.of(pixels)
    middle = np.average(rays[cell == 9], axis=0, weights=weights[cell == 9])
    np.testing.assert_allclose(points[9] / points[9, 2], middle, rtol=1e-9)


def test_what_weighs_more_draws_the_plane_to_itself() -> None:
    pixels, rays, depth = seen(PLANE)
    other = seen(PLANE * [1.0, 1.0, 0.999])[2]
    half = np.arange(len(depth)) % 2 == 0
    weights = np.where(half, 3.0, 1.0)
    found, _ = fit_planes(CELLS, pixels, rays, np.where(half, depth, other), weights)
    np.testing.assert_allclose(found[9, 2], 1e-3 * (0.75 + 0.25 * 0.999), rtol=1e-4)


def test_few_places_a_line_of_them_or_two_surfaces_have_no_plane() -> None:
    pixels, rays, depth = seen(PLANE)
    cell = CELLS.of(pixels)
    inside = np.flatnonzero(cell == 9)
    spread = inside[np.linspace(0, len(inside) - 1, 6).astype(int) + [0, 9, 3, 5, 1, 0]]
    for count, known in ((6, True), (5, False)):
        kept = np.append(np.flatnonzero(cell != 9), spread[:count])
        planes, _ = fit_planes(CELLS, pixels[kept], rays[kept], depth[kept], np.ones(len(kept)))
        assert np.isfinite(planes[9]).all() == known
        assert np.isfinite(planes[10]).all()
    row = (cell != 9) | (pixels[:, 1] == 20)
    planes, _ = fit_planes(CELLS, pixels[row], rays[row], depth[row], np.ones(row.sum()))
    assert np.isnan(planes[9]).all()
    for rough_mm, known in ((2.5, True), (3.5, False)):
        off = np.where(np.arange(len(depth)) % 2 == 0, rough_mm, -rough_mm)
        planes, _ = fit_planes(CELLS, pixels, rays, depth + off, np.ones(len(depth)))
        assert np.isfinite(planes[[8, 9, 10]]).all() == known


def test_where_nothing_was_seen_there_is_no_plane() -> None:
    pixels, rays, depth = seen(PLANE)
    left = CELLS.of(pixels) % 7 < 3
    planes, _ = fit_planes(CELLS, pixels[left], rays[left], depth[left], np.ones(left.sum()))
    assert np.isfinite(planes.reshape(5, 7, 3)[:, :3]).all()
    assert np.isnan(planes.reshape(5, 7, 3)[:, 3:]).all()


WIDE = Cells(width=640, height=480, px=16)
"""1 mm a pixel: a person's trunk."""


def told(field: np.ndarray, sigma: float = 0.2, seed: int = 0) -> CellSpeeds:
    """Speeds (cells,) with noise, under a twist that moves all alike; a corner is not seen."""
    rng = np.random.default_rng(seed)
    columns, rows = WIDE.middles
    x, y = (one.ravel() for one in np.meshgrid(columns - 320.0, rows - 240.0))
    by_twist = np.column_stack([y / 300.0, x / 300.0, 0.0 * x, 0.0 * x, 0.0 * x, np.ones_like(x)])
    weight = np.where((x > 200.0) & (y > 150.0), 0.0, sigma**-2.0)
    return CellSpeeds(field + sigma * rng.normal(size=len(field)), weight, by_twist)


def knots(cells: CellSpeeds) -> Knots:
    return Knots.over(WIDE, cells.weight > 0.0, 1.0)


TWIST_SIGMAS = np.array([50.0, 50.0, 50.0, 50.0, 50.0, 50.0])


def test_knots_are_eighty_millimetres_apart_and_linear_between() -> None:
    every = np.ones(WIDE.count, bool)
    found = Knots.over(WIDE, every, 1.0)
    assert found.share.shape == (WIDE.count, 9 * 7)
    np.testing.assert_allclose(found.share.sum(axis=1), 1.0)
    columns, rows = WIDE.middles
    x, y = (one.ravel() for one in np.meshgrid(columns, rows))
    place = np.stack(np.meshgrid(80.0 * np.arange(9), 80.0 * np.arange(7)), axis=-1).reshape(-1, 2)
    np.testing.assert_allclose(found.share @ place, np.column_stack([x, y]), atol=1e-9)
    apart = np.linalg.norm(place[3] - place[40])
    assert found.akin[3, 40] == pytest.approx(np.exp(-apart / 150.0))
    # Half as many millimetres a pixel: half as many knots, whose distances are as many.
    fine = Knots.over(WIDE, every, 0.5)
    assert fine.share.shape == (WIDE.count, 5 * 4)
    assert fine.akin[0, 1] == pytest.approx(np.exp(-80.0 / 150.0))
    # Those that no known cell asks for are left out.
    assert Knots.over(WIDE, np.arange(WIDE.count) < 40, 1.0).share.shape == (WIDE.count, 9 * 2)


def test_what_moves_as_one_has_no_field_and_its_twist_is_as_known_as_said() -> None:
    off = []
    for seed in range(40):
        cells = told(np.zeros(WIDE.count), seed=seed)
        moved = CellSpeeds(
            cells.speed + cells.by_twist @ [1.0, -2.0, 0.0, 0.0, 0.0, 3.0],
            cells.weight, cells.by_twist,
        )  # fmt: skip
        fit = fit_field(moved, knots(moved), TWIST_SIGMAS, bent=12.0)
        assert not fit.is_bent
        assert np.array_equal(fit.field, np.zeros(len(fit.field)))
        sigma = np.sqrt(np.diag(fit.covariance)[[0, 1, 5]])
        off.append((fit.twist[[0, 1, 5]] - [1.0, -2.0, 3.0]) / sigma)
        # What the twist explains: chi-square of the speeds less what it leaves.
        left = moved.speed - moved.by_twist @ fit.twist
        chi2 = np.sum(moved.weight * (moved.speed**2 - left**2))
        assert fit.explained == pytest.approx(chi2, rel=1e-3)
    assert np.sqrt(np.mean(np.square(off))) == pytest.approx(1.0, abs=0.2)  # of 120


def test_what_bends_is_followed_where_it_was_seen_and_doubted_elsewhere() -> None:
    columns, rows = WIDE.middles
    x, _ = (one.ravel() for one in np.meshgrid(columns, rows))
    true = 2.0 * np.sin(x / 90.0)
    cells = told(true)
    fit = fit_field(cells, knots(cells), TWIST_SIGMAS, bent=12.0)
    assert fit.is_bent
    known = cells.weight > 0.0
    off = (fit.speed(cells, knots(cells)) - true)[known]
    sigma = np.sqrt(fit.variance(cells, knots(cells)))
    assert np.sqrt(np.mean(off**2)) < 0.15
    # Linear between knots 80 mm apart: beside noise, 80^2 / 8 x 2 / 90^2 = 0.2 at a crest.
    assert 0.5 < np.sqrt(np.mean((off / sigma[known]) ** 2)) < 1.6
    assert sigma[~known].mean() > 2.0 * sigma[known].mean()


def test_evidence_of_a_bend_is_weighed_as_the_caller_asks() -> None:
    columns, rows = WIDE.middles
    x, _ = (one.ravel() for one in np.meshgrid(columns, rows))
    cells = told(0.1 * np.sin(x / 90.0))
    gains = [
        fit_field(cells, knots(cells), TWIST_SIGMAS, bent=bent).is_bent for bent in (-1.0, 1e6)
    ]
    assert gains == [True, False]


def test_what_is_left_over_beyond_noise_is_variance_there() -> None:
    columns, rows = WIDE.middles
    x, _ = (one.ravel() for one in np.meshgrid(columns, rows))
    cells = told(np.zeros(WIDE.count))
    rng = np.random.default_rng(5)
    noise = 0.2 * rng.normal(size=WIDE.count)
    assert np.mean(unexplained(cells, knots(cells), noise) > 0.0) < 0.1
    for more in (1.0, 0.3):
        left = noise + np.where(x < 200.0, more, 0.0) * np.sign(noise)
        beyond = unexplained(cells, knots(cells), left)
        square = np.mean(left[x < 120.0] ** 2) - 0.04
        assert np.median(beyond[x < 100.0]) == pytest.approx(square, rel=0.15)
        assert np.median(beyond[x > 320.0]) == 0.0
