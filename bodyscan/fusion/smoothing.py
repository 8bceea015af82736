"""Turn a range image into a smooth surface with normals.

On a plane the inverse depth 1/z is affine in ideal image coordinates, so that a quadratic in pixel
coordinates, fitted around each pixel, follows a curved body closely.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from bodyscan.arrays import Array, Bytes, Floats, Mask, find_crop
from bodyscan.compiled import compiled
from bodyscan.fusion.quadratic_fit import QuadraticFit, fit_quadratics
from bodyscan.geometry.camera import Camera
from bodyscan.geometry.camera_tables import Table, look_up_derivatives, make_projection_table
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.reconstruction.range_image import RangeImage

Numbers = NDArray[np.int32]


@dataclass(frozen=True, eq=False)
class SmoothSurface:
    """A smoothed range image, cropped to what it shows: n points, rig frame.

    corner: (column, row) of the crop's first pixel in the camera's image.
    number: (h, w) int32, of the point that a pixel shows, row by row; -1 where it shows none.
    points, normals: (n, 3) float32, mm, and unit vectors towards the camera.
    sigma_mm: (n,) float32, standard deviation along the normal, of noise that smoothing leaves and
        of everything that pixels share.
    rim, weight: (n,) float32, from near 0 at the rim to 1 well inside, and rim / sigma^2.
    colours: (n, C) uint8: grey, or red, green and blue.
    warped: whether points were moved off the rays of their pixels.
    """

    pair: str
    camera: Camera
    rig_from_camera: RigidTransform
    corner: tuple[int, int]
    number: Numbers
    points: Floats
    normals: Floats
    sigma_mm: Floats
    rim: Floats
    weight: Floats
    colours: Bytes
    warped: bool = False


def smooth(
    image: RangeImage, rig_from_camera: RigidTransform, window_mm: float, *, channels: int = 1
) -> SmoothSurface | None:
    """Fit a quadratic in a square window of about `window_mm` around every pixel; None for an
    image that shows nothing.

    channels: C of its colours, 1 or 3; a grey camera's are then equal.
    """
    box = find_crop(image.valid)
    if box is None:
        return None
    image = image.crop(box)
    inverse, noise = compute_inverse_depths(image)
    pixel_mm = estimate_pixel_size(inverse, image.camera)
    reach = compute_window_reach(pixel_mm, window_mm)
    fit, fitted = fit_quadratics(inverse, noise, reach, pixel_mm, image.correlation_px)
    return _build_surface(image, rig_from_camera, fit, fitted, reach, channels)


def estimate_pixel_size(inverse: Floats, camera: Camera) -> float:
    """Width of a pixel at the median depth, mm; inverse: 1/z, 0 where nothing was measured."""
    rows = inverse[::4]
    return float(np.median(1.0 / rows[rows > 0])) / camera.alpha


def compute_window_reach(pixel_mm: float, window_mm: float) -> int:
    """Pixels to either side of a window's middle."""
    return int(np.clip(round(0.5 * window_mm / pixel_mm), 2, 6))


def _build_surface(
    image: RangeImage,
    rig_from_camera: RigidTransform,
    fit: QuadraticFit,
    fitted: Mask,
    reach: int,
    channels: int,
) -> SmoothSurface:
    depth, number = np.zeros_like(fit.value), np.full(fitted.shape, -1, np.int32)
    size = int(np.count_nonzero(fitted))
    points, normals = np.empty((size, 3), np.float32), np.empty((size, 3), np.float32)
    sigma = np.empty(size, np.float32)
    count = _compute_points(
        (image.points, _compute_common_sigmas(image)),
        (fit.value, fit.slope_u, fit.slope_v, fit.sigma),
        fitted,
        make_projection_table(image.camera),
        (rig_from_camera.rotation, rig_from_camera.translation),
        (depth, number),
        (points, normals, sigma),
    )
    there = number >= 0
    # A jump of 8 pixel widths between neighbours is steeper than any useful surface.
    distance = compute_distance_to_rim(depth, 8.0 / image.camera.alpha)[there]
    rim, sigma = np.minimum(distance / np.float32(2 * reach), np.float32(1.0)), sigma[:count]
    return SmoothSurface(
        image.pair,
        image.camera,
        rig_from_camera,
        image.corner[::-1],
        number,
        points[:count],
        normals[:count],
        sigma,
        rim,
        rim / (sigma * sigma),
        _select_colours(image, there, channels),
        image.warped,
    )


def _select_colours(image: RangeImage, there: Mask, channels: int) -> Bytes:
    """Colours (n, channels) of the pixels `there` (h, w)."""
    if image.rgb is not None and channels == 3:
        return image.rgb[there]
    return np.repeat(image.colours[there][:, None], channels, axis=1)


def compute_distance_to_rim(depth: Floats, jump: float) -> Floats:
    """Distance in pixels, from 1, to the nearest rim.

    A rim is a pixel without depth (0), or one in front of another by `jump` of its depth.
    """
    inner = cv2.dilate(depth, np.ones((3, 3), np.uint8)) < np.float32(1.0 + jump) * depth
    padded = np.pad(inner.astype(np.uint8), 1)
    return cv2.distanceTransform(padded, cv2.DIST_L2, 3)[1:-1, 1:-1] + np.float32(1.0)


def compute_inverse_depths(image: RangeImage) -> tuple[Floats, Floats]:
    """Compute 1/z and its sigma (h, w), less what neighbours have in common of the sigma; 0 where
    nothing was measured."""
    sigma_mm, valid = image.sigma_mm, image.valid
    depth = np.where(valid, image.points[..., 2], np.float32(1.0))
    # A hundredth of sigma is left at least: rounding.
    smallest = np.float32(0.01) * sigma_mm
    variance = np.maximum(sigma_mm**2 - _compute_common_sigmas(image) ** 2, smallest**2)
    # Along the ray a point moves by its length over z times dz.
    length2 = np.einsum("hwc,hwc->hw", image.points, image.points)
    noise = np.sqrt(np.where(valid, variance / length2, np.float32(0.0))) / depth
    return np.where(valid, np.float32(1.0) / depth, np.float32(0.0)), np.asarray(noise, np.float32)


def _compute_common_sigmas(image: RangeImage) -> Floats:
    return np.zeros_like(image.sigma_mm) if image.common_mm is None else image.common_mm


@compiled
def _compute_points(
    measured: tuple[Floats, Floats],
    fit: tuple[Floats, Floats, Floats, Floats],
    fitted: Mask,
    projection: Table,
    rig_from_camera: tuple[Array, Array],
    images: tuple[Floats, Numbers],
    surface: tuple[Floats, Floats, Floats],
) -> int:
    """Fill in depth and number (h, w), and points, normals and sigmas; return how many there are.

    measured: points (h, w, 3), camera frame, and the shared part of their sigmas.
    fit: value, slopes and sigma of 1/z. rig_from_camera: rotation and translation.
    """
    value, slope_u, slope_v, fit_sigma = fit
    measured_points, common_mm = measured
    rotation, translation = rig_from_camera
    depth, number = images
    points, normals, sigma = surface
    n = 0
    for row in range(fitted.shape[0]):
        for column in range(fitted.shape[1]):
            if not fitted[row, column]:
                continue
            inverse, there = value[row, column], measured_points[row, column]
            x, y, z = there[0] / there[2], there[1] / there[2], 1.0 / inverse
            a, b, c = _compute_normal(
                x, y, inverse, slope_u[row, column], slope_v[row, column], projection
            )
            length = np.sqrt(x * x + y * y + 1.0)
            cosine = -(a * x + b * y + c) / length
            if cosine <= 0.17:  # seen at more than 80 degrees
                continue
            depth[row, column], number[row, column] = z, n
            for k in range(3):
                along = rotation[k, 0] * x + rotation[k, 1] * y + rotation[k, 2]
                points[n, k] = along * z + translation[k]
                normals[n, k] = rotation[k, 0] * a + rotation[k, 1] * b + rotation[k, 2] * c
            # Along the ray a point moves by length * dz, along the normal by the cosine of that.
            noise, common = fit_sigma[row, column] * z * z * length, common_mm[row, column]
            sigma[n] = np.sqrt(noise * noise + common * common) * cosine
            n += 1
    return n


@compiled
def _compute_normal(
    x: float, y: float, inverse: float, by_u: float, by_v: float, projection: Table
) -> tuple[float, float, float]:
    """Unit normal towards the camera, camera frame, from the slopes of 1/z per pixel. A plane n.P = d
    has 1/z = n.(x, y, 1) / d in ideal normalised coordinates; the derivative of the projection converts
    the slopes."""
    u_by_x, u_by_y, v_by_x, v_by_y = look_up_derivatives(projection, x, y)
    slope_x = by_u * u_by_x + by_v * v_by_x
    slope_y = by_u * u_by_y + by_v * v_by_y
    rest = inverse - x * slope_x - y * slope_y
    # n.P has the sign of d * (1/d), so n points away from the camera: flip it.
    shrink = -1.0 / np.sqrt(slope_x * slope_x + slope_y * slope_y + rest * rest)
    return slope_x * shrink, slope_y * shrink, rest * shrink
