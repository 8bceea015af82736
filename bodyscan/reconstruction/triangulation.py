"""Stripe map to range image (2.3): a pixel's ray meets the light sheet of its stripe coordinate."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from bodyscan.calibration.pair import PairCalibration
from bodyscan.capture.views import StripeMap
from bodyscan.errors import BadInput
from bodyscan.geometry.measuring import measure
from bodyscan.reconstruction.range_image import RangeImage

NORMAL_WINDOW_PX = 5


def range_image(pair: PairCalibration, stripes: StripeMap) -> RangeImage:
    """Points, normals and sigma on the camera's pixel grid, camera frame, mm.

    Raises BadInput if the pair has no projector or the image size is another.
    """
    camera = pair.camera
    if pair.light is None:
        raise BadInput("this pair has no projector, it cannot scan", where=f"pair {pair.name}")
    if stripes.s.shape != (camera.height, camera.width):
        height, width = stripes.s.shape
        raise BadInput(
            f"images of {width} x {height} px, but the pair was calibrated with "
            f"{camera.width} x {camera.height} px",
            where=f"pair {pair.name}",
            remedy="scan with the camera settings of the calibration, or calibrate again",
        )
    rows, columns = np.nonzero(np.isfinite(stripes.s))
    rays = camera.rays(np.column_stack([columns, rows]).astype(np.float64))
    s = stripes.s[rows, columns].astype(np.float64)
    measured = measure(pair.light, rays, s)
    depth = measured.depth
    decoding = (measured.per_stripe * stripes.sigma[rows, columns]) ** 2
    sigma = np.sqrt(decoding + measured.variance_mm2) * np.linalg.norm(rays, axis=1)
    points = np.full((camera.height, camera.width, 3), np.nan, np.float32)
    sigmas = np.full((camera.height, camera.width), np.nan, np.float32)
    known = np.isfinite(depth) & np.isfinite(sigma)
    points[rows[known], columns[known]] = (rays * depth[:, None])[known]
    sigmas[rows[known], columns[known]] = sigma[known]
    return RangeImage(pair.name, camera, points, grid_normals(points), sigmas, stripes.lit)


def grid_normals(points: NDArray[np.float32]) -> NDArray[np.float32]:
    """Unit normals (H, W, 3) towards the camera, from the points (H, W, 3) of a small window.

    A plane fitted to 1/z, which is affine in the image coordinates on a plane; NaN where the
    window holds too few points.
    """
    known = np.isfinite(points[..., 2])
    z = np.where(known, points[..., 2], 1.0)
    x, y = (np.where(known, points[..., k] / z, 0.0) for k in (0, 1))
    inverse = np.where(known, 1000.0 / z, 0.0)
    weight = known.astype(np.float32)

    def mean(image: NDArray[np.float32]) -> NDArray[np.float64]:
        window = (NORMAL_WINDOW_PX, NORMAL_WINDOW_PX)
        return cv2.boxFilter(image.astype(np.float64), cv2.CV_64F, window)

    count = np.maximum(mean(weight), 1e-12)
    mx, my, mi = mean(x) / count, mean(y) / count, mean(inverse) / count
    xx, yy, xy = (
        mean(x * x) / count - mx * mx,
        mean(y * y) / count - my * my,
        mean(x * y) / count - mx * my,
    )
    xi, yi = mean(x * inverse) / count - mx * mi, mean(y * inverse) / count - my * mi
    determinant = xx * yy - xy * xy
    enough = known & (determinant > 1e-4 * xx * yy) & (count > 0.4)
    determinant = np.where(enough, determinant, 1.0)
    slope_x, slope_y = (xi * yy - yi * xy) / determinant, (yi * xx - xi * xy) / determinant
    # 1/z = p x + q y + r is the plane p X + q Y + r Z = 1, whose normal (p, q, r) points away.
    normal = -np.stack([slope_x, slope_y, mi - slope_x * mx - slope_y * my], axis=-1)
    normal /= np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-30)
    return np.where(enough[..., None], normal, np.nan).astype(np.float32)
