"""Fit a projector with a lens, as other programs describe it, to the light sheets of a pair.

Sheets of a projector with a lens need no fit. Those of any other model are sampled over the
camera's image and around the boards' distance, each point weighted by its sheet's sigma, and a
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
from bodyscan.geometry.lenses.opencv import Brown, Radial
from bodyscan.geometry.light_planes import LightPlanes, LightSheets
from bodyscan.geometry.projector_sheets import projector_from_sheets
from bodyscan.geometry.robust import rms
from bodyscan.geometry.smooth_sheets import SmoothSheets
from bodyscan.geometry.transforms import RigidTransform, twist_jacobian

POSE = 6  # unknowns of the projector's pose, before those of its camera model


@dataclass(frozen=True, eq=False)
class FittedProjector:
    """A projector as a camera.

    camera: the projector, with one pixel for each stripe.
    projector_from_camera: mm.
    misfit_px: RMS distance of the pair's sheets from the projector's, weighted by their sigmas.
    predicted_px: what their noise alone gives. Both are 0 where the projector is exact.
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
    """Fit a projector with a lens (k1, k2, p1, p2; more if the sheets have more) to light sheets.

    With a single direction of stripes its pixels are square and its position along the stripes is
    unknown: see `projector_from_sheets`. Raises BadInput if no such projector explains the sheets
    within their noise, or only one whose image is mirrored.
    """
    first = _samples(camera, light)
    start = light if isinstance(light, LensSheets) else _fit_lens(light, first)
    projector, from_camera = projector_from_sheets(start)
    if crossing is None:
        found = FittedProjector(projector, from_camera)
        return found if start is light else _with_misfit(found, [first])
    both = [first, _samples(camera, crossing)]
    terms = [len(one.parameters) for one in (light, crossing) if isinstance(one, LensSheets)]
    projector = _with_crossing_axis(projector, from_camera, both[1], crossing.stripes)
    if type(projector.lens) is Radial:
        projector = replace(projector, lens=Brown.from_opencv(projector.lens.opencv()) or Brown())
    refined = _refine(projector, from_camera, both, every_term=max(terms, default=0) > 6)
    return _with_misfit(refined, both)


def _samples(camera: Camera, sheets: LightSheets) -> _Samples:
    """Sample sheets over the camera's image, at 0.7 to 1.4 times the distance of the boards."""
    u, v = np.linspace(0.0, camera.width - 1.0, 14), np.linspace(0, camera.height - 1.0, 11)
    rays = camera.rays(np.stack(np.meshgrid(u, v), axis=-1)).reshape(-1, 1, 3)
    depths = _distance(camera, sheets) * np.linspace(0.7, 1.4, 5)[:, None]
    points = (rays * depths).reshape(-1, 3)
    points = points[np.isfinite(points).all(axis=1)]
    locate = _between_planes if isinstance(sheets, LightPlanes) else _on_smooth_sheets
    s, sigma = locate(sheets, points)  # type: ignore[arg-type]  # there are no other models
    known = np.isfinite(sigma)
    if known.sum() < 50:
        raise BadInput(
            f"its sheets of light ({sheets.kind}) are known at {known.sum()} of {len(points)} points "
            "in its camera's view, too few for a projector with a lens",
            remedy="calibrate the pair with boards over more of its picture",
        )
    axis = 0 if sheets.direction == "vertical" else 1
    # The floor is a fifth of what the best codes leave uncertain in a pixel of the camera.
    return _Samples(points[known], s[known], np.hypot(sigma[known], 0.02), axis)


def _on_smooth_sheets(sheets: SmoothSheets, points: Array) -> tuple[Array, Array]:
    """Solve for s (N,) of points (N, 3), with its standard deviation; NaN where they are not lit."""
    s, step = np.full(len(points), 0.5 * sheets.stripes), np.full(len(points), np.inf)
    with np.errstate(all="ignore"):
        for _ in range(8):
            offset = sheets.offset(points, sheets.at(s))
            step = offset.value / offset.by_stripe
            s = np.clip(s - step, 0.0, sheets.stripes)
        offset = sheets.offset(points, sheets.at(s), parameters=True)
        assert offset.by_parameter is not None
        variance = np.sum((offset.by_parameter @ sheets.covariance) * offset.by_parameter, axis=1)
        lit = (offset.reach > 0.0) & (s > 0.0) & (s < sheets.stripes) & (np.abs(step) < 1e-6)
        return s, np.where(lit, np.sqrt(variance) / np.abs(offset.by_stripe), np.nan)


def _between_planes(sheets: LightPlanes, points: Array) -> tuple[Array, Array]:
    """Interpolate s (N,), with its standard deviation, between the planes next to each point."""
    homogeneous = np.column_stack([points, np.ones(len(points))])
    distance = homogeneous @ sheets.coefficients.T
    between = distance[:, :-1] * distance[:, 1:] <= 0.0
    first, every = np.argmax(between, axis=1), np.arange(len(points))
    step = distance[every, first] - distance[every, first + 1]
    variance = np.einsum("ni,nij,nj->n", homogeneous, sheets.covariance[first], homogeneous)
    with np.errstate(all="ignore"):
        sigma = np.sqrt(variance) / np.abs(step)
        return first + distance[every, first] / step, np.where(between.any(axis=1), sigma, np.nan)


def _distance(camera: Camera, sheets: LightSheets) -> float:
    """Distance of the boards along the camera's axis, mm; if unknown, the distance at which the
    projector's middle lights the middle of the image."""
    if isinstance(sheets, SmoothSheets):
        return float(sheets.middle[2])
    ray = camera.rays(np.array([[0.5 * camera.width, 0.5 * camera.height]]))
    return float(sheets.measure(ray, np.array([0.5 * sheets.stripes])).depth[0])


def _fit_lens(light: LightSheets, samples: _Samples) -> LensSheets:
    """Fit sheets of a projector with a lens to samples of one direction of stripes."""
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

    start = start.with_lens(4)
    return minimize(
        start, blocks, lambda sheets, step: sheets.retract(step), unknowns=len(start.covariance)
    ).state


def _with_crossing_axis(
    projector: Camera, from_camera: RigidTransform, other: _Samples, stripes: int
) -> Camera:
    """Fit focal length and centre along the axis of the crossing stripes, and set its size."""
    points = from_camera.apply(other.points)
    real = projector.lens.distort(points[:, :2] / points[:, 2:])[:, other.axis]
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


def _refine(
    projector: Camera, from_camera: RigidTransform, both: Sequence[_Samples], *, every_term: bool
) -> FittedProjector:
    """Fit pose, focal lengths, centre and lens jointly, without skew.

    every_term: whether lens terms from k3 on are fitted too.
    """
    size = POSE + len(projector.parameters)
    last = size if every_term else POSE + len(MATRIX) + 4
    free: Indices = np.setdiff1d(np.arange(last), [POSE + MATRIX.index("gamma")])
    lens = free[free >= POSE + len(MATRIX)] - POSE - len(MATRIX)
    start, sigmas = projector.lens.coefficients[lens], projector.lens.prior_sigmas[lens]
    by_lens = np.zeros((len(lens), len(free)))
    by_lens[:, len(free) - len(lens) :] = np.diag(1.0 / sigmas)
    columns = slice(0, len(free))
    State = tuple[Camera, RigidTransform]

    def blocks(state: State) -> list[Block]:
        light, pose = state
        stripes = [
            Block(
                _residuals(light, pose, samples),
                lambda samples=samples: _jacobian(light, pose, samples)[:, free],  # type: ignore[misc]
                columns,
                EXACT,
                samples.sigma,
            )
            for samples in both
        ]
        known = (light.lens.coefficients[lens] - start) / sigmas
        return [*stripes, Block(known, lambda: by_lens, columns, EXACT)]

    def retract(state: State, step: Array) -> State:
        whole = np.zeros(size)
        whole[free] = step
        return state[0].retract(whole[POSE:]), state[1].retract(whole[:POSE])

    solution = minimize((projector, from_camera), blocks, retract, unknowns=len(free))
    return FittedProjector(*solution.state)


def _residuals(light: Camera, from_camera: RigidTransform, samples: _Samples) -> Array:
    """Reprojection errors across the stripes (N,) px; NaN behind the projector."""
    points = from_camera.apply(samples.points)
    error = light.project(points)[:, samples.axis] - (samples.s - 0.5)
    return np.where(points[:, 2] > 0.0, error, np.nan)


def _jacobian(light: Camera, from_camera: RigidTransform, samples: _Samples) -> Array:
    """Derivatives of `_residuals` by the projector's pose and its parameters, (N, 6 + P)."""
    points = from_camera.apply(samples.points)
    by_parameter, by_point = light.jacobians(points)
    by_pose = by_point[:, samples.axis, None, :] @ twist_jacobian(points)
    return np.concatenate([by_pose[:, 0], by_parameter[:, samples.axis]], axis=1)


def _with_misfit(found: FittedProjector, both: Sequence[_Samples]) -> FittedProjector:
    """Compute the projector's misfit. Raises BadInput if it is beyond three sigmas, RMS."""
    pose = found.projector_from_camera
    residuals = np.concatenate([_residuals(found.camera, pose, samples) for samples in both])
    sigma = np.concatenate([samples.sigma for samples in both])
    sigmas = rms(residuals / sigma)
    predicted = float(np.sqrt(len(sigma) / np.sum(sigma**-2.0)))
    misfit = predicted * sigmas
    if not sigmas < 3.0:
        raise BadInput(
            f"no projector with a lens explains its sheets of light: the best fit has an RMS misfit "
            f"of {misfit:.2g} of its pixels, the noise of the sheets explains {predicted:.2g}"
        )
    return replace(found, misfit_px=misfit, predicted_px=predicted)
