from dataclasses import replace

import numpy as np
from any_camera import cameras, pixels_of
from hypothesis import given

from bodyscan.geometry.camera import Camera
from bodyscan.geometry.lenses.opencv import Radial


@given(cameras)
def test_slopes_of_rays_are_derivatives_by_their_pixels(camera: Camera) -> None:
    pixels = np.random.default_rng(3).uniform([100.0, 100.0], [500.0, 400.0], (50, 2))
    slopes = camera.rays_by_pixels(camera.rays(pixels))
    for axis, step in enumerate(1e-3 * np.eye(2)):
        apart = camera.rays(pixels + step) - camera.rays(pixels - step)
        # A lens bends by less than 1e-6 of the slope over so little, and rays are good to 1e-14.
        np.testing.assert_allclose(slopes[..., axis], apart[:, :2] / 2e-3, atol=1e-10)


@given(cameras)
def test_distortion_is_that_of_equations_3_to_5(camera: Camera) -> None:
    camera = replace(camera, lens=Radial(-0.1, 0.05))
    points = camera.rays(pixels_of(camera)) * 700.0
    ideal = points @ camera.matrix.T
    u, v = (ideal[:, :2] / ideal[:, 2:]).T
    normalized = np.linalg.solve(camera.matrix, np.stack([u, v, np.ones_like(u)]))
    r2 = normalized[0] ** 2 + normalized[1] ** 2
    assert isinstance(camera.lens, Radial)
    factor = camera.lens.k1 * r2 + camera.lens.k2 * r2**2
    # Eq. 3 scales u - u0, which holds x and, through the skew, y; so does ours.
    real = np.stack([u + (u - camera.u0) * factor, v + (v - camera.v0) * factor], axis=1)
    assert np.allclose(camera.project(points), real, atol=1e-8)
