"""The table of bowed sheets against the sheets themselves, and images measured by it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from sheet_models import MIDDLE, STRIPES, by_offset, models

from bodyscan.arrays import Array
from bodyscan.geometry.bowed_sheets import BowedSheets
from bodyscan.geometry.camera import Camera
from bodyscan.geometry.lenses.opencv import Radial
from bodyscan.geometry.light_sheets import MAX_RELATIVE_SIGMA, triangulate_image


@pytest.fixture(params=[(3, 1), (4, 1), (3, 3), (4, 3)], ids=str)
def sheets(request: pytest.FixtureRequest) -> BowedSheets:
    """A draw of the models' parameters, and how many terms the bow has."""
    draw, bow_terms = request.param
    return next(
        model
        for model in models(draw)
        if isinstance(model, BowedSheets) and model.bow_terms == bow_terms
    )


CAMERA = Camera(500.0, 502.0, -0.5, 100.0, 75.0, Radial(-0.15, 0.03), 200, 150)


def some_rays(count: int) -> tuple[Array, Array]:
    rng = np.random.default_rng(11)
    points = MIDDLE + rng.uniform(-300.0, 300.0, (count, 3))
    return points / points[:, 2:], rng.uniform(0.0, STRIPES, count)


def test_it_agrees_with_the_sheets(sheets: BowedSheets) -> None:
    rays, s = some_rays(20_000)
    found = sheets.intersect(rays, s)
    near = found.depth < 3000.0  # where bodies are; far planes are nearly along the ray
    assert near.sum() > 2500
    depth, slope, variance = by_offset(sheets, rays[near], s[near], found.depth[near])
    # Linear between nodes: m'' / 8 / 64 of a plane that turns by a radian over 200 stripes, 3e-9 in
    # 1/z, which is 5 um at 1.3 m; a tenth of it with the 640 stripes of a real rig.
    np.testing.assert_allclose(1.0 / found.depth[near], 1.0 / depth, rtol=0.0, atol=3e-9)
    np.testing.assert_allclose(found.per_stripe[near], slope, rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(found.variance_mm2[near], variance, rtol=2e-3)


def test_nothing_outside_the_stripes_or_behind(sheets: BowedSheets) -> None:
    rays, _ = some_rays(300)
    for nowhere in (-0.1, STRIPES + 0.1, np.nan):
        assert np.isnan(sheets.intersect(rays, np.full(len(rays), nowhere)).depth).all()
    upward = np.tile([0.0, -2.0, 1.0], (300, 1))
    depth = sheets.intersect(upward, np.linspace(0.0, STRIPES, 300)).depth
    assert (depth[np.isfinite(depth)] > 0.0).all()


def test_an_image_is_measured_as_its_rays_are(sheets: BowedSheets) -> None:
    rng = np.random.default_rng(4)
    shape = (CAMERA.height, CAMERA.width)
    s = rng.uniform(-5.0, STRIPES + 5.0, shape).astype(np.float32)
    s[rng.random(shape) < 0.1] = np.nan
    sigma = rng.uniform(0.01, 0.03, shape).astype(np.float32)
    sigma[rng.random(shape) < 0.05] = np.nan
    points, sigma_mm, _ = triangulate_image(sheets, CAMERA, s, sigma)
    assert points.dtype == sigma_mm.dtype == np.float32

    rays = CAMERA.pixel_rays()
    found = sheets.intersect(rays, s.astype(float))
    depth, variance, slope = found.depth, found.variance_mm2, found.per_stripe
    along = np.sqrt((slope * sigma) ** 2 + variance) * np.linalg.norm(rays, axis=-1)
    sure = variance <= (MAX_RELATIVE_SIGMA * depth) ** 2
    expected, known = sure & np.isfinite(along), np.isfinite(sigma_mm)
    np.testing.assert_array_equal(np.isfinite(points).all(axis=-1), known)
    # Rays are tabulated: only what lies close to the limit may fall otherwise.
    assert np.mean(expected != known) < 2e-3
    assert known.sum() > 5000
    near = expected & known & (depth < 3000.0)
    # 3e-9 in 1/z (see above), and what float32 holds of a metre.
    z = points[near][:, 2:].astype(float)
    np.testing.assert_allclose(1.0 / z[:, 0], 1.0 / depth[near], rtol=2e-7, atol=3e-9)
    # Rays are tabulated to 1e-4 px, or twice that between nodes: 1.2e-3 mm at 3 m and 500 px.
    np.testing.assert_allclose(points[near], z * rays[near], rtol=1e-6, atol=1.2e-3)
    np.testing.assert_allclose(sigma_mm[near], along[near], rtol=2e-3)


def test_what_boards_leave_open_everywhere_is_no_guess(sheets: BowedSheets) -> None:
    """A focal length from four boards at 4 m leaves all depths open by half a per cent alike."""
    rays = CAMERA.pixel_rays()
    column = int(np.argmin(np.linalg.norm(rays - MIDDLE / MIDDLE[2], axis=-1)) % CAMERA.width)
    row = int(np.argmin(np.linalg.norm(rays - MIDDLE / MIDDLE[2], axis=-1)) // CAMERA.width)
    ray, every = rays[row, column][None], np.linspace(1.0, STRIPES - 1.0, 500)
    depth = sheets.intersect(np.repeat(ray, 500, axis=0), every).depth
    stripe = every[np.nanargmin(np.abs(depth - MIDDLE[2]))]
    share = np.sqrt(sheets.intersect(ray, np.array([stripe])).variance_mm2[0]) / MIDDLE[2]
    s = np.full((CAMERA.height, CAMERA.width), np.nan, np.float32)
    s[row, column] = stripe
    sigma = np.full(s.shape, 0.02, np.float32)
    vague = replace(sheets, covariance=sheets.covariance * (5e-3 / share) ** 2)
    known = np.isfinite(triangulate_image(vague, CAMERA, s, sigma)[1])
    assert known[row, column]
    assert known.sum() == 1
