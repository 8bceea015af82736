"""Parts of a picture, what lies in it, how well its rays are known and how stripes lie over them."""

from __future__ import annotations

import numpy as np
import pytest

from bodyscan.arrays import find_crop, pad_crop
from bodyscan.geometry.camera import Camera
from bodyscan.geometry.camera_tables import is_in_image
from bodyscan.geometry.lenses.opencv import Radial
from bodyscan.geometry.light_planes import LightPlanes
from bodyscan.geometry.light_sheets import intersect_rays, measure_stripes_per_pixel
from bodyscan.geometry.uncertainty import (
    COLUMNS,
    ROWS,
    PoseCovariance,
    RayUncertainty,
    compute_position_sigma,
    list_node_pixels,
    point_covariance,
)
from bodyscan.reconstruction.range_image import RangeImage

PLAIN = Camera(500.0, 510.0, 0.0, 159.5, 119.5, Radial(0.0, 0.0), 320, 240)
BARREL = Camera(300.0, 300.0, 0.0, 159.5, 119.5, Radial(-0.3, 0.0), 320, 240)


def test_a_crop_is_the_smallest_box_and_grows_no_farther_than_the_first_row() -> None:
    shown = np.zeros((9, 12), bool)
    shown[3, 5] = shown[6, 2] = True
    crop = find_crop(shown)
    assert crop == (slice(3, 7), slice(2, 6))
    assert pad_crop(crop, 1) == (slice(2, 8), slice(1, 7))
    assert pad_crop(crop, 5) == (slice(0, 12), slice(0, 11))
    assert find_crop(np.zeros((4, 4), bool)) is None


def at(camera: Camera, *pixels: tuple[float, float]) -> np.ndarray:
    return 800.0 * camera.rays(np.array(pixels))


def test_what_is_seen_lies_ahead_between_the_first_pixel_and_the_last() -> None:
    just_in = at(PLAIN, (0.001, 0.001), (318.999, 238.999), (160.0, 0.001), (0.001, 120.0))
    just_out = at(PLAIN, (-0.001, 5), (5, -0.001), (319.001, 5), (5, 239.001))
    assert is_in_image(PLAIN, just_in).all()
    assert not is_in_image(PLAIN, just_out).any()
    assert not is_in_image(PLAIN, -just_in).any()
    assert not is_in_image(PLAIN, np.array([[0.0, 0.0, 0.0]])).any()
    assert is_in_image(PLAIN, just_in.reshape(2, 2, 3)).shape == (2, 2)


def test_where_a_lens_folds_back_into_the_picture_nothing_is_seen() -> None:
    fold = BARREL.lens.fold_radius
    beyond = np.array([[1.6 * fold, 0.0, 1.0], [0.0, 1.65 * fold, 1.0], [-1.6 * fold, 0.1, 1.0]])
    u, v = BARREL.project(beyond).T
    assert np.all((u > 0) & (u < 319) & (v > 0) & (v < 239)), "they fall into the picture"
    assert not is_in_image(BARREL, beyond).any()
    assert is_in_image(BARREL, at(BARREL, (1.0, 1.0), (318.0, 238.0))).all()


def test_rays_are_known_between_nodes_as_linearly_as_at_them() -> None:
    places = list_node_pixels(320, 240)
    assert places.shape == (ROWS, COLUMNS, 2)
    assert places[0, 0].tolist() == [0.0, 0.0]
    assert places[-1, -1].tolist() == [319.0, 239.0]
    assert places[0, -1].tolist() == [319.0, 0.0]
    rising = 0.3 + 1e-3 * places[..., 0] + 2e-3 * places[..., 1]
    known = RayUncertainty(0.6 * rising, 0.8 * rising)
    np.testing.assert_allclose(known.sigma_px, rising)
    image = known.image(320, 240)
    v, u = np.indices((240, 320))
    # OpenCV interpolates in 1/32 of a node's distance, 16 px: 0.25 px on either side.
    np.testing.assert_allclose(image, 0.3 + 1e-3 * u + 2e-3 * v, atol=1e-3)
    excess = known.inflate_noise(4.0)
    np.testing.assert_allclose(excess.noise_px, 1.2 * rising)
    np.testing.assert_allclose(excess.lens_px, 0.8 * rising)


def test_covariances_of_pairs_are_those_of_motions_drawn_from_them() -> None:
    rng = np.random.default_rng(0)
    mixed = rng.normal(size=(18, 18)) * np.tile([1e-3] * 3 + [1.0] * 3, 3)[:, None]
    names = ("a", "b", "c")
    covariance = PoseCovariance(names, mixed @ mixed.T)
    drawn = (rng.normal(size=(20000, 18)) @ mixed.T).reshape(-1, 3, 6)
    point = np.array([300.0, -200.0, 1000.0])
    moved = np.cross(drawn[..., :3], point) + drawn[..., 3:]

    def close(found: np.ndarray, samples: np.ndarray) -> None:
        expected = np.cov(samples.T)
        size = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
        # 20,000 draws: correlations are known to 0.007 or better, variances to 1 %.
        assert np.abs((found - expected) / size).max() < 0.05

    close(covariance.marginal("b"), drawn[:, 1])
    close(covariance.select(["c", "a"]), drawn[:, [2, 0]].reshape(-1, 12))
    close(covariance.relative("c", "a"), drawn[:, 0] - drawn[:, 2])
    close(covariance.relative("a", "b"), drawn[:, 1] - drawn[:, 0])
    close(point_covariance(covariance.marginal("c"), point), moved[:, 2])
    np.testing.assert_allclose(
        compute_position_sigma(covariance, "b", point), moved[:, 1].std(axis=0), rtol=0.03
    )


@pytest.mark.parametrize("name", ["a", "b", "c"])
def test_a_pair_does_not_move_against_itself(name: str) -> None:
    mixed = np.random.default_rng(1).normal(size=(18, 18))
    covariance = PoseCovariance(("a", "b", "c"), mixed @ mixed.T)
    np.testing.assert_allclose(covariance.relative(name, name), 0.0, atol=1e-12)


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


def flat_wall() -> tuple[np.ndarray, np.ndarray]:
    """s of every pixel, and its point."""
    points = 800.0 * CAMERA.pixel_rays()
    s = 40.0 + (points[..., 0] - BASELINE) / 800.0 / APART
    s[(s < 1.0) | (s > 79.0)] = np.nan
    return s.astype(np.float32), points.astype(np.float32)


def test_at_one_depth_s_changes_from_pixel_to_pixel_by_their_angle_over_the_sheets() -> None:
    s, _ = flat_wall()
    # A pixel is 1/400, a stripe 1/100 of the depth; down the columns nothing changes. Along a sheet
    # depth changes by 8 mm of 800 to the next pixel: that is no longer linear by a hundredth.
    assert measure_stripes_per_pixel(sheets(), CAMERA, s) == pytest.approx(0.25, rel=0.02)
    assert measure_stripes_per_pixel(sheets(), CAMERA, np.full_like(s, np.nan)) == 0.0


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
