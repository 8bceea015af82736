from dataclasses import replace

import numpy as np
import pytest
from ball import ball_points
from small_pair import CAMERA, pair, stripe_map

from bodyscan.geometry.camera import Camera
from bodyscan.geometry.lenses.opencv import Radial
from bodyscan.geometry.uncertainty import COLUMNS, ROWS, RayUncertainty
from bodyscan.reconstruction.triangulation import estimate_grid_normals, reconstruct_range_image
from bodyscan.stripes.stripe_map import StripeMap


def test_a_slanted_plane_is_measured_where_it_is() -> None:
    normal = np.array([0.2, 0.1, -1.0]) / np.linalg.norm([0.2, 0.1, -1.0])
    rays = CAMERA.pixel_rays()
    depth = -500.0 / (rays @ normal)
    image = reconstruct_range_image(pair(), stripe_map(depth))
    known = image.valid
    assert known.mean() > 0.5
    # s is stored as float32: 64 stripes to 4e-6, worth 4e-5 mm here.
    assert np.allclose(image.points[known], (rays * depth[..., None])[known], atol=2e-3)
    inner = image.normals[5:-5, 5:-5][known[5:-5, 5:-5]]
    inner = inner[np.isfinite(inner[:, 0])]
    assert np.allclose(inner, normal, atol=1e-3)


def test_sigma_follows_from_the_decoding() -> None:
    rays = CAMERA.pixel_rays()
    depth = np.full(rays.shape[:2], 480.0)
    stripes = stripe_map(depth)
    image = reconstruct_range_image(pair(), stripes)
    assert not np.shares_memory(image.colours, stripes.lit)  # one of a stack of images
    shifted = reconstruct_range_image(
        pair(), StripeMap(**{**vars(stripes), "s": (stripes.s + 0.01).astype(np.float32)})
    )
    known = image.valid & shifted.valid
    moved = np.linalg.norm(shifted.points[known] - image.points[known], axis=1)
    # One sigma of s moves a point by its sigma, along its ray; crossing into the next plane's
    # interval changes the slope a little.
    assert np.allclose(moved, image.sigma_mm[known], rtol=0.1)


def test_a_ray_that_is_not_known_moves_its_point_by_its_sigma() -> None:
    """Rays half a pixel aside, across the stripes: points move by what that sigma says."""
    depth = np.full(CAMERA.pixel_rays().shape[:2], 480.0)
    exact = StripeMap(**{**vars(stripe_map(depth)), "sigma": np.zeros(depth.shape, np.float32)})
    unsure = np.full((ROWS, COLUMNS), 0.3), np.full((ROWS, COLUMNS), 0.4)
    known = reconstruct_range_image(pair(), exact)
    image = reconstruct_range_image(replace(pair(), rays=RayUncertainty(*unsure)), exact)
    aside = replace(CAMERA, u0=CAMERA.u0 + 0.5), replace(CAMERA, v0=CAMERA.v0 + 0.5)
    moved = [
        reconstruct_range_image(replace(pair(), camera=camera), exact).points - known.points
        for camera in aside
    ]
    distance = np.hypot(*(np.linalg.norm(one, axis=-1) for one in moved))
    both = image.valid & np.isfinite(distance)
    assert both.mean() > 0.5
    added = np.sqrt(image.sigma_mm[both] ** 2 - known.sigma_mm[both] ** 2)
    assert image.common_mm is not None
    assert known.common_mm is not None
    shared = np.hypot(known.common_mm[both], added)
    assert np.allclose(image.common_mm[both], shared, rtol=1e-3, atol=1e-5)
    # One number says how fine the stripes are everywhere, and a ray moves aside as well as along.
    assert np.median(added / distance[both]) == pytest.approx(1.0, abs=0.15)
    assert np.percentile(added / distance[both], [5, 95]) == pytest.approx([1.0, 1.0], abs=0.35)


def test_normals_of_a_sphere_point_to_the_camera() -> None:
    rays = CAMERA.pixel_rays()
    centre, radius = np.array([0.0, 0.0, 600.0]), 80.0
    points = ball_points(CAMERA, centre, radius).astype(np.float32)
    normals = estimate_grid_normals(points)
    true = (points - centre) / radius
    facing = -np.sum(true * rays, axis=-1) / np.linalg.norm(rays, axis=-1)
    middle = np.isfinite(normals[..., 0]) & (facing > 0.5)
    assert middle.sum() > 1000
    # A window of 5 px (7 mm) on a sphere of 80 mm: second-order terms of a few thousandths.
    assert np.min(np.sum(normals[middle] * true[middle], axis=1)) > 0.999


def test_a_normal_needs_its_whole_window() -> None:
    rays = CAMERA.pixel_rays()
    points = (rays * 500.0).astype(np.float32)
    points[40, 70] = np.nan
    unknown = np.isnan(estimate_grid_normals(points)).any(axis=-1)
    expected = np.ones_like(unknown)
    expected[2:-2, 2:-2] = False
    expected[38:43, 68:73] = True
    np.testing.assert_array_equal(unknown, expected)


def test_normals_are_those_of_planes_fitted_to_the_windows() -> None:
    """Against a least-squares fit of 1/z by column and row, window by window, on a rough surface."""
    rng = np.random.default_rng(6)
    camera = Camera(400.0, 400.0, 0.0, 15.0, 10.0, Radial(), 30, 20)
    rays = camera.pixel_rays()
    points = rays * rng.uniform(480.0, 520.0, rays.shape[:2])[..., None]
    normals = estimate_grid_normals(points.astype(np.float32))
    for v, u in rng.integers([2, 2], [18, 28], (30, 2)):
        window = np.s_[v - 2 : v + 3, u - 2 : u + 3]
        ones = np.ones((25, 1))
        unknowns = np.hstack([rays[window].reshape(25, 3)[:, :2], ones])
        slope = np.linalg.lstsq(unknowns, 1.0 / points[window][..., 2].ravel(), rcond=None)[0]
        rest = 1.0 / points[v, u, 2] - slope[:2] @ rays[v, u, :2]
        normal = -np.append(slope[:2], rest)
        # float32 sums of 25 numbers near 1, of which differences of 1e-2 are taken.
        assert np.allclose(normals[v, u], normal / np.linalg.norm(normal), atol=1e-4)
