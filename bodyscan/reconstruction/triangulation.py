"""Triangulate a stripe map (2.3): intersect each pixel's ray with the light sheet of its stripe.

With stripes of two directions a ray intersects a sheet of each. Both depths lie on the same ray, so
they differ only by errors of decoding and calibration: a check that needs no board.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from bodyscan.arrays import Floats, Mask, find_crop
from bodyscan.calibration.pair import PairCalibration
from bodyscan.compiled import compiled
from bodyscan.errors import BadInput
from bodyscan.geometry.light_planes import LightSheets
from bodyscan.geometry.light_sheets import (
    intersect_rays,
    measure_stripes_per_pixel,
    triangulate_image,
)
from bodyscan.geometry.robust import SIGMAS_PER_MEDIAN
from bodyscan.reconstruction.range_image import MAX_RATIO, Agreement, RangeImage
from bodyscan.stripes.stripe_map import StripeMap


def reconstruct_range_image(pair: PairCalibration, stripes: StripeMap) -> RangeImage:
    """Triangulate points, with normals and sigmas, on the camera's pixel grid, camera frame, mm.

    Stripes of both directions are used if they were projected and calibrated. Raises BadInput if
    the directions contradict each other as with a wrong calibration.
    """
    assert pair.sheets is not None  # its stripes would not have been decoded
    if stripes.stripes > 1:
        one = _triangulate(pair, pair.sheets, stripes.s, stripes.sigma)
    else:
        one = _triangulate_line(pair, pair.sheets, stripes)
    (points, sigma_mm, common_mm), agreement = one, None
    correlation_px = stripes.correlation_px
    if pair.crossing is not None and stripes.crossing is not None:
        crossing = stripes.crossing
        other = _triangulate(pair, pair.crossing, crossing.s, crossing.sigma)
        # Crossing stripes are decoded everywhere, not only in the scan volume.
        alone = np.full(sigma_mm.shape, stripes.beyond is None)
        (points, sigma_mm, common_mm), sigmas = combine_directions(one, other, alone=alone)
        if sigmas is not None:
            # Noise is correlated along another direction in each: in their mean it hardly is.
            correlation_px = (0.0, 0.0)
            offset, is_other = _measure_offset(one, other, (stripes.sigma, crossing.sigma))
            count = (pair.sheets, pair.crossing)[is_other].stripes
            agreement = Agreement(sigmas, offset, count)
        _require_fit(pair, stripes, agreement)
    return RangeImage(
        pair.name,
        pair.camera,
        points,
        estimate_grid_normals(points, np.isfinite(sigma_mm)),
        sigma_mm,
        stripes.lit.copy(),  # part of a stack of images, which would be kept alive with it
        stripes.beyond,
        agreement,
        common_mm=common_mm,
        correlation_px=correlation_px,
        saturated=stripes.saturated,
        nonlinearity=stripes.nonlinearity,
    )


Depths = tuple[Floats, Floats, Floats]
"""Points (H, W, 3), their sigmas along the rays (H, W), and the part of it that neighbours share."""


def combine_directions(
    primary: Depths, crossing: Depths, *, alone: Mask
) -> tuple[Depths, float | None]:
    """Combine the depths of both directions; also return the robust sigma of their difference, in
    their sigmas.

    alone: where the crossing stripes may give a point by themselves, (H, W).

    NaN where there are none; the sigma is None if fewer than 100 pixels have both. Both directions
    share a camera and boards, and their calibrations' errors are taken as one and the same. However
    much less they have in common, the mean that follows is no worse than the better of the two: its
    variance is convex in the weight of the worse, and the best weight is larger. If the sigmas are too
    small (an imported calibration may have none), all pixels disagree equally: then only those far
    beyond the others are dropped; the better direction alone gives the depth, the other checks it.
    """
    points, sigma_mm, common_mm = (part.copy() for part in primary)
    both = np.isfinite(sigma_mm) & np.isfinite(crossing[1])
    alone = alone & ~np.isfinite(sigma_mm) & np.isfinite(crossing[1])
    for part, other in zip((points, sigma_mm, common_mm), crossing, strict=True):
        part[alone] = other[alone]
    if np.count_nonzero(both) < 100:
        return (points, sigma_mm, common_mm), None
    one, other = points[both], crossing[0][both]
    variances = np.square([sigma_mm[both], crossing[1][both]])
    commons = np.array([common_mm[both], crossing[2][both]])
    difference = np.linalg.norm(one, axis=1) - np.linalg.norm(other, axis=1)
    normalized = difference / np.sqrt(variances.sum(axis=0))
    sigmas = SIGMAS_PER_MEDIAN * float(np.median(np.abs(normalized)))
    # Noise alone does not reach five sigmas; a wrong code does, or a pixel that saw two surfaces.
    wrong = np.abs(normalized) > 5.0 * max(sigmas, 1.0)
    shared = commons[0] * commons[1]
    separate = variances - shared
    share = np.clip(
        separate[0] / np.maximum(separate.sum(axis=0), 1e-30), 0.0, 1.0
    )  # of the crossing
    if sigmas > MAX_RATIO:
        share = np.full_like(share, float(np.median(share) > 0.5))
    shares = np.stack([1.0 - share, share])
    points[both] = one + share[:, None] * (other - one)
    merged = np.sqrt(np.sum(shares**2 * separate, axis=0) + shared)
    sigma_mm[both] = np.where(wrong, np.float32(np.nan), merged)
    common_mm[both] = np.sum(shares * commons, axis=0)
    return (points, sigma_mm, common_mm), sigmas


def _measure_offset(one: Depths, other: Depths, sigmas: Sequence[Floats]) -> tuple[float, bool]:
    """Robust sigma of the directions' difference, in stripes of the less depth-sensitive one, and
    whether that is the other. sigmas: of their stripe coordinates."""
    both = np.isfinite(one[1]) & np.isfinite(other[1])
    if not both.any():
        return np.nan, True
    is_other = bool(np.median(one[1][both]) <= np.median(other[1][both]))
    _, sigma_mm, common_mm = (part[both] for part in (other if is_other else one))
    per_mm = sigmas[is_other][both] / np.sqrt(sigma_mm**2 - common_mm**2)
    difference = np.linalg.norm(one[0][both] - other[0][both], axis=1)
    return SIGMAS_PER_MEDIAN * float(np.median(difference * per_mm)), is_other


def _require_fit(pair: PairCalibration, stripes: StripeMap, agreement: Agreement | None) -> None:
    """Raise BadInput if the directions contradict each other as no right calibration lets them. With a
    right calibration nearly all rays meet both sheets; wrong codes do not. Ours, unlike an imported
    one, has no sheet where no board showed the stripe, and far from the boards a mere guess."""
    if agreement is not None:
        if not agreement.impossible:
            return
        why = f"the directions differ by {agreement.description}"
    else:
        assert stripes.crossing is not None
        decoded = np.isfinite(stripes.s) & np.isfinite(stripes.crossing.s)
        rays = pair.camera.rays(np.argwhere(decoded)[:, ::-1].astype(float))
        exist, meet = np.isfinite(rays[:, 0]), np.isfinite(rays[:, 0])
        for sheets, direction in ((pair.sheets, stripes), (pair.crossing, stripes.crossing)):
            assert sheets is not None
            s = direction.s[decoded].astype(np.float64)
            exist = exist & np.isfinite(sheets.tangent_planes(s)[:, 3])
            meet = meet & exist & np.isfinite(sheets.intersect(rays, s).depth)
        count, met = np.count_nonzero(exist), np.count_nonzero(exist & meet)
        if count < 1000 or met >= 0.01 * count:
            return
        why = f"of {count} pixels with stripes of both directions, {met} meet both light sheets"
    raise BadInput(
        f"its calibration does not fit these stripes: {why}",
        where=f"pair {pair.name}",
        remedy="check whether R and T are inverted (`inverse`), the sign of `shift`, and the number "
        "of stripes"
        if pair.quality.imported
        else "calibrate again: camera or projector were moved, or `stripes` was changed",
    )


def _triangulate(
    pair: PairCalibration, sheets: LightSheets, s: Floats, sigma: Floats
) -> tuple[Floats, Floats, Floats]:
    """`triangulate_image` with the uncertainty of the pair's rays. An error of a ray in pixels acts as
    one of s, by the stripes per pixel there, on neighbours alike."""
    camera, ray_sigma = pair.camera, None
    if pair.rays is not None:
        scale = np.float32(measure_stripes_per_pixel(sheets, camera, s))
        ray_sigma = scale * pair.rays.image(camera.width, camera.height)
    return triangulate_image(sheets, camera, s, sigma, ray_sigma)


def _triangulate_line(pair: PairCalibration, sheets: LightSheets, stripes: StripeMap) -> Depths:
    """Triangulate the middle of a single line of light, to a fraction of a pixel: points are off the
    rays of their pixels, along the surface."""
    camera, pixels = pair.camera, stripes.boundary_pixels
    half = np.array([0.0, 0.5] if sheets.direction == "horizontal" else [0.5, 0.0])
    rays, s = camera.rays(pixels), np.zeros(len(pixels))
    here = intersect_rays(sheets, rays, s)
    ahead, behind = (intersect_rays(sheets, camera.rays(pixels + k), s) for k in (half, -half))
    u, v = np.rint(pixels).astype(np.int64).T
    shared = pair.rays.image(camera.width, camera.height)[v, u] if pair.rays else 0.0
    per_pixel, longer = np.abs(ahead.depth - behind.depth), np.linalg.norm(rays, axis=1)
    common = longer * np.sqrt(here.variance_mm2 + (per_pixel * shared) ** 2)
    points = np.full((*stripes.s.shape, 3), np.nan, np.float32)
    sigma_mm, common_mm = np.full((2, *stripes.s.shape), np.nan, np.float32)
    points[v, u], common_mm[v, u] = rays * here.depth[:, None], common
    sigma_mm[v, u] = np.hypot(longer * per_pixel * stripes.boundary_sigma_px, common)
    return points, sigma_mm, common_mm


def estimate_grid_normals(points: Floats, measured: Mask | None = None) -> Floats:
    """Unit normals (H, W, 3) towards the camera, from points (H, W, 3), in windows of 5 x 5 pixels.

    measured: where there are points, (H, W), if that is known.

    Fits a plane p X + q Y + r Z = 1, that is 1/z = p x/z + q y/z + r, by least squares over rows and
    columns. NaN where the window is incomplete: points at the margin of a surface are unreliable.
    """
    normals = np.full(points.shape, np.nan, np.float32)
    if measured is None:
        measured = np.isfinite(points[..., 2])
    box = find_crop(measured)
    if box is None:
        return normals
    border = {"borderType": cv2.BORDER_CONSTANT, "borderValue": 0}
    inner = cv2.erode(measured[box].view(np.uint8), np.ones((5, 5), np.uint8), **border) > 0
    _fit_normals(points[box], inner, normals[box])
    return normals


@compiled
def _fit_normals(points: Floats, inner: Mask, normals: Floats) -> None:
    """Write the normals of `estimate_grid_normals` where the window is complete (h, w). Sums over five
    rows are formed once a column, and then over five columns."""
    height, width = inner.shape
    sums, falls = np.empty((3, width)), np.empty((3, width))  # of X/Z, Y/Z, 1/Z; by row of these
    u, v = np.empty(3), np.empty(3)
    for row in range(2, height - 2):
        columns = np.flatnonzero(inner[row])
        if columns.size == 0:
            continue
        for column in range(columns[0] - 2, columns[-1] + 3):
            for k in range(3):
                sums[k, column] = falls[k, column] = 0.0
            for step in range(-2, 3):
                x, y, z = points[row + step, column]
                inverse = 1.0 / z
                for k, value in enumerate((x * inverse, y * inverse, 1000.0 * inverse)):
                    sums[k, column] += value
                    falls[k, column] += step * value
        for n in range(columns.size):
            column = columns[n]
            for k in range(3):
                u[k] = v[k] = 0.0
                for step in range(-2, 3):
                    u[k] += step * sums[k, column + step]
                    v[k] += falls[k, column + step]
            x, y, z = points[row, column]
            # Cramer's rule converts slopes by column and row to slopes by x/z and y/z.
            determinant = u[0] * v[1] - u[1] * v[0]
            p, q = u[2] * v[1] - v[2] * u[1], v[2] * u[0] - u[2] * v[0]
            r = (determinant * 1000.0 - p * x - q * y) / z
            length = np.sqrt(p * p + q * q + r * r)
            signed = -length if determinant > 0.0 else length
            normals[row, column, 0] = p / signed
            normals[row, column, 1] = q / signed
            normals[row, column, 2] = r / signed
