"""Quadratic fits on the pixel grid, on planes, spheres and steps whose truth is known exactly."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from ball import range_image_of
from hypothesis import given, settings
from hypothesis import strategies as st

from bodyscan.fusion.smoothing import SmoothSurface, smooth
from bodyscan.geometry.camera import Camera
from bodyscan.geometry.lenses.opencv import Radial
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.reconstruction.range_image import RangeImage
from bodyscan.settings import FusionSettings

CAMERA = Camera(430.0, 428.0, 0.7, 161.0, 118.0, Radial(-0.12, 0.08), 320, 240)
DISTANCE = 320.0  # a pixel is 0.75 mm wide there, as in the real rigs
WINDOW_MM = FusionSettings().window_mm
RAYS = CAMERA.pixel_rays()
POSE = RigidTransform.from_rotation_vector([0.3, -2.0, 0.4], [700.0, -200.0, 900.0])


def image_of(depth: np.ndarray, noise_mm: float = 0.0) -> RangeImage:
    """Of depths (h, w), NaN where nothing is; noise along the ray, which sigma_mm tells."""
    length = np.linalg.norm(RAYS, axis=-1)
    noise = noise_mm * np.random.default_rng(0).normal(size=depth.shape)
    points = RAYS * (depth + noise / length)[..., None]
    return range_image_of(CAMERA, points, sigma_mm=max(noise_mm, 0.05), grey=128)


def plane_depth(normal: np.ndarray) -> np.ndarray:
    """Of the plane through (0, 0, DISTANCE)."""
    return DISTANCE * normal[2] / (RAYS @ normal)


def sphere_depth(radius: float) -> np.ndarray:
    """Of a sphere whose nearest point is at DISTANCE on the axis; NaN beside it."""
    centre = np.array([0.0, 0.0, DISTANCE + radius])
    a, b = np.sum(RAYS**2, axis=-1), RAYS @ centre
    inside = b * b - a * (centre @ centre - radius**2)
    return np.where(inside > 0, (b - np.sqrt(np.maximum(inside, 0))) / a, np.nan)


def smoothed(image: RangeImage) -> tuple[SmoothSurface, np.ndarray, np.ndarray]:
    """With points and normals in the camera frame, (N, 3)."""
    surface = smooth(image, POSE, WINDOW_MM)
    assert surface is not None
    camera_from_rig = POSE.inverse()
    points = camera_from_rig.apply(surface.points.astype(float))
    return surface, points, camera_from_rig.rotate(surface.normals.astype(float))


def on_pixels(surface: SmoothSurface, values: np.ndarray) -> np.ndarray:
    """(h, w) of the whole image: a value for each of the surface's points, NaN elsewhere."""
    (column, row), (height, width) = surface.corner, surface.number.shape
    image = np.full((CAMERA.height, CAMERA.width), np.nan)
    box = image[row : row + height, column : column + width]
    box[surface.number >= 0] = values[surface.number[surface.number >= 0]]
    return image


@settings(max_examples=10, deadline=None)
@given(tilt_x=st.floats(-1.0, 1.0), tilt_y=st.floats(-1.0, 1.0))
def test_a_plane_stays_exactly_itself(tilt_x: float, tilt_y: float) -> None:
    """Through lens distortion and skew: the inverse depth of a plane is what the fit is made for. Not
    quite affine in pixels, since the lens bends them; the quadratic takes up most of that."""
    normal = np.array([tilt_x, tilt_y, 1.0]) / np.linalg.norm([tilt_x, tilt_y, 1.0])
    _, points, normals = smoothed(image_of(plane_depth(normal)))
    distance = (points - [0.0, 0.0, DISTANCE]) @ normal
    assert np.abs(distance).max() < 1e-3  # float32 at a metre, and the lens over 9 pixels
    assert np.abs(normals + normal).max() < 1e-3


@pytest.mark.parametrize(("radius", "bias_mm"), [(150.0, 0.003), (50.0, 0.006), (15.0, 0.065)])
def test_curved_surfaces_are_not_flattened(radius: float, bias_mm: float) -> None:
    """A plane fit over 7 mm would be 4 mm^2 / radius off: 0.03, 0.08 and 0.3 mm."""
    _, points, normals = smoothed(image_of(sphere_depth(radius)))
    outward = points - [0.0, 0.0, DISTANCE + radius]
    off = np.linalg.norm(outward, axis=1) - radius
    facing = outward[:, 2] < -0.7 * radius  # not the rim, where the sphere turns away
    assert np.count_nonzero(facing) > 300
    assert np.abs(off[facing]).max() < bias_mm
    cosine = np.sum(normals * outward, axis=1) / np.linalg.norm(outward, axis=1)
    # A slope is off by what the quadratic leaves out, which goes with (window / radius)^2, more so
    # where the surface runs askew; 0.1 degrees for float32.
    angle = np.degrees(np.arccos(cosine[facing].clip(-1.0, 1.0)))
    assert angle.max() < 150.0 * (3.5 / radius) ** 2 + 0.1


def test_noise_goes_down_as_sigma_says() -> None:
    noise_mm, normal = 0.3, np.array([0.3, -0.5, 0.8]) / np.linalg.norm([0.3, -0.5, 0.8])
    surface, points, _ = smoothed(image_of(plane_depth(normal), noise_mm))
    distance = (points - [0.0, 0.0, DISTANCE]) @ normal
    sigma = surface.sigma_mm
    # A quadratic over 9 x 9 pixels leaves 1/4 of the noise, and the tilt takes its share.
    assert np.std(distance) < 0.3 * noise_mm
    assert abs(np.mean(distance)) < 0.01
    # About 800 independent windows: their standard deviation is known to 3 %.
    assert 0.9 < np.std(distance / sigma) < 1.15


@pytest.mark.parametrize("along", [0, 1])
def test_noise_that_neighbours_share_along_a_line_goes_down_less_and_sigma_says_so(
    along: int,
) -> None:
    """Means of five pixels: their correlation falls linearly to nothing over five."""
    rng, noise = np.random.default_rng(8), 0.05
    white = rng.normal(size=(244, 324))
    mean = sum(np.roll(white, k, axis=along) for k in range(5)) / np.sqrt(5.0)
    image = image_of(plane_depth(np.array([0.0, 0.0, -1.0])))
    off = noise * mean[:240, :320] / np.linalg.norm(RAYS, axis=-1)
    points = image.points + (RAYS * off[..., None]).astype(np.float32)
    alike = (0.0, 5.0) if along == 0 else (5.0, 0.0)
    shared = replace(image, points=points, correlation_px=alike)
    surface, own = (smooth(one, POSE, WINDOW_MM) for one in (shared, replace(image, points=points)))
    assert surface is not None
    assert own is not None
    back = POSE.inverse().apply(surface.points.astype(float))[:, 2] - DISTANCE
    whole = surface.rim == 1.0
    ratios = [np.std((back / one.sigma_mm)[whole]) for one in (surface, own)]
    assert ratios[0] == pytest.approx(1.0, abs=0.06)
    assert ratios[1] > 1.5


def test_sigmas_that_promise_too_much_are_corrected() -> None:
    depth = plane_depth(np.array([0.0, 0.0, 1.0]))
    honest, boastful = image_of(depth, 0.3), image_of(depth, 0.3)
    boastful.sigma_mm[:] /= 4.0
    one, other = smooth(honest, POSE, WINDOW_MM), smooth(boastful, POSE, WINDOW_MM)
    assert one is not None
    assert other is not None
    np.testing.assert_allclose(np.median(other.sigma_mm), np.median(one.sigma_mm), rtol=0.03)


def test_a_step_stays_sharp() -> None:
    """Two planes 12 mm apart meet along a column: neither bends towards the other."""
    depth = np.full(CAMERA.pixel_rays().shape[:2], DISTANCE)
    depth[:, 160:] += 12.0
    surface, points, _ = smoothed(image_of(depth, 0.1))
    off = np.abs(on_pixels(surface, points[:, 2]) - depth)
    # One-sided windows keep 0.1 mm noise below 0.1; a bend would show as millimetres.
    assert np.nanmax(off) < 0.3
    assert np.isfinite(off[:, 155:165]).mean() > 0.95
    # Points at the jump count less than those well inside.
    weight = np.nanmedian(on_pixels(surface, surface.weight), axis=0)
    assert weight[159] < 0.4 * weight[100]
    assert weight[160] < 0.4 * weight[220]


def test_wild_points_are_left_out() -> None:
    depth = plane_depth(np.array([0.2, 0.1, 1.0]) / np.linalg.norm([0.2, 0.1, 1.0]))
    rng = np.random.default_rng(3)
    wild = rng.random(depth.shape) < 0.02
    image = image_of(np.where(wild, depth + rng.uniform(2.0, 10.0, depth.shape), depth), 0.1)
    surface, points, _ = smoothed(image)
    off = np.abs(on_pixels(surface, points[:, 2]) - depth)
    # 0.4 mm are four of the pixels' own sigmas, sixteen of the fits'.
    assert np.mean(off[~wild & np.isfinite(off)] > 0.4) < 1e-4
    assert np.isnan(off[wild]).mean() > 0.9


def test_small_holes_do_no_harm() -> None:
    depth = sphere_depth(60.0)
    holes = np.random.default_rng(4).random(depth.shape) < 0.03
    surface, points, _ = smoothed(image_of(np.where(holes, np.nan, depth)))
    outward = points - [0.0, 0.0, DISTANCE + 60.0]
    off = np.linalg.norm(outward, axis=1) - 60.0
    facing = outward[:, 2] < -0.7 * 60.0
    # Values put into the holes are off by their curvature, 0.02 mm, and weigh a few per cent.
    assert np.abs(off[facing]).max() < 0.01
    assert np.isnan(on_pixels(surface, surface.weight)[holes]).all()


def test_points_are_numbered_row_by_row() -> None:
    surface, points, _ = smoothed(image_of(sphere_depth(60.0)))
    there = surface.number >= 0
    assert (surface.number[there] == np.arange(len(points))).all()
    rows, columns = np.nonzero(there)
    seen = CAMERA.project(points) - surface.corner
    # Points move along their pixels' rays: float32 at half a metre over a pixel of 0.75 mm.
    np.testing.assert_allclose(seen, np.stack([columns, rows], axis=-1), atol=1e-3)


def test_an_image_of_nothing_gives_nothing() -> None:
    assert smooth(image_of(np.full((240, 320), np.nan)), POSE, WINDOW_MM) is None


def test_what_neighbours_share_does_not_shrink() -> None:
    """A calibration that puts a whole surface 0.2 mm off does so after smoothing too."""
    alone = image_of(plane_depth(np.array([0.0, 0.0, 1.0])), noise_mm=0.1)
    common = np.full(alone.sigma_mm.shape, 0.2, np.float32)
    shared = replace(alone, sigma_mm=np.hypot(alone.sigma_mm, common), common_mm=common)
    less, more = smoothed(alone)[0], smoothed(shared)[0]
    middle = less.rim == 1.0
    # 25 pixels and more take part: a third of their noise is left, and less.
    assert np.all(less.sigma_mm[middle] < 0.04)
    cosine = np.abs(np.sum(POSE.rotate(_directions(more)) * more.normals, axis=1))
    expected = np.hypot(less.sigma_mm, 0.2 * cosine)
    assert np.allclose(more.sigma_mm[middle], expected[middle], rtol=0.02)
    assert np.array_equal(more.points, less.points)


def _directions(surface: SmoothSurface) -> np.ndarray:
    """(N, 3) unit, camera frame, of the pixels that show its points."""
    left, top = surface.corner
    rows, columns = np.nonzero(surface.number >= 0)
    rays = RAYS[rows + top, columns + left]
    return np.asarray(rays / np.linalg.norm(rays, axis=1, keepdims=True))
