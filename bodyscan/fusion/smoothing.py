"""A range image becomes a smooth surface with normals.

On a plane the inverse depth 1/z is affine in ideal image coordinates, so that a quadratic in the
pixel coordinates, fitted around each pixel, follows a curved body closely.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from bodyscan.fusion.grid import Floats, carried, crop_of, rotated
from bodyscan.fusion.quadratics import Fit, Mask, fit_quadratics
from bodyscan.geometry.camera import Camera
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.reconstruction.range_image import RangeImage

JUMP_PX = 8.0  # in depth between neighbours, in widths of a pixel: steeper than STEEPEST_COSINE
STEEPEST_COSINE = 0.17  # a surface seen at more than 80 degrees is not worth having


@dataclass(frozen=True, eq=False)
class Surface:
    """A smoothed range image, cropped to what it shows, rig frame.

    corner: (column, row) of the crop's first pixel in the camera's image.
    points, normals: (h, w, 3) float32, mm, unit and towards the camera; NaN where there is nothing.
    sigma_mm: (h, w) float32, standard deviation of the smoothed point along its normal.
    rim: (h, w) float32, rises from 0 at the rim to 1 well inside; 0 where there is nothing.
    weight: (h, w) float32, rim/sigma^2.
    colours: (h, w) uint8.
    """

    pair: str
    camera: Camera
    rig_from_camera: RigidTransform
    corner: tuple[int, int]
    points: Floats
    normals: Floats
    sigma_mm: Floats
    rim: Floats
    weight: Floats
    colours: NDArray[np.uint8]


@dataclass(frozen=True, eq=False)
class Rays:
    """Ideal normalized coordinates (h, w) of pixels: directions (x, y, 1)."""

    x: Floats
    y: Floats

    @property
    def length(self) -> Floats:
        return np.sqrt(self.x * self.x + self.y * self.y + 1.0)


def smooth(
    image: RangeImage, rig_from_camera: RigidTransform, *, window_mm: float = 7.0
) -> Surface | None:
    """Fit a quadratic in a square window of about `window_mm` around every pixel.

    None if the range image shows nothing.
    """
    box = crop_of(image.valid)
    if box is None:
        return None
    x, y, depth = cv2.split(image.points[box])
    valid = np.isfinite(image.sigma_mm[box])
    pixel_mm = float(np.median(depth[valid])) / image.camera.alpha
    reach = int(np.clip(round(0.5 * window_mm / pixel_mm), 2, 6))
    with np.errstate(invalid="ignore"):
        inverse = np.where(valid, 1.0 / depth, np.float32(0.0))
        rays = Rays(x * inverse, y * inverse)
        noise = image.sigma_mm[box] * inverse * inverse / rays.length
    noise[~valid] = 0.0

    fit, fitted = fit_quadratics(inverse, noise, valid, reach, pixel_mm)
    return _surface(image, rig_from_camera, box, rays, fit, fitted, reach)


def _surface(
    image: RangeImage,
    rig_from_camera: RigidTransform,
    box: tuple[slice, slice],
    rays: Rays,
    fit: Fit,
    fitted: Mask,
    reach: int,
) -> Surface:
    x, y, length = rays.x, rays.y, rays.length
    with np.errstate(invalid="ignore", divide="ignore"):
        depth = 1.0 / fit.value
        normals = normals_of(image.camera, rays, fit)
        cosine = -(normals[..., 0] * x + normals[..., 1] * y + normals[..., 2]) / length
        fitted = fitted & (cosine > STEEPEST_COSINE)
        # Along the ray a point moves by length * dz; along the normal by its cosine's share.
        sigma = fit.sigma * depth * depth * length * cosine
        rim = (
            np.minimum(
                _distance_to_rim(fitted, depth, JUMP_PX / image.camera.alpha) / (2.0 * reach), 1.0
            )
            * fitted
        )
        weight = np.where(fitted, rim / (sigma * sigma), np.float32(0.0))
    smoothed = cv2.merge([x * depth, y * depth, depth])
    hidden = ~fitted
    smoothed[hidden], normals[hidden], sigma[hidden] = np.nan, np.nan, np.nan
    return Surface(
        image.pair,
        image.camera,
        rig_from_camera,
        (box[1].start, box[0].start),
        carried(smoothed, rig_from_camera),
        rotated(normals, rig_from_camera),
        sigma,
        rim,
        weight,
        image.colours[box],
    )


def normals_of(camera: Camera, rays: Rays, fit: Fit) -> Floats:
    """(h, w, 3) unit normals towards the camera, camera frame, from the slopes of 1/z.

    A plane n.P = d has 1/z = n.(x, y, 1) / d in ideal normalized coordinates; the slopes per
    pixel are carried there by the lens's derivative (Eq. 3-5) times A.
    """
    x, y = rays.x, rays.y
    r2 = x * x + y * y
    scale = 1.0 + r2 * (camera.k1 + r2 * camera.k2)
    growth = 2.0 * camera.k1 + 4.0 * camera.k2 * r2
    # Slopes per distorted normalized coordinate, then per ideal one.
    real_x = camera.alpha * fit.slope_u
    real_y = camera.gamma * fit.slope_u + camera.beta * fit.slope_v
    outward = growth * (x * real_x + y * real_y)
    slope_x, slope_y = scale * real_x + outward * x, scale * real_y + outward * y
    rest = fit.value - x * slope_x - y * slope_y
    # n.P has the sign of d * (1/d), so n looks away from the camera: turn it round.
    size = -np.sqrt(slope_x**2 + slope_y**2 + rest**2)
    return cv2.merge([slope_x / size, slope_y / size, rest / size])


def _distance_to_rim(fitted: Mask, depth: Floats, jump: float) -> Floats:
    """Pixels to the nearest one that has no fit or lies `jump` of its depth in front of another."""
    kernel = np.ones((3, 3), np.uint8)
    known = np.where(fitted, depth, 0.0)
    inner = fitted & (cv2.dilate(known, kernel) < (1.0 + jump) * known)
    padded = np.pad(inner.astype(np.uint8), 1)
    return cv2.distanceTransform(padded, cv2.DIST_L2, 3)[1:-1, 1:-1] + fitted
