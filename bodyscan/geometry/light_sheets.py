"""Light sheets of any kind: as arrays for files, and the depths at which rays meet them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from bodyscan.arrays import Array, Floats
from bodyscan.geometry.bowed_sheets import BOW_DEGREE, PLANE_DEGREE, BowedSheets
from bodyscan.geometry.camera import Camera
from bodyscan.geometry.camera_tables import look_up_rays, make_ray_table
from bodyscan.geometry.lens_sheets import LensSheets
from bodyscan.geometry.light_planes import Axis, LightPlanes, LightSheets, RayDepths, SmoothSheets
from bodyscan.geometry.transforms import RigidTransform


def sheets_to_arrays(sheets: LightSheets) -> dict[str, Array]:
    """Arrays that, with `sheets.kind` and `sheets.direction`, describe the sheets completely."""
    if isinstance(sheets, LightPlanes):
        return {"planes": sheets.coefficients, "covariance": sheets.covariance}
    if isinstance(sheets, SmoothSheets):
        return {
            "projector_from_camera": sheets.projector_from_camera.matrix,
            "middle": sheets.middle,
            "stripes": np.array(float(sheets.stripes)),
            "parameters": sheets.parameters,
            "covariance": sheets.covariance,
        }
    raise TypeError(f"no light sheets: {type(sheets).__name__}")


def sheets_from_arrays(kind: str, arrays: Mapping[str, Any], direction: Axis) -> LightSheets:
    """Rebuild the sheets from what `sheets_to_arrays` returned.

    Raises ValueError for an unknown kind or arrays of the wrong size, KeyError for a missing one.
    """
    if kind == "planes":
        return LightPlanes(arrays["planes"], arrays["covariance"], direction)
    if kind not in ("smooth-planes", "bowed", "lens"):
        raise ValueError(f"light sheets of an unknown kind, {kind!r}")
    matrix, parameters = arrays["projector_from_camera"], arrays["parameters"]
    frame = RigidTransform(matrix[:3, :3].copy(), matrix[:3, 3].copy())
    stripes, middle, covariance = int(arrays["stripes"]), arrays["middle"], arrays["covariance"]
    if kind == "lens":
        return LensSheets(frame, middle, stripes, direction, parameters, covariance)
    if kind == "smooth-planes":  # of earlier versions: bowed sheets without bow
        parameters = np.append(parameters, np.zeros(BOW_DEGREE + 2))
        covariance = np.pad(covariance, (0, BOW_DEGREE + 2))
    bow, over = divmod(len(parameters) - 3 * (PLANE_DEGREE + 1) - 1, BOW_DEGREE + 1)
    if bow < 1 or over or (bow > 1 and kind == "smooth-planes"):
        count = len(arrays["parameters"])
        raise ValueError(f"wrong number of parameters for {kind} light sheets: {count}")
    return BowedSheets(frame, middle, stripes, direction, parameters, covariance)


MAX_RELATIVE_SIGMA = 1e-3
"""A sheet that leaves a larger share of the depth uncertain counts as missing: that far from all
boards a smooth model only guesses."""
GUESSED = 3.0
"""A depth is extrapolated if its sigma is this many times that amid the boards. An uncertainty that
all depths share, because there were few boards, is in their sigmas and does not count."""
BAND = 16  # rows at a time: what fits into a processor's cache


def intersect_rays(sheets: LightSheets, rays: Array, s: Array) -> RayDepths:
    """Intersect rays (..., 3) with z = 1, camera frame, with the sheets at real s (...); NaN where
    no depth can be trusted."""
    found = sheets.intersect(rays, s)
    unsure = found.variance_mm2 > (_find_max_relative_sigma(sheets) * found.depth) ** 2
    return RayDepths(*(np.where(unsure, np.nan, part) for part in found))


def measure_stripes_per_pixel(sheets: LightSheets, camera: Camera, s: Floats) -> float:
    """Change of s, at constant depth, from one pixel to the next across the stripes: median over a
    sample of the pixels that have an s (height, width); 0 if none has."""
    rows, columns = np.nonzero(np.isfinite(s))
    some = slice(None, None, max(len(rows) // 400, 1))
    pixels = np.column_stack([columns[some], rows[some]]).astype(float)
    sampled = s[rows[some], columns[some]].astype(float)
    here = intersect_rays(sheets, camera.rays(pixels), sampled)
    neighbours = [intersect_rays(sheets, camera.rays(pixels + step), sampled) for step in np.eye(2)]
    # Along its sheet a neighbouring ray meets another depth, as if s had changed here.
    changes = [(one.depth - here.depth) / here.per_stripe for one in neighbours]
    found = np.hypot(*changes)
    found = found[np.isfinite(found)]
    return float(np.median(found)) if found.size else 0.0


def triangulate_image(
    sheets: LightSheets, camera: Camera, s: Floats, sigma: Floats, shared: Floats | None = None
) -> tuple[Floats, Floats, Floats]:
    """Triangulate an image of stripe coordinates; NaN where no depth can be trusted.

    s: (height, width).
    sigma: its standard deviations (height, width), independent between pixels.
    shared: the part of the error that neighbours share (height, width), if any.

    Returns points (height, width, 3), camera frame, mm, and their standard deviations along the
    viewing rays (height, width): sigma_mm, and common_mm, the part that neighbours share.
    """
    pixels, limit = make_ray_table(camera), _find_max_relative_sigma(sheets)
    points = np.full((*s.shape, 3), np.nan, np.float32)
    sigma_mm, common_mm = np.full((2, *s.shape), np.nan, np.float32)
    for first in range(0, len(s), BAND):
        rows = slice(first, first + BAND)
        wanted = np.isfinite(s[rows])
        rays, at = look_up_rays(pixels, wanted, first), np.flatnonzero(wanted)
        found = sheets.intersect(rays, s[rows].take(at).astype(np.float64))
        common = found.variance_mm2
        if shared is not None:
            common = common + np.square(found.per_stripe * shared[rows].take(at))
        longer = np.einsum("nc,nc->n", rays, rays)  # mm along the ray by mm of depth, squared
        along = np.sqrt((np.square(found.per_stripe * sigma[rows].take(at)) + common) * longer)
        known = (found.variance_mm2 <= np.square(limit * found.depth)) & np.isfinite(along)
        at = at[known]
        points[rows].reshape(-1, 3)[at] = (rays * found.depth[:, None])[known]
        sigma_mm[rows].reshape(-1)[at] = along[known]
        common_mm[rows].reshape(-1)[at] = np.sqrt(common * longer)[known]
    return points, sigma_mm, common_mm


def _find_max_relative_sigma(sheets: LightSheets) -> float:
    """MAX_RELATIVE_SIGMA, or GUESSED times the sigma amid the boards; infinite for a projector
    calibrated elsewhere, which does not extrapolate from boards."""
    if isinstance(sheets, LensSheets) and sheets.only_centre_uncertain:
        return np.inf
    if not isinstance(sheets, SmoothSheets):
        return MAX_RELATIVE_SIGMA
    stripes, middle_mm = np.arange(sheets.stripes + 1.0), sheets.middle[2]
    found = sheets.intersect(np.tile(sheets.middle / middle_mm, (len(stripes), 1)), stripes)
    away = np.abs(found.depth - middle_mm)
    if not np.isfinite(away).any():
        return MAX_RELATIVE_SIGMA
    variance = found.variance_mm2[np.nanargmin(away)]
    return float(max(MAX_RELATIVE_SIGMA, GUESSED * np.sqrt(variance) / middle_mm))
