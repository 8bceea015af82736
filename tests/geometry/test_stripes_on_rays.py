"""How stripes lie over a picture's rays: per pixel, and beside their sheets."""

from __future__ import annotations

import numpy as np
import pytest

from bodyscan.geometry.camera import Camera
from bodyscan.geometry.lenses.opencv import Radial
from bodyscan.geometry.light_planes import LightPlanes
from bodyscan.geometry.light_sheets import (
    intersect_rays,
    stripes_per_pixel,
)
from bodyscan.reconstruction.range_image import RangeImage

CAMERA = Camera(400.0, 400.0, 0.0, 79.5, 59.5, Radial(), 160, 120)
APART, BASELINE = 0.01, 200.0


def sheets() -> LightPlanes:
    """From (BASELINE, 0, 0): stripe i goes where (x - BASELINE) / z is APART (i - 40)."""
    slope = APART * (np.arange(81) - 40.0)
    normals = np.column_stack([np.ones(81), np.zeros(81), -slope])
    planes = np.column_stack([normals, np.full(81, -BASELINE)])
    planes /= np.linalg.norm(normals, axis=1)[:, None]
    planes *= np.where(planes[:, 3:] < 0.0, -1.0, 1.0)
    return LightPlanes(planes, np.full((81, 4, 4), 1e-12), "vertical")


def flat_wall(depth: float = 800.0) -> tuple[np.ndarray, np.ndarray]:
    """s of every pixel, and its point."""
    points = depth * CAMERA.pixel_rays()
    s = 40.0 + (points[..., 0] - BASELINE) / depth / APART
    s[(s < 1.0) | (s > 79.0)] = np.nan
    return s.astype(np.float32), points.astype(np.float32)


def test_at_one_depth_s_changes_from_pixel_to_pixel_by_their_angle_over_the_sheets() -> None:
    s, _ = flat_wall()
    # A pixel is 1/400, a stripe 1/100 of the depth; down the columns nothing changes. Along a sheet
    # depth changes by 8 mm of 800 to the next pixel: that is no longer linear by a hundredth.
    assert stripes_per_pixel(sheets(), CAMERA, s) == pytest.approx(0.25, rel=0.02)
    assert stripes_per_pixel(sheets(), CAMERA, np.full_like(s, np.nan)) == 0.0


def test_rays_meet_their_sheets_and_depth_changes_with_s() -> None:
    s, _ = flat_wall()
    known = np.isfinite(s)
    found = intersect_rays(sheets(), CAMERA.pixel_rays()[known], s[known].astype(float))
    np.testing.assert_allclose(found.depth, 800.0, rtol=1e-4)
    # z (tan - APART (s - 40)) = B: by APART z^2 / B; planes between two change as chords do.
    np.testing.assert_allclose(
        found.per_stripe, APART * 800.0**2 / BASELINE * np.sign(found.per_stripe), rtol=5e-3
    )
    assert len(set(np.sign(found.per_stripe).tolist())) == 1


def test_a_part_of_a_range_image_knows_where_in_the_picture_it_is() -> None:
    shape = (7, 5)
    grey = np.zeros(shape, np.uint8)
    none = np.zeros((*shape, 3), np.float32)
    image = RangeImage("p", CAMERA, none, none, np.ones(shape, np.float32), grey, corner=(20, 30))
    assert image.part == (slice(20, 27), slice(30, 35))
