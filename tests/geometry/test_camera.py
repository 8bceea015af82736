import numpy as np
from any_camera import cameras
from hypothesis import given

from bodyscan.geometry.camera import Camera


@given(cameras)
def test_slopes_of_rays_are_derivatives_by_their_pixels(camera: Camera) -> None:
    pixels = np.random.default_rng(3).uniform([100.0, 100.0], [500.0, 400.0], (50, 2))
    slopes = camera.rays_by_pixels(camera.rays(pixels))
    for axis, step in enumerate(1e-3 * np.eye(2)):
        apart = camera.rays(pixels + step) - camera.rays(pixels - step)
        # A lens bends by less than 1e-6 of the slope over so little, and rays are good to 1e-14.
        np.testing.assert_allclose(slopes[..., axis], apart[:, :2] / 2e-3, atol=1e-10)
