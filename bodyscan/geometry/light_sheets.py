"""Light sheets of any kind: as arrays for files, and the depths at which rays meet them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from bodyscan.arrays import Array, Floats, Mask
from bodyscan.compiled import compiled
from bodyscan.geometry.bowed_sheets import BOW_DEGREE, PLANE_DEGREE, BowedSheets, SheetTable
from bodyscan.geometry.camera import Camera
from bodyscan.geometry.camera_tables import look_up_rays, ray_table
from bodyscan.geometry.lens_sheets import LensSheets
from bodyscan.geometry.light_planes import Axis, LightPlanes, LightSheets
from bodyscan.geometry.smooth_sheets import SmoothSheets
from bodyscan.geometry.transforms import RigidTransform

KINDS = ("planes", "smooth-planes", "bowed", "lens")


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
    raise TypeError(f"no sheets of light: {type(sheets).__name__}")


def sheets_from_arrays(kind: str, arrays: Mapping[str, Any], direction: Axis) -> LightSheets:
    """Rebuild the sheets from what `sheets_to_arrays` returned.

    Raises ValueError for an unknown kind or arrays of the wrong size, KeyError for a missing one.
    """
    if kind not in KINDS:
        raise ValueError(f"sheets of light of an unknown kind, {kind!r}")
    if kind == "planes":
        return LightPlanes(arrays["planes"], arrays["covariance"], direction)
    matrix, parameters = arrays["projector_from_camera"], arrays["parameters"]
    frame = RigidTransform(matrix[:3, :3].copy(), matrix[:3, 3].copy())
    stripes, middle, covariance = int(arrays["stripes"]), arrays["middle"], arrays["covariance"]
    if kind == "lens":
        return LensSheets(frame, middle, stripes, direction, parameters, covariance)
    bow, over = divmod(len(parameters) - 3 * (PLANE_DEGREE + 1), BOW_DEGREE + 1)
    if bow < 0 or over != (kind == "bowed") or (bow > 0) != (kind == "bowed"):
        raise ValueError(f"{len(parameters)} parameters do not make {kind} sheets of light")
    return BowedSheets(frame, middle, stripes, direction, parameters, covariance, bow)


Measure = Callable[[Array, Array], tuple[Array, Array, Array]]

MAX_RELATIVE_SIGMA = 1e-3
"""A sheet that leaves a larger share of the depth uncertain counts as missing: that far from all
boards a smooth model only guesses."""
GUESSED = 3.0
"""A depth is a guess if it is this many times as uncertain as amid the boards. What a few boards
leave open of all depths alike is in their sigma and is no guess."""
BAND = 16  # rows at a time: what fits into a processor's cache


@dataclass(frozen=True, eq=False)
class RayDepths:
    """Depths along rays; NaN where no depth can be trusted.

    depth: z (...) mm.
    per_stripe: dz/ds (...), mm per stripe.
    variance_mm2: (...) of the depth, due to the sheets alone.
    """

    depth: Array
    per_stripe: Array
    variance_mm2: Array


def intersect_rays(sheets: LightSheets, rays: Array, s: Array) -> RayDepths:
    """Intersect rays (..., 3) with z = 1, camera frame, with the sheets at real s (...)."""
    found = _choose_measure(sheets)(rays.reshape(-1, 3), np.ravel(s))
    unsure = found[2] > (_max_relative_sigma(sheets) * found[0]) ** 2
    return RayDepths(*(np.where(unsure, np.nan, some).reshape(np.shape(s)) for some in found))


def stripes_per_pixel(sheets: LightSheets, camera: Camera, s: Floats) -> float:
    """Change of s, at constant depth, from one pixel to the next across the stripes: median over a
    sample of the pixels that have an s (height, width); 0 if none has."""
    pixels, sampled = _sample_pixels(s, np.isfinite(s))
    here = intersect_rays(sheets, camera.rays(pixels), sampled)
    neighbours = [intersect_rays(sheets, camera.rays(pixels + step), sampled) for step in np.eye(2)]
    # Along its sheet a neighbouring ray meets another depth: as if s had changed by this much
    # here.
    changes = [(one.depth - here.depth) / here.per_stripe for one in neighbours]
    found = np.hypot(*changes)
    found = found[np.isfinite(found)]
    return float(np.median(found)) if found.size else 0.0


def measure_stripe_residual(
    sheets: LightSheets, camera: Camera, s: Floats, points: Floats
) -> float:
    """Distance in stripes between s (height, width) and the sheets through points (height, width,
    3): median over a sample of the pixels that have both; NaN if none has."""
    pixels, sampled = _sample_pixels(s, np.isfinite(s) & np.isfinite(points[..., 2]))
    columns, rows = pixels.astype(np.int64).T
    found = intersect_rays(sheets, camera.rays(pixels), sampled)
    residuals = np.abs((points[rows, columns, 2] - found.depth) / found.per_stripe)
    residuals = residuals[np.isfinite(residuals)]
    return float(np.median(residuals)) if residuals.size else np.nan


def _sample_pixels(s: Floats, wanted: Mask) -> tuple[Array, Array]:
    """Some of the pixels wanted, (N, 2), and their s (N,)."""
    every = np.flatnonzero(wanted)
    some = every[:: max(len(every) // 400, 1)]
    rows, columns = np.unravel_index(some, s.shape)
    return np.column_stack([columns, rows]).astype(float), s.ravel()[some].astype(float)


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
    measure, pixels = _choose_measure(sheets), ray_table(camera)
    points, sigma_mm = np.empty((*s.shape, 3), np.float32), np.empty(s.shape, np.float32)
    common_mm = np.empty(s.shape, np.float32)
    shared = np.zeros((1, 1), np.float32) if shared is None else shared
    shared = np.broadcast_to(shared, s.shape)
    max_relative_sigma = _max_relative_sigma(sheets)
    for first in range(0, len(s), BAND):
        rows = slice(first, first + BAND)
        wanted = np.isfinite(s[rows])
        rays = look_up_rays(pixels, wanted, first)
        found = measure(rays, s[rows][wanted].astype(np.float64))
        uncertain = sigma[rows], shared[rows]
        made = points[rows], sigma_mm[rows], common_mm[rows]
        _fill_points(wanted, rays, found, uncertain, max_relative_sigma, made)
    return points, sigma_mm, common_mm


@lru_cache(maxsize=64)
def _max_relative_sigma(sheets: LightSheets) -> float:
    """MAX_RELATIVE_SIGMA, or GUESSED times the sigma amid the boards. A projector that was
    calibrated elsewhere is a guess nowhere, however roughly it may be known."""
    if isinstance(sheets, LensSheets) and sheets.only_centre_uncertain:
        return np.inf
    if not isinstance(sheets, SmoothSheets):
        return MAX_RELATIVE_SIGMA
    stripes = np.arange(sheets.stripes + 1.0)
    rays = np.tile(sheets.middle / sheets.middle[2], (len(stripes), 1))
    away = np.abs(sheets.depth(rays, stripes) - sheets.middle[2])
    if not np.isfinite(away).any():
        return MAX_RELATIVE_SIGMA
    nearest = slice(int(np.nanargmin(away)), None)
    variance = sheets.variance_mm2(rays[nearest][:1], stripes[nearest][:1])
    return float(max(MAX_RELATIVE_SIGMA, GUESSED * np.sqrt(variance[0]) / sheets.middle[2]))


def _choose_measure(sheets: LightSheets) -> Measure:
    """A function from rays (N, 3) at s (N,) to depth, dz/ds and variance, each (N,)."""
    if isinstance(sheets, BowedSheets):
        return SheetTable.from_sheets(sheets).measure
    if isinstance(sheets, LensSheets):
        return sheets.measure

    def general(rays: Array, s: Array) -> tuple[Array, Array, Array]:
        depth = sheets.depth(rays, s)
        return depth, sheets.depth_per_stripe(rays, s, depth), sheets.variance_mm2(rays, s, depth)

    return general


@compiled
def _fill_points(
    wanted: Mask,
    rays: Array,
    found: tuple[Array, Array, Array],
    uncertain: tuple[Floats, Floats],
    max_relative_sigma: float,
    made: tuple[Floats, Floats, Floats],
) -> None:
    """Fill points (rows, W, 3), sigma_mm and common_mm (rows, W) of the N pixels `wanted` (rows,
    W).

    NaN elsewhere.
    rays: (N, 3).
    found: depth, dz/ds and variance, each (N,).
    uncertain: sigma of s, and the part of it that neighbours share, each (rows, W).
    """
    depths, slopes, variances = found
    sigma, shared = uncertain
    points, sigma_mm, common_mm = made
    points[:], sigma_mm[:], common_mm[:] = np.nan, np.nan, np.nan
    n = 0
    for v in range(wanted.shape[0]):
        for u in range(wanted.shape[1]):
            if not wanted[v, u]:
                continue
            x, y, depth = rays[n, 0], rays[n, 1], depths[n]
            decoding, variance = slopes[n] * sigma[v, u], variances[n]
            calibrated, longer = slopes[n] * shared[v, u], x * x + y * y + 1.0
            common = variance + calibrated * calibrated
            along = np.sqrt((decoding * decoding + common) * longer)
            n += 1
            if variance <= (max_relative_sigma * depth) ** 2 and along < np.inf:
                points[v, u, 0], points[v, u, 1], points[v, u, 2] = x * depth, y * depth, depth
                sigma_mm[v, u], common_mm[v, u] = along, np.sqrt(common * longer)
