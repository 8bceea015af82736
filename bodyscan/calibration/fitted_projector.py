"""A pair's light as a projector with a lens, which other programs describe as a camera.

Sheets of a projector with a lens need no fit. Those of any other model are sampled over the
camera's image and around the boards' distance, each place weighted by its sheet's sigma, and a
projector is fitted to them; both directions of stripes belong to one projector.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from bodyscan.arrays import Array, Indices
from bodyscan.calibration.sheet_fit import fit_pinhole
from bodyscan.errors import BadInput
from bodyscan.geometry.camera import MATRIX, Camera
from bodyscan.geometry.least_squares import EXACT, Block, minimize
from bodyscan.geometry.lens_sheets import LensSheets
from bodyscan.geometry.lenses.brown import Brown
from bodyscan.geometry.lenses.radial import Radial
from bodyscan.geometry.light_planes import LightPlanes, LightSheets
from bodyscan.geometry.projector_sheets import projector_from_sheets
from bodyscan.geometry.robust import rms
from bodyscan.geometry.smooth_sheets import SmoothSheets
from bodyscan.geometry.transforms import RigidTransform, twist_jacobian

COLUMNS, ROWS, DEPTHS = 14, 11, 5
"""The sampling grid: over the camera's image, and from NEAREST to FARTHEST in depth."""
NEAREST, FARTHEST = 0.7, 1.4
"""Times the distance of the boards; beyond this range the sheets were not measured."""
FLOOR_PX = 0.02
"""px of the projector, added to each sigma: a fifth of what the best codes leave uncertain in a
pixel of the camera."""
LIKELY = 3.0
"""Largest RMS misfit accepted, in sigmas of the sheets; a real projector's lie within one."""
FEWEST = 50
"""Fewest known places in a direction of stripes; none are known where nothing was calibrated."""
LENS_TERMS = 4
NEWTON_STEPS = 8
SETTLED = 1e-6
"""In stripes."""
POSE = 6
SKEW = POSE + MATRIX.index("gamma")


@dataclass(frozen=True, eq=False)
class FittedProjector:
    """A projector as a camera.

    camera: the projector, with one pixel for each stripe.
    projector_from_camera: mm.
    misfit_px: how far the pair's sheets lie from the projector's own, RMS weighted by their sigmas.
    predicted_px: what their noise alone would give. Both are 0 where the projector is exact.
    """

    camera: Camera
    projector_from_camera: RigidTransform
    misfit_px: float = 0.0
    predicted_px: float = 0.0


@dataclass(frozen=True, eq=False)
class _Samples:
    """Points (N, 3) mm, camera frame, on the sheets at s (N,), with sigma (N,) in stripes.

    axis: 0 for columns of the projector (vertical stripes), 1 for rows.
    """

    points: Array
    s: Array
    sigma: Array
    axis: int


def fit_projector(
    camera: Camera, light: LightSheets, crossing: LightSheets | None = None
) -> FittedProjector:
    """The projector with a lens (k1, k2, p1, p2; more if it came with more) whose sheets these are.

    With a single direction of stripes its pixels are square and its place along the stripes is
    unknown: see `projector_from_sheets`. Raises BadInput if no such projector explains the sheets
    within their noise, or only one whose image is mirrored.
    """
    first = _samples(camera, light)
    start = light if isinstance(light, LensSheets) else _fitted_lens(light, first)
    projector, from_camera = projector_from_sheets(start)
    if crossing is None:
        found = FittedProjector(projector, from_camera)
        return found if start is light else _judged(found, [first])
    both = [first, _samples(camera, crossing)]
    terms = [len(one.parameters) for one in (light, crossing) if isinstance(one, LensSheets)]
    projector = _with_other_way(projector, from_camera, both[1], crossing.stripes)
    if isinstance(projector.lens, Radial):
        projector = replace(projector, lens=Brown.from_opencv(projector.lens.opencv()) or Brown())
    return _judged(_refined(projector, from_camera, both, max(terms, default=0) > 6), both)


def _samples(camera: Camera, sheets: LightSheets) -> _Samples:
    u, v = np.linspace(0.0, camera.width - 1.0, COLUMNS), np.linspace(0, camera.height - 1.0, ROWS)
    rays = camera.rays(np.stack(np.meshgrid(u, v), axis=-1)).reshape(-1, 1, 3)
    depths = _distance(camera, sheets) * np.linspace(NEAREST, FARTHEST, DEPTHS)[:, None]
    points = (rays * depths).reshape(-1, 3)
    points = points[np.isfinite(points).all(axis=1)]
    own = _between_planes if isinstance(sheets, LightPlanes) else _on_smooth_sheets
    s, sigma = own(sheets, points)  # type: ignore[arg-type]  # there are no other models
    known = np.isfinite(sigma)
    if known.sum() < FEWEST:
        raise BadInput(
            f"its sheets of light ({sheets.kind}) are known at {known.sum()} of {len(points)} places "
            "that its camera sees, too few for a projector with a lens",
            remedy="calibrate the pair with boards over more of its picture",
        )
    axis = 0 if sheets.direction == "vertical" else 1
    return _Samples(points[known], s[known], np.hypot(sigma[known], FLOOR_PX), axis)


def _on_smooth_sheets(sheets: SmoothSheets, points: Array) -> tuple[Array, Array]:
    """s (N,) of points (N, 3) and its standard deviation; NaN where they are not lit."""
    s, step = np.full(len(points), 0.5 * sheets.stripes), np.full(len(points), np.inf)
    with np.errstate(all="ignore"):
        for _ in range(NEWTON_STEPS):
            offset = sheets.offset(points, sheets.at(s))
            step = offset.value / offset.by_stripe
            s = np.clip(s - step, 0.0, sheets.stripes)
        offset = sheets.offset(points, sheets.at(s), parameters=True)
        assert offset.by_parameter is not None
        variance = np.sum((offset.by_parameter @ sheets.covariance) * offset.by_parameter, axis=1)
        lit = (offset.reach > 0.0) & (s > 0.0) & (s < sheets.stripes) & (np.abs(step) < SETTLED)
        return s, np.where(lit, np.sqrt(variance) / np.abs(offset.by_stripe), np.nan)


def _between_planes(sheets: LightPlanes, points: Array) -> tuple[Array, Array]:
    """The same as `_on_smooth_sheets`, from the planes on either side of each point."""
    homogeneous = np.column_stack([points, np.ones(len(points))])
    off = homogeneous @ sheets.coefficients.T
    between = off[:, :-1] * off[:, 1:] <= 0.0
    first, every = np.argmax(between, axis=1), np.arange(len(points))
    step = off[every, first] - off[every, first + 1]
    variance = np.einsum("ni,nij,nj->n", homogeneous, sheets.covariance[first], homogeneous)
    with np.errstate(all="ignore"):
        sigma = np.sqrt(variance) / np.abs(step)
        return first + off[every, first] / step, np.where(between.any(axis=1), sigma, np.nan)


def _distance(camera: Camera, sheets: LightSheets) -> float:
    """Distance of the boards along the camera's axis, mm.

    If unknown, the distance at which the projector's middle lights the middle of the image.
    """
    if isinstance(sheets, SmoothSheets):
        return float(sheets.middle[2])
    ray = camera.rays(np.array([[0.5 * camera.width, 0.5 * camera.height]]))
    return float(sheets.depth(ray, np.array([0.5 * sheets.stripes]))[0])


def _fitted_lens(light: LightSheets, samples: _Samples) -> LensSheets:
    """Sheets of a projector with a lens, fitted to samples of one direction of stripes."""
    pinhole = fit_pinhole(samples.points, samples.s)
    start = pinhole.sheets(samples.points, light.stripes, light.direction)

    def blocks(sheets: LensSheets) -> tuple[Block, Block]:
        offset = sheets.offset(samples.points, samples.s, parameters=True)
        by_freedom = offset.by_parameter
        assert by_freedom is not None
        known, jacobian = sheets.prior()
        every = slice(0, by_freedom.shape[1])
        value = np.where(offset.reach > 0.0, offset.value, np.nan)
        return (
            Block(value, lambda: by_freedom, every, EXACT, samples.sigma),
            Block(known, lambda: jacobian, every, EXACT),
        )

    start = start.with_lens(LENS_TERMS)
    return minimize(
        start, blocks, lambda sheets, step: sheets.retract(step), unknowns=len(start.covariance)
    ).state


def _with_other_way(
    projector: Camera, from_camera: RigidTransform, other: _Samples, stripes: int
) -> Camera:
    """The projector with focal length, centre and size along the other direction's axis."""
    seen = from_camera.apply(other.points)
    real = projector.lens.distort(seen[:, :2] / seen[:, 2:])[:, other.axis]
    focal, centre = np.polyfit(real, other.s - 0.5, 1, w=1.0 / other.sigma).tolist()
    if focal <= 0.0:
        raise BadInput(
            "its rows and columns are those of a mirrored picture, which no camera has",
            remedy="if the projector's picture is not flipped, exchange the order of the patterns of "
            "one direction",
        )
    if other.axis == 0:
        return replace(projector, alpha=focal, u0=centre, width=stripes)
    return replace(projector, beta=focal, v0=centre, height=stripes)


def _refined(
    projector: Camera, from_camera: RigidTransform, both: Sequence[_Samples], every_term: bool
) -> FittedProjector:
    """Fit pose, focal lengths, centre and lens together.

    every_term: whether lens terms from k3 on are fitted too.
    """
    size = POSE + len(projector.parameters)
    last = size if every_term else POSE + len(MATRIX) + LENS_TERMS
    free: Indices = np.setdiff1d(np.arange(last), [SKEW])
    lens = free[free >= POSE + len(MATRIX)] - POSE - len(MATRIX)
    start, spread = projector.lens.coefficients[lens], projector.lens.prior_sigmas[lens]
    by_lens = np.zeros((len(lens), len(free)))
    by_lens[:, len(free) - len(lens) :] = np.diag(1.0 / spread)
    columns = slice(0, len(free))
    State = tuple[Camera, RigidTransform]

    def blocks(state: State) -> list[Block]:
        light, pose = state
        own = [
            Block(
                _off(light, pose, samples),
                lambda samples=samples: _slopes(light, pose, samples)[:, free],  # type: ignore[misc]
                columns,
                EXACT,
                samples.sigma,
            )
            for samples in both
        ]
        known = (light.lens.coefficients[lens] - start) / spread
        return [*own, Block(known, lambda: by_lens, columns, EXACT)]

    def moved(state: State, step: Array) -> State:
        whole = np.zeros(size)
        whole[free] = step
        return state[0].retract(whole[POSE:]), state[1].retract(whole[:POSE])

    solution = minimize((projector, from_camera), blocks, moved, unknowns=len(free))
    return FittedProjector(*solution.state)


def _off(light: Camera, from_camera: RigidTransform, samples: _Samples) -> Array:
    """(N,) px; NaN behind the projector."""
    points = from_camera.apply(samples.points)
    off = light.project(points)[:, samples.axis] - (samples.s - 0.5)
    return np.where(points[:, 2] > 0.0, off, np.nan)


def _slopes(light: Camera, from_camera: RigidTransform, samples: _Samples) -> Array:
    """Derivatives of `_off` by a small motion of the projector and its parameters, (N, 6 + P)."""
    points = from_camera.apply(samples.points)
    by_parameter, by_point = light.jacobians(points)
    by_pose = by_point[:, samples.axis, None, :] @ twist_jacobian(points)
    return np.concatenate([by_pose[:, 0], by_parameter[:, samples.axis]], axis=1)


def _judged(found: FittedProjector, both: Sequence[_Samples]) -> FittedProjector:
    """The projector with its misfit. Raises BadInput if noise does not explain it."""
    off = np.concatenate([_off(found.camera, found.projector_from_camera, own) for own in both])
    sigma = np.concatenate([own.sigma for own in both])
    sigmas = rms(off / sigma)
    predicted = float(np.sqrt(len(sigma) / np.sum(sigma**-2.0)))
    misfit = predicted * sigmas
    if not sigmas < LIKELY:
        raise BadInput(
            f"no projector with a lens explains its sheets of light: the nearest is {misfit:.2g} of "
            f"its pixels off, RMS, where their noise alone would be {predicted:.2g}",
        )
    return replace(found, misfit_px=misfit, predicted_px=predicted)
