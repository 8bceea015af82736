import numpy as np
import pytest
from any_camera import cameras, pixels_of
from hypothesis import given, settings
from hypothesis import strategies as st

from bodyscan.geometry.camera import Camera
from bodyscan.geometry.camera_tables import (
    Table,
    look_up,
    look_up_derivatives,
    look_up_rays,
    make_projection_table,
    make_ray_table,
)
from bodyscan.geometry.lenses.opencv import Radial

MOST_PX = 1e-3
SCANNER = Camera(1510.0, 1512.0, -0.5, 645.0, 508.0, Radial(-0.1, 0.05), 1280, 1024)
WIDE = Camera(1500.0, 1500.0, 0.0, 640.0, 512.0, Radial(-0.4, 0.0), 1280, 1024)
"""Its rays end 34 degrees from the axis; from 42 degrees on the lens folds back."""

# The first call of a compiled function compiles it.
patiently = settings(deadline=None, max_examples=40)


def pixels_in(table: Table, points: np.ndarray) -> np.ndarray:
    return np.array([look_up(table, x / z, y / z) for x, y, z in points])


@patiently
@given(cameras, st.integers(0, 2**32 - 1))
def test_the_table_projects_as_the_camera_does(camera: Camera, seed: int) -> None:
    size = np.array([camera.width, camera.height])
    pixels = np.random.default_rng(seed).uniform(-0.5, size - 0.5, (60, 2))
    points = camera.rays(np.concatenate([pixels, pixels_of(camera)])) * 1234.5
    found = pixels_in(make_projection_table(camera), points)
    assert np.abs(found - camera.project(points)).max() < MOST_PX


@pytest.mark.parametrize("camera", [SCANNER, WIDE])
def test_a_scanners_table_is_finer_than_asked(camera: Camera) -> None:
    pixels = np.random.default_rng(0).uniform(0.0, [1279.0, 1023.0], (500, 2))
    found = pixels_in(make_projection_table(camera), camera.rays(pixels))
    assert np.abs(found - pixels).max() < 2e-4  # 1e-4 at the places it was fitted to


@patiently
@given(cameras)
def test_what_lies_beside_the_image_has_no_pixel_in_it(camera: Camera) -> None:
    u, v = np.meshgrid([-30.0, 320.0, 670.0], [-30.0, 240.0, 510.0])
    beside = np.delete(np.stack([u, v], axis=-1).reshape(-1, 2), 4, axis=0)
    rays = np.concatenate([camera.rays(beside), [[9.0, 0.0, 1.0], [0.0, -1e6, 1.0]]])
    found = pixels_in(make_projection_table(camera), rays)
    inside = (found > -0.5) & (found < np.array([camera.width, camera.height]) - 0.5)
    assert not inside.all(axis=1).any()


def test_where_the_lens_folds_back_nothing_is_seen() -> None:
    ray = np.array([[np.tan(np.radians(60.0)), 0.0, 1.0]])
    assert 0.0 < WIDE.project(ray)[0, 0] < 1279.0
    assert np.all(pixels_in(make_projection_table(WIDE), ray) < -0.5)


def test_a_lens_that_folds_within_the_picture_has_no_rays_beyond_and_shows_nothing_there() -> None:
    camera = Camera(900.0, 900.0, 0.0, 640.0, 512.0, Radial(-0.6, 0.0), 1280, 1024)
    wanted = np.zeros((1024, 1280), bool)
    wanted[::16, ::16] = True
    rays = look_up_rays(make_ray_table(camera), wanted)
    rows, columns = np.nonzero(wanted)
    pixels = np.stack([columns, rows], axis=-1).astype(float)
    known = np.all(np.isfinite(rays), axis=1)
    assert 0.4 < known.mean() < 0.9
    # The shown radius ends at 0.497 of the focal length; a cell, 16 px at least, that holds the rim
    # is left out whole, and just before it rays change endlessly fast.
    radius = np.linalg.norm(pixels - [640.0, 512.0], axis=1)
    assert known[radius < 400.0].all()
    assert not known[radius > 448.0].any()
    inner = radius < 380.0
    assert np.abs(camera.project(rays[inner]) - pixels[inner]).max() < 2e-2
    beyond = np.array(
        [[r * np.cos(a), r * np.sin(a), 1.0] for r in (0.8, 1.0, 1.2) for a in range(6)]
    )
    assert np.all(pixels_in(make_projection_table(camera), beyond) < -0.5)


@patiently
@given(cameras)
def test_slopes_are_derivatives_of_the_projection(camera: Camera) -> None:
    rays = camera.rays(pixels_of(camera))
    table = make_projection_table(camera)
    found = np.array([look_up_derivatives(table, x, y) for x, y, _ in rays]).reshape(-1, 2, 2)
    by_point = camera.jacobians(rays)[1][:, :, :2]
    # Straight lines for what bends: a normal is turned by as much at most, 0.01 degrees.
    assert np.abs(found - by_point).max() < 2e-4 * camera.alpha


@patiently
@given(cameras, st.integers(0, 479))
def test_rays_through_pixels_are_those_of_the_camera(camera: Camera, first: int) -> None:
    wanted = np.random.default_rng(first).random((min(12, 480 - first), 640)) < 0.1
    rays = look_up_rays(make_ray_table(camera), wanted, first)
    rows, columns = np.nonzero(wanted)
    pixels = np.stack([columns, rows + first], axis=-1).astype(float)
    assert np.max(np.abs(camera.project(rays) - pixels), initial=0.0) < MOST_PX
    assert np.all(rays[:, 2] == 1.0)


def test_equal_cameras_share_their_tables() -> None:
    again = Camera(1510.0, 1512.0, -0.5, 645.0, 508.0, Radial(-0.1, 0.05), 1280, 1024)
    assert make_projection_table(SCANNER) is make_projection_table(again)
    other = SCANNER.retract(np.array([0.0, 0.0, 0.0, 0.0, 0.0, 1e-3, 0.0]))
    assert make_projection_table(SCANNER) is not make_projection_table(other)


@given(cameras)
def test_slopes_of_rays_are_derivatives_by_their_pixels(camera: Camera) -> None:
    pixels = np.random.default_rng(3).uniform([100.0, 100.0], [500.0, 400.0], (50, 2))
    slopes = camera.rays_by_pixels(camera.rays(pixels))
    for axis, step in enumerate(1e-3 * np.eye(2)):
        apart = camera.rays(pixels + step) - camera.rays(pixels - step)
        # A lens bends by less than 1e-6 of the slope over so little, and rays are good to 1e-14.
        np.testing.assert_allclose(slopes[..., axis], apart[:, :2] / 2e-3, atol=1e-10)
