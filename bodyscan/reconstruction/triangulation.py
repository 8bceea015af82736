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
    window is not whole: what lies at a rim is not to be relied on.
    """
    x, y, z = cv2.split(points)
    known = np.isfinite(z)
    window = np.ones((NORMAL_WINDOW_PX, NORMAL_WINDOW_PX), np.uint8)
    whole = cv2.erode(known.astype(np.uint8), window, borderValue=0) > 0
    z[~known] = np.inf
    inverse = np.float32(1000.0) / z
    x, y = (np.where(known, values / z, np.float32(0.0)) for values in (x, y))
    (i_u, i_v), (x_u, x_v), (y_u, y_v) = (_slopes(values) for values in (inverse, x, y))
    # From slopes by column and row to slopes by x and y.
    with np.errstate(divide="ignore", invalid="ignore"):
        determinant = x_u * y_v - x_v * y_u
        slope_x = (i_u * y_v - i_v * y_u) / determinant
        slope_y = (i_v * x_u - i_u * x_v) / determinant
        # 1/z = p x + q y + r is the plane p X + q Y + r Z = 1, whose normal (p, q, r) points away.
        rest = inverse - slope_x * x - slope_y * y
        size = -np.sqrt(slope_x * slope_x + slope_y * slope_y + rest * rest)
        size[~whole] = np.nan
        return cv2.merge([slope_x / size, slope_y / size, rest / size])


def _slopes(values: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Slopes per column and per row of planes fitted in whole windows."""
    reach = NORMAL_WINDOW_PX // 2
    offsets = np.arange(-reach, reach + 1.0)
    ramp, one = offsets / (NORMAL_WINDOW_PX * np.sum(offsets**2)), np.ones(NORMAL_WINDOW_PX)
    along = {"ddepth": cv2.CV_32F, "borderType": cv2.BORDER_CONSTANT}
    return (
        cv2.sepFilter2D(values, kernelX=ramp, kernelY=one, **along),
        cv2.sepFilter2D(values, kernelX=one, kernelY=ramp, **along),
    )
