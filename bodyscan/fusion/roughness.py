"""How rough a measured surface is, compared with the noise that its sigmas predict."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bodyscan.arrays import Array, Crop, Floats, crop_bounds
from bodyscan.fusion.quadratic_fit import fit_full_windows, window_basis
from bodyscan.fusion.smoothing import inverse_depths, pixel_size, window_reach
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.reconstruction.range_image import RangeImage


@dataclass(frozen=True, eq=False)
class Misfits:
    """Misfits of N pixels that have a whole window around them.

    points: (N, 3) mm, rig frame.
    misfit_mm: distance along the ray from the smooth surface through the window, (N,).
    expected_mm: its standard deviation by noise, (N,).
    """

    points: Array
    misfit_mm: Floats
    expected_mm: Floats


def misfits(
    image: RangeImage, rig_from_camera: RigidTransform, box: Crop, window_mm: float
) -> Misfits:
    """Misfits of the pixels in a box to the quadratic in a window of about `window_mm`."""
    sigma_mm, points = image.sigma_mm[box], image.points[box]
    common = np.zeros_like(sigma_mm) if image.common_mm is None else image.common_mm[box]
    whole = (slice(0, sigma_mm.shape[0]), slice(0, sigma_mm.shape[1]))
    inverse, noise = inverse_depths(points, sigma_mm, common, crop_bounds(whole))
    reach = window_reach(pixel_size(inverse, image.camera), window_mm)
    fit, full = fit_full_windows(inverse, noise, reach)
    off = (inverse - fit.value)[full]
    seen = points[full]
    # Along the ray a point moves by its length over z times dz, and dz is z squared times d(1/z).
    length = np.linalg.norm(seen, axis=1) * seen[:, 2]
    basis = window_basis(reach)
    own_share = np.linalg.inv(basis.T @ basis)[0, 0]
    left = np.float32(np.sqrt(1.0 - own_share))  # share of its own noise left in a misfit
    placed = rig_from_camera.apply(seen.astype(np.float64))
    return Misfits(placed, np.abs(off) * length, left * noise[full] * length)
