"""A body's motion while one pair saw it, from the comb of its stripe boundaries (`stripes.comb`).

At a fixed pixel, a surface p.P = 1 that moves by V changes its depth z by p.V z. V is a rigid
motion plus a smooth field of speed along the rays, as large as the evidence asks for (limbs,
breath). What a rigid motion does within the surface itself is not observed, and stays as uncertain
as people's motions are.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import distance_transform_edt
from scipy.special import chdtri, fdtri

from bodyscan.arrays import Array, Indices, Mask
from bodyscan.geometry.camera import Camera
from bodyscan.geometry.least_squares import EXACT, Block, Noise, minimize
from bodyscan.geometry.light_planes import LightSheets
from bodyscan.geometry.ray_depths import intersect_rays
from bodyscan.geometry.robust import SIGMAS_PER_MEDIAN, rms
from bodyscan.geometry.transforms import RigidTransform, adjoint
from bodyscan.geometry.velocity import SurfaceSpeeds, Velocity
from bodyscan.reconstruction.speed_field import CellSpeeds, FieldFit, Knots, fit_field, unexplained
from bodyscan.reconstruction.surface_cells import Cells, fit_planes
from bodyscan.stripes.comb import TEETH, Comb
from bodyscan.stripes.one_moment import StripeMotion

CELLS_ACROSS, CELL_WINDOWS = 80, 1.2
"""Cells across an image, and least size of a cell in windows: a smaller one would have no slope."""
FEWEST = 200
"""Windows: fewer determine a speed less well than people's usual speed is known."""
TWIST_SIGMAS = np.array([0.05] * 3 + [30.0] * 3)
"""Prior about the middle of what is seen, radians and mm per unit of time: several times what
standing people do in a second, so that it matters only where nothing is seen."""
BENT_MM = 600.0
"""A cell's size over this is the relative error of its speed, since its plane is a chord of a round
body. In renderings with cells of 14 and 28 mm speeds are off by 3 and 6 %."""
SETTLED = 1e-3
"""Convergence, in variances: a thirtieth of a sigma."""
FEWEST_BANDS = 5
NEIGHBOURS = 2.0 / 3.0
"""Squared differences of neighbours determine a variance as well as this many independent errors
each (von Neumann 1941), because every value is in two of them."""
TEETH_NOISE = Noise("teeth", cauchy=3.0)
SIGMAS = 3.0
"""A speed counts beyond this many sigmas of what all windows may have in common."""
CHANCE = 0.005
"""Probability of either false alarm in a whole scan: one mannequin in a hundred."""


@dataclass(frozen=True, eq=False)
class _Teeth:
    """What N windows say.

    cell: number of their cell, (N,).
    band: number of the stripes that a window is made of, (N,).
    speed: in depth, mm per unit of time, (N,), with its sigma (N,).
    per_stripe: dz/ds, (N,).
    by_twist: change of depth by a twist about `middle`, (cells, 6).
    points: in the middles of the cells, (cells, 3).
    common: standard deviation of speed that all windows share.
    """

    cell: Indices
    band: Indices
    speed: Array
    sigma: Array
    per_stripe: Array
    by_twist: Array
    points: Array
    middle: Array
    common: float


def tell_motion(
    camera: Camera, sheets: LightSheets, comb: Comb, *, chance: float = CHANCE
) -> StripeMotion | None:
    """The motion of a body; None if too little was seen. Units of time are those of the comb.

    chance: probability with which something still may be found to have moved rigidly, or bent.
    """
    if len(comb.speed) < FEWEST:
        return None
    cells = _cells(camera, comb)
    teeth = _teeth(camera, sheets, comb, cells)
    if len(teeth.speed) < FEWEST:
        return None
    weights, independent = _weights(teeth)
    speeds = _by_cell(cells, teeth, weights)
    known = speeds.weight > 0.0
    mm_per_px = float(teeth.middle[2]) / camera.alpha
    knots = Knots.over(cells, known, mm_per_px)
    fit = fit_field(speeds, knots, TWIST_SIGMAS, bent=_limit(1, independent, 2.0 * chance))
    speed = fit.speed(speeds, knots)
    lost = unexplained(speeds, knots, speeds.speed - speed)
    doubt = np.sqrt(fit.variance(speeds, knots) + lost)
    per_stripe = _mean_by(teeth.cell, teeth.per_stripe, np.ones(len(teeth.cell)), cells.count)
    per_stripe[~known] = np.nan
    grid = np.stack([speed, doubt]) / per_stripe
    share = cells.px * mm_per_px / BENT_MM
    filled = _filled(grid.reshape(2, *cells.shape))
    return StripeMotion(
        speed=filled[0],
        doubt=np.abs(filled[1]),
        cell_px=cells.px,
        velocity=_velocity(fit, teeth, _seen(speeds, teeth, lost, share), share),
        speed_mm=rms(speed[known]),
        mm_per_stripe=float(np.median(np.abs(teeth.per_stripe))),
        doubt_mm=rms(np.sqrt(lost[known])),
        explained=fit.explained,
        is_significant=rms(speed[known]) > SIGMAS * teeth.common
        and (fit.is_bent or fit.explained > _limit(6, independent, chance)),
    )


def _limit(freedoms: int, independent: float, chance: float) -> float:
    """Limit of a chi-square whose variance is known from so many independent errors."""
    if not np.isfinite(independent):
        return float(chdtri(freedoms, chance))
    return float(freedoms * fdtri(freedoms, independent, 1.0 - chance))


def _cells(camera: Camera, comb: Comb) -> Cells:
    """Cells sized by the windows; the middles of a window's halves are half its length apart."""
    window = 2.0 * float(np.median(np.linalg.norm(comb.pixels[:, 1] - comb.pixels[:, 0], axis=1)))
    cell_px = round(max(camera.width / CELLS_ACROSS, CELL_WINDOWS * window))
    return Cells(camera.width, camera.height, cell_px)


def _teeth(camera: Camera, sheets: LightSheets, comb: Comb, cells: Cells) -> _Teeth:
    """Speeds of the windows whose cells have a plane."""
    rays = camera.rays(comb.pixels)
    found = intersect_rays(sheets, rays, comb.s)
    seen = np.isfinite(found.depth).all(axis=1) & (comb.sigma > 0.0)
    places = (
        comb.pixels[seen].reshape(-1, 2),
        rays[seen].reshape(-1, 3),
        found.depth[seen].ravel(),
    )
    sigma = comb.sigma * np.abs(found.per_stripe.mean(axis=1))
    planes, points = fit_planes(cells, *places, np.repeat(sigma[seen] ** -2.0, 2))
    known: Mask = np.isfinite(planes[:, 2])
    middle = np.median(points[known], axis=0) if known.any() else np.array([0.0, 0.0, 1.0])
    facing = planes * points[:, 2:]
    by_twist = np.hstack([np.cross(points - middle, facing), facing])
    cell = cells.of(comb.pixels.mean(axis=1))
    seen &= known[cell]
    per_stripe = found.per_stripe[seen].mean(axis=1)
    speed, common = comb.speed[seen] * per_stripe, comb.common[seen] * np.abs(per_stripe)
    shared = float(np.median(common)) if len(common) else 0.0
    band = (comb.s[seen].mean(axis=1) / TEETH).astype(np.int64)
    return _Teeth(
        cell[seen], band, speed, sigma[seen], per_stripe, by_twist, points, middle, shared
    )


def _weights(teeth: _Teeth) -> tuple[Array, float]:
    """Inverse variances (N,) of the windows' speeds, and the number of independent errors.

    Windows far off a rigid motion get less.
    """
    by_twist = teeth.by_twist[teeth.cell]

    def blocks(twist: Array) -> tuple[Block, ...]:
        left, prior = by_twist @ twist - teeth.speed, twist / TWIST_SIGMAS
        every = slice(0, 6)
        return (
            Block(left, lambda: by_twist, every, TEETH_NOISE, teeth.sigma),
            Block(prior, lambda: np.diag(1.0 / TWIST_SIGMAS), every, EXACT),
        )

    found = minimize(np.zeros(6), blocks, np.add, unknowns=6, settled=SETTLED)
    weights = found.weights[0] / (teeth.sigma * found.spreads[0]) ** 2
    share, independent = _band_share(teeth.band, teeth.speed - by_twist @ found.state, weights)
    return weights * share, independent


def _band_share(band: Indices, left: Array, weights: Array) -> tuple[Array, float]:
    """Share (N,) of their weights at which windows count, because those of one stripe err alike.

    A projector that strays moves a boundary all along its stripe. Also returns the number of
    independent errors from which that is known, for which a test must allow.

    left: speeds that no rigid motion explains, (N,). A body's speed hardly changes from one band of
        stripes to the next, so the differences of their means beyond noise are due to the stripes.
    """
    count = int(band.max()) + 1
    weight, mean = np.bincount(band, weights, count), _mean_by(band, left, weights, count)
    both = (weight[1:] > 0.0) & (weight[:-1] > 0.0)
    if np.count_nonzero(both) < FEWEST_BANDS:
        return np.ones(len(band)), np.inf
    noise = (1.0 / weight[1:][both] + 1.0 / weight[:-1][both]) / 2.0
    square = np.diff(mean)[both] ** 2 / 2.0
    usual = max(float(np.median(SIGMAS_PER_MEDIAN**2 * square - noise)), 0.0)
    # The median's error is that of a third as many bands; the weights of a mean follow from it.
    trust = (noise + usual) ** -2.0
    shared = max(float(np.average(square - noise, weights=trust)), 0.0)
    said = trust * (noise + shared)
    independent = NEIGHBOURS * np.sum(said) ** 2 / np.sum(said**2)
    return np.asarray(1.0 / (1.0 + shared * weight[band]), np.float64), float(independent)


def _by_cell(cells: Cells, teeth: _Teeth, weights: Array) -> CellSpeeds:
    weight = np.asarray(np.bincount(teeth.cell, weights, cells.count), np.float64)
    by_twist = np.where(weight[:, None] > 0.0, teeth.by_twist, 0.0)
    return CellSpeeds(_mean_by(teeth.cell, teeth.speed, weights, cells.count), weight, by_twist)


def _mean_by(cell: Indices, values: Array, weights: Array, count: int) -> Array:
    """Weighted means (count,) of values (N,) by cell; 0 where there are none."""
    total = np.maximum(np.bincount(cell, weights, count), 1e-300)
    return np.asarray(np.bincount(cell, weights * values, count) / total, np.float64)


def _filled(grid: Array) -> Array:
    """A grid (K, rows, columns) with NaN replaced by the nearest known cell."""
    unknown = np.isnan(grid[0])
    row, column = distance_transform_edt(unknown, return_distances=False, return_indices=True)
    return np.asarray(grid[:, row, column], np.float64)


def _seen(speeds: CellSpeeds, teeth: _Teeth, lost: Array, share: float) -> SurfaceSpeeds:
    """lost: variance of what is not smooth motion, (cells,).  share: as in `_velocity`."""
    known = speeds.weight > 0.0
    speed = speeds.speed[known]
    return SurfaceSpeeds(
        teeth.points[known],
        teeth.by_twist[known, 3:],
        speed,
        np.sqrt(1.0 / speeds.weight[known] + lost[known]),
        np.stack([np.full(len(speed), teeth.common), share * speed], axis=1),
    )


def _velocity(fit: FieldFit, teeth: _Teeth, seen: SurfaceSpeeds, share: float) -> Velocity:
    """The velocity about the camera's centre.

    What all windows share is a motion along the middle's ray. share: relative error of the speed.
    """
    about_camera = adjoint(RigidTransform.shift(teeth.middle))
    shared = np.append(np.zeros(3), teeth.common * teeth.middle / teeth.middle[2])
    twist = about_camera @ fit.twist
    off = share * np.repeat([np.linalg.norm(part) for part in np.split(fit.twist, 2)], 3)
    covariance = fit.covariance[:6, :6] + np.outer(shared, shared) + np.diag(off**2)
    return Velocity(twist, about_camera @ covariance @ about_camera.T, seen)
