"""Triangulate a stripe map (2.3): intersect each pixel's ray with the light sheet of its stripe."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from bodyscan.arrays import Floats, Mask, crop_bounds, find_crop
from bodyscan.calibration.pair import PairCalibration
from bodyscan.compiled import compiled
from bodyscan.errors import BadInput
from bodyscan.geometry.light_planes import LightSheets
from bodyscan.geometry.light_sheets import (
    measure_stripe_residual,
    stripes_per_pixel,
    triangulate_image,
)
from bodyscan.geometry.robust import SIGMAS_PER_MEDIAN
from bodyscan.reconstruction.crossing_stripes import Agreement, combine_directions
from bodyscan.reconstruction.range_image import RangeImage
from bodyscan.stripes.stripe_map import StripeMap

NORMAL_WINDOW_PX = 5
REACH = 2
ZERO, ONE = np.float32(0.0), np.float32(1.0)


def reconstruct_range_image(pair: PairCalibration, stripes: StripeMap) -> RangeImage:
    """Triangulate points, with normals and sigmas, on the camera's pixel grid, camera frame, mm.

    Stripes of both directions are used if they were projected and calibrated. Raises BadInput if
    the pair has no projector, the image size differs, or the directions contradict each other as
    with a wrong calibration.
    """
    camera = pair.camera
    if pair.sheets is None:
        raise BadInput("this pair has no projector, it cannot scan", where=f"pair {pair.name}")
    if stripes.s.shape != (camera.height, camera.width):
        height, width = stripes.s.shape
        raise BadInput(
            f"images of {width} x {height} px, but the pair was calibrated with "
            f"{camera.width} x {camera.height} px",
            where=f"pair {pair.name}",
            remedy="scan with the camera settings of the calibration, or calibrate again",
        )
    points, sigma_mm, common_mm = _triangulate(pair, pair.sheets, stripes.s, stripes.sigma)
    agreement, correlation_px = None, stripes.correlation_px
    if pair.crossing is not None and stripes.crossing is not None:
        crossing = stripes.crossing
        *others, crossing_common = _triangulate(pair, pair.crossing, crossing.s, crossing.sigma)
        # Crossing stripes are decoded everywhere, not only in the scan volume.
        alone = np.full(sigma_mm.shape, stripes.beyond is None)
        offset, count = _measure_offset(pair, stripes, (points, sigma_mm), (others[0], others[1]))
        shares = common_mm / sigma_mm, crossing_common / others[1]
        points, sigma_mm, agreement = combine_directions(points, sigma_mm, *others, alone=alone)
        # The merged point gets the larger share of the two calibrations.
        common_mm = sigma_mm * np.fmax(*shares)
        if agreement is not None:
            # Noise is correlated along another direction in each: in their mean it hardly is.
            correlation_px = (0.0, 0.0)
            agreement = replace(agreement, offset_stripes=offset, stripes=count)
        _require_fit(pair, stripes, agreement)
    return RangeImage(
        pair.name,
        camera,
        points,
        grid_normals(points, np.isfinite(sigma_mm)),
        sigma_mm,
        stripes.lit.copy(),  # part of a stack of images, which would be kept alive with it
        stripes.beyond,
        agreement,
        common_mm=common_mm,
        correlation_px=correlation_px,
    )


def _measure_offset(
    pair: PairCalibration,
    stripes: StripeMap,
    one: tuple[Floats, Floats],
    other: tuple[Floats, Floats],
) -> tuple[float, int]:
    """Robust sigma, in stripes, of the less depth-sensitive direction relative to the other's points.

    one, other: points and sigmas of both directions. Also returns that direction's stripe count.
    """
    assert pair.sheets is not None
    assert pair.crossing is not None
    assert stripes.crossing is not None
    both = np.isfinite(one[1]) & np.isfinite(other[1])
    better = not both.any() or np.median(one[1][both]) <= np.median(other[1][both])
    sheets, s = (pair.crossing, stripes.crossing.s) if better else (pair.sheets, stripes.s)
    points = np.where(both[..., None], one[0] if better else other[0], np.float32(np.nan))
    return SIGMAS_PER_MEDIAN * measure_stripe_residual(
        sheets, pair.camera, s, points
    ), sheets.stripes


def _require_fit(pair: PairCalibration, stripes: StripeMap, agreement: Agreement | None) -> None:
    """Raise BadInput if the directions contradict each other as no right calibration lets them."""
    assert stripes.crossing is not None
    if agreement is not None and agreement.impossible:
        why = f"the directions differ by {agreement.description}"
    else:
        decoded = np.isfinite(stripes.s) & np.isfinite(stripes.crossing.s)
        measured = agreement.pixels if agreement else 0
        # With a right calibration, nearly all rays meet both sheets; wrong codes do not.
        if measured >= 0.01 * np.count_nonzero(decoded):
            return
        with_sheets, met = _count_intersections(pair, stripes, decoded)
        if with_sheets < 1000 or met >= 0.01 * with_sheets:
            return
        why = (
            f"of {with_sheets} pixels with stripes of both directions, {met} meet both light sheets"
        )
    raise BadInput(
        f"its calibration does not fit these stripes: {why}",
        where=f"pair {pair.name}",
        remedy="check whether R and T are inverted (`inverse`), the sign of `shift`, and the number "
        "of stripes"
        if pair.quality.imported
        else "calibrate again: camera or projector were moved, or `stripes` was changed",
    )


def _count_intersections(
    pair: PairCalibration, stripes: StripeMap, decoded: Mask
) -> tuple[int, int]:
    """Count the decoded pixels (H, W) with a sheet in both directions, and those that meet both.

    An imported calibration has a sheet for every stripe. Ours has none where no board showed the
    stripe; far from the boards it has one, though the depth there is only a guess.
    """
    assert pair.sheets is not None
    assert pair.crossing is not None
    assert stripes.crossing is not None
    rays = pair.camera.rays(np.argwhere(decoded)[:, ::-1].astype(float))
    exist, meet = np.isfinite(rays[:, 0]), np.ones(len(rays), bool)
    for sheets, direction in ((pair.sheets, stripes), (pair.crossing, stripes.crossing)):
        s = direction.s[decoded].astype(np.float64)
        exist &= np.isfinite(sheets.tangent_planes(s)[:, 3])
        meet &= np.isfinite(sheets.depth(rays, s))
    return int(np.count_nonzero(exist)), int(np.count_nonzero(exist & meet))


def _triangulate(
    pair: PairCalibration, sheets: LightSheets, s: Floats, sigma: Floats
) -> tuple[Floats, Floats, Floats]:
    """`triangulate_image` with the uncertainty of the pair's rays.

    An error of a ray in pixels acts as an error of s, by the stripes per pixel there, and equally on
    neighbouring pixels.
    """
    camera, ray_sigma = pair.camera, None
    if pair.rays is not None:
        scale = np.float32(stripes_per_pixel(sheets, camera, s))
        ray_sigma = scale * pair.rays.image(camera.width, camera.height)
    return triangulate_image(sheets, camera, s, sigma, ray_sigma)


def grid_normals(points: Floats, measured: Mask | None = None) -> Floats:
    """Unit normals (H, W, 3) towards the camera, from points (H, W, 3) in a small window.

    measured: where there are points, (H, W), if that is known.

    Fits a plane to 1/z, which is affine in image coordinates on a plane; NaN where the window is
    incomplete, because points at a rim are not reliable.
    """
    normals = np.full(points.shape, np.nan, np.float32)
    shown = find_crop(np.isfinite(points[..., 2]) if measured is None else measured)
    if shown is not None:
        _grid_normals(np.ascontiguousarray(points, np.float32), crop_bounds(shown), normals)
    return normals


@compiled
def _grid_normals(points: Floats, box: tuple[int, int, int, int], normals: Floats) -> None:
    """Set the normals (H, W, 3) of points (H, W, 3), row by row of a box that holds all points.

    `recent` holds x/z, y/z and 1000/z of the last five rows. A NaN spreads to all windows it is in.
    """
    top, bottom, left, right = box
    width = right - left
    recent = np.full((3, NORMAL_WINDOW_PX, width), np.nan, np.float32)
    middle = np.empty((3, width), np.float32)
    slope_u, slope_v = np.empty_like(middle), np.empty_like(middle)
    for v in range(top, bottom + REACH):
        newest = v % NORMAL_WINDOW_PX
        if v < bottom:
            row = points[v, left:right]
            _affine_in_image(row, recent[0, newest], recent[1, newest], recent[2, newest])
        else:
            recent[:, newest] = np.nan
        if v >= top + REACH:
            for k in range(3):
                _slopes(recent[k], v - REACH, middle[k], slope_u[k], slope_v[k])
            _normals(middle, slope_u, slope_v, normals[v - REACH, left:right])


@compiled
def _affine_in_image(points: Floats, x: Floats, y: Floats, inverse: Floats) -> None:
    """Set x/z, y/z and 1000/z (W,) of a row of points (W, 3)."""
    for u in range(len(points)):
        per_z = ONE / points[u, 2]
        x[u], y[u] = points[u, 0] * per_z, points[u, 1] * per_z
        inverse[u] = np.float32(1000.0) * per_z


@compiled
def _slopes(rows: Floats, v: int, middle: Floats, slope_u: Floats, slope_v: Floats) -> None:
    """Slopes by column and row (W,) of planes fitted in the windows of row v, times 50; row v.

    All are given for the windows' middles, which begin at column 2. Row w is rows[w % 5], (5, W).
    """
    above2, above, here = rows[(v - 2) % 5], rows[(v - 1) % 5], rows[v % 5]
    below, below2 = rows[(v + 1) % 5], rows[(v + 2) % 5]
    width = len(here)
    total, ramp = np.empty(width, np.float32), np.empty(width, np.float32)
    for u in range(width):
        total[u] = here[u] + ((above[u] + below[u]) + (above2[u] + below2[u]))
        outer = below2[u] - above2[u]
        ramp[u] = (below[u] - above[u]) + (outer + outer)
    for u in range(width - 4):
        outer = total[u + 4] - total[u]
        slope_u[u] = (total[u + 3] - total[u + 1]) + (outer + outer)
        slope_v[u] = ramp[u + 2] + ((ramp[u + 1] + ramp[u + 3]) + (ramp[u] + ramp[u + 4]))
        middle[u] = here[u + 2]


@compiled
def _normals(middle: Floats, slope_u: Floats, slope_v: Floats, normals: Floats) -> None:
    """Normals (W, 3) of a row from the results of `_slopes` for x/z, y/z and 1000/z (3, W).

    1/z = p x + q y + r is the plane p X + q Y + r Z = 1, whose normal (p, q, r) points away. Slopes
    by column and row are converted to slopes by x and y, all times the determinant.
    """
    x, y, inverse = middle[0], middle[1], middle[2]
    x_u, y_u, inverse_u = slope_u[0], slope_u[1], slope_u[2]
    x_v, y_v, inverse_v = slope_v[0], slope_v[1], slope_v[2]
    windows = len(normals) - 2 * REACH
    # With separate arrays, which the compiler knows not to overlap, it computes eight at once.
    p, q = np.empty(windows, np.float32), np.empty(windows, np.float32)
    r = np.empty(windows, np.float32)
    for u in range(windows):
        determinant = x_u[u] * y_v[u] - x_v[u] * y_u[u]
        by_x = inverse_u[u] * y_v[u] - inverse_v[u] * y_u[u]
        by_y = inverse_v[u] * x_u[u] - inverse_u[u] * x_v[u]
        by_z = determinant * inverse[u] - by_x * x[u] - by_y * y[u]
        size = np.sqrt(by_x * by_x + by_y * by_y + by_z * by_z)
        scale = ONE / (-size if determinant > ZERO else size)
        p[u], q[u], r[u] = by_x * scale, by_y * scale, by_z * scale
    for u in range(windows):
        normals[REACH + u, 0], normals[REACH + u, 1], normals[REACH + u, 2] = p[u], q[u], r[u]
