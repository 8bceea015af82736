"""How far points lie off smooth surfaces, and how far noise alone would put them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from ball import range_image_of

from bodyscan.arrays import Array
from bodyscan.fusion.regions import measure_roughness
from bodyscan.geometry.camera import Camera
from bodyscan.geometry.lenses.opencv import Radial
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.reconstruction.range_image import RangeImage

CAMERA = Camera(430.0, 430.0, 0.0, 80.0, 60.0, Radial(), 160, 120)
PLACED = RigidTransform.from_rotation_vector([0.3, -2.0, 0.4], [700.0, -200.0, 900.0])
WHOLE = np.s_[0:120, 0:160]
NOISE_MM = 0.1


def seen(depth: Array, noise_mm: float = NOISE_MM) -> RangeImage:
    """A surface of so much noise along its rays, which its sigmas tell."""
    rays = CAMERA.pixel_rays()
    length = np.linalg.norm(rays, axis=-1)
    noise = noise_mm * np.random.default_rng(1).standard_normal(depth.shape)
    return range_image_of(CAMERA, rays * (depth + noise / length)[..., None], sigma_mm=NOISE_MM)


def slanted() -> Array:
    v, u = np.mgrid[:120, :160].astype(float)
    return 320.0 + 0.15 * (u - 80.0) + 0.05 * (v - 60.0)


def test_noise_puts_points_as_far_off_as_expected() -> None:
    """Of 16,000 pixels in windows that overlap the ratio is known to 2 %."""
    found = measure_roughness(seen(slanted()), PLACED, WHOLE, 7.0)
    ratio = float(np.sqrt(np.mean((found.residual_mm / found.expected_mm) ** 2)))
    assert ratio == pytest.approx(1.0, abs=0.04)
    # The fit of a window of 121 follows its middle by a 37th.
    assert np.median(found.expected_mm) == pytest.approx(NOISE_MM * np.sqrt(36.0 / 37.0), rel=0.01)


def test_points_are_told_where_they_lie_in_the_rig_and_only_with_whole_windows() -> None:
    depth = slanted()
    depth[:, 100:] = np.nan
    image = seen(depth)
    found = measure_roughness(image, PLACED, WHOLE, 7.0)
    inner = image.points[5:-5, 5:95].reshape(-1, 3).astype(float)
    placed = PLACED.apply(inner)
    apart = np.linalg.norm(found.points[:, None, :2] - placed[None, ::97, :2], axis=2).min(axis=0)
    assert apart.max() < 1e-3
    assert len(inner) - 1 <= len(found.points) <= 112 * 92


def test_a_bump_shows_by_its_height_along_the_ray() -> None:
    depth = slanted()
    depth[60, 80] += 5.0
    image = seen(depth, 0.0)
    found = measure_roughness(image, PLACED, WHOLE, 7.0)
    # The middle of a window of 11 x 11 follows by a 37th; inverse depths are read where the bump is.
    assert found.residual_mm.max() == pytest.approx(
        5.0 * 325.0 / 320.0 * (1.0 - 1.0 / 37.0), rel=0.01
    )
    flat = measure_roughness(seen(slanted(), 0.0), PLACED, WHOLE, 7.0)
    assert flat.residual_mm.max() < 2e-3  # a slanted plane is nearly one of inverse depths


def test_noise_that_neighbours_share_is_not_expected_between_them() -> None:
    image = seen(slanted())
    shared = replace(image, common_mm=np.full(image.sigma_mm.shape, 0.08, np.float32))
    one, other = (measure_roughness(each, PLACED, WHOLE, 7.0) for each in (image, shared))
    np.testing.assert_allclose(other.expected_mm / one.expected_mm, 0.6, rtol=1e-3)
