"""A projector described as a camera with a lens, as other programs do: its light sheets, and back.

A camera's pixel (u, v) has its centre at whole numbers, while a stripe begins at them: the
projector's column u is s = (u + 1/2) / w with w its pixels per stripe, and likewise its row v.

Light sheets of one direction that held-out boards found to be a projector with a lens are one as they
are. Both directions of stripes belong to one projector: it is fitted to samples of both.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from bodyscan.arrays import Array
from bodyscan.errors import BadInput
from bodyscan.geometry.camera import MATRIX, Camera
from bodyscan.geometry.lens_sheets import CENTRE, FRAME, SCALE, LensSheets
from bodyscan.geometry.lenses import lens_from_opencv
from bodyscan.geometry.lenses.opencv import Brown
from bodyscan.geometry.light_planes import Axis, LightSheets
from bodyscan.geometry.robust import rms
from bodyscan.geometry.transforms import RigidTransform


def sheets_from_projector(
    projector: Camera,
    projector_from_camera: RigidTransform,
    middle: Array,
    stripes: int,
    direction: Axis,
    sigma_px: float = 0.0,
) -> LensSheets:
    """The sheets of `stripes` stripes that divide the projector's image, in the camera's frame.

    projector: its image size is that of all stripes together.
    middle: (3,) mm, camera frame, roughly what is looked at.
    sigma_px: by how many projector pixels all sheets may be off together.

    Raises BadInput for a lens that OpenCV does not have.

    The stripe coordinate needs one row of A, (fx, skew) or (0, fy). Rotated about its axis so that
    this row becomes y, a projector with OpenCV's lens again has such a lens: its tangential part is
    r^2 q + 2 (q . x) x with q = (p2, p1), and q rotates as x does.
    """
    row, centre, size = _select_across_stripes(projector, direction)
    focal = float(np.linalg.norm(row))
    across = row / focal
    along = np.array([across[1], -across[0]])
    turn = np.eye(3)
    turn[0, :2], turn[1, :2] = along, across
    width = size / stripes
    lens = np.zeros(8)
    coefficients = projector.lens.opencv()[: len(lens)]
    lens[: len(coefficients)] = coefficients
    tangential = lens[[3, 2]]
    lens[2], lens[3] = across @ tangential, along @ tangential
    terms = 0 if not lens.any() else 4 if not lens[4:].any() else 5 if not lens[5:].any() else 8
    parameters = np.array([focal / width, (centre + 0.5) / width, *lens[:terms]])
    covariance = np.zeros((FRAME + SCALE + terms,) * 2)
    covariance[CENTRE, CENTRE] = (sigma_px / width) ** 2
    frame = RigidTransform(turn, np.zeros(3)) @ projector_from_camera
    return LensSheets(frame, middle, stripes, direction, parameters, covariance)


def projector_from_sheets(sheets: LensSheets) -> tuple[Camera, RigidTransform]:
    """The inverse: the projector as a camera with one pixel per stripe, and
    `projector_from_camera`.

    Exact across the stripes. One direction of stripes carries no information along them, so the
    image is assumed to be square, with square pixels and its axis in the middle.
    """
    focal, centre = sheets.parameters[:SCALE].tolist()
    terms = sheets.parameters[SCALE:]
    coefficients = np.zeros(max(len(terms), 5))
    coefficients[: len(terms)] = terms
    frame, size = sheets.projector_from_camera, sheets.stripes
    u0 = v0 = 0.5 * (size - 1.0)
    if sheets.direction == "vertical":
        turn = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
        frame = RigidTransform(turn, np.zeros(3)) @ frame
        coefficients[[2, 3]] = -coefficients[3], coefficients[2]
        u0 = centre - 0.5
    else:
        v0 = centre - 0.5
    return Camera(focal, focal, 0.0, u0, v0, lens_from_opencv(coefficients), size, size), frame


def intersect_central_rays(
    camera: Camera, projector: Camera, projector_from_camera: RigidTransform
) -> Array:
    """The point (3,) mm, camera frame, on the ray through the middle of the camera's image that is
    nearest to the ray through the middle of the projector's."""
    camera_from_projector = projector_from_camera.inverse()
    ray = _compute_central_ray(camera)
    light = camera_from_projector.rotate(_compute_central_ray(projector))
    start = camera_from_projector.translation
    # depth * ray - (start + reach * light) is perpendicular to both
    normal = np.array([[ray @ ray, -ray @ light], [ray @ light, -light @ light]])
    baseline = float(np.linalg.norm(start))
    depth, reach = np.full(2, np.nan)
    if abs(np.linalg.det(normal)) > 1e-6:
        depth, reach = np.linalg.solve(normal, np.array([ray @ start, light @ start]))
    meets = min(depth, reach) > 0.5 * baseline
    # If the axes do not meet, the view is assumed to be five baselines away.
    return np.asarray(ray * (depth if meets else 5.0 * baseline), float)


def _select_across_stripes(projector: Camera, direction: Axis) -> tuple[Array, float, int]:
    """The row of A that gives the coordinate across the stripes, its centre, and the image size
    there."""
    if direction == "vertical":
        return np.array([projector.alpha, projector.gamma]), projector.u0, projector.width
    return np.array([0.0, projector.beta]), projector.v0, projector.height


def _compute_central_ray(camera: Camera) -> Array:
    middle = 0.5 * np.array([camera.width - 1.0, camera.height - 1.0])
    ray: Array = camera.rays(middle)
    return ray / np.linalg.norm(ray)


POSE = 6  # unknowns of the projector's pose, before those of its camera model


@dataclass(frozen=True, eq=False)
class FittedProjector:
    """A projector as a camera."""

    camera: Camera  # the projector, with one pixel for each stripe
    projector_from_camera: RigidTransform  # mm
    # RMS distance of the pair's sheets from the projector's, weighted by their sigmas.
    misfit_px: float = 0.0
    # What their noise alone gives. Both are 0 where the projector is exact.
    predicted_px: float = 0.0


@dataclass(frozen=True, eq=False)
class _Samples:
    """Points (N, 3) mm, camera frame, on the sheets at s (N,), with sigma (N,) in stripes."""

    points: Array
    s: Array
    sigma: Array
    axis: int  # 0 for columns of the projector (vertical stripes), 1 for rows


def fit_projector(
    camera: Camera, light: LightSheets, crossing: LightSheets | None = None
) -> FittedProjector:
    """The projector of light sheets; of both directions, fitted with k1, k2, p1, p2, or more if the
    sheets have more.

    With a single direction of stripes its pixels are square and its position along the stripes is
    unknown: see `projector_from_sheets`. Raises BadInput for sheets of another model, if no projector
    explains both within their noise, or only one whose image is mirrored.
    """
    for sheets in (light, crossing or light):
        if not isinstance(sheets, LensSheets):
            raise BadInput(
                f"the chosen sheet model is {sheets.kind}; only the lens model can be written as a "
                "camera"
            )
    assert isinstance(light, LensSheets)
    projector, from_camera = projector_from_sheets(light)
    if not isinstance(crossing, LensSheets):
        return FittedProjector(projector, from_camera)
    both = [_sample(camera, light), _sample(camera, crossing)]
    projector = _with_crossing_axis(projector, from_camera, both[1], crossing.stripes)
    if len(projector.lens.names) < 5:
        projector = replace(projector, lens=Brown.from_opencv(projector.lens.opencv()) or Brown())
    terms = max(len(light.parameters), len(crossing.parameters)) - 2
    return _refine(projector, from_camera, both, max(terms, 4))


def _sample(camera: Camera, sheets: LensSheets) -> _Samples:
    """Sample sheets over the camera's image, at 0.7 to 1.4 times the distance of the boards."""
    u, v = np.linspace(0.0, camera.width - 1.0, 14), np.linspace(0, camera.height - 1.0, 11)
    rays = camera.rays(np.stack(np.meshgrid(u, v), axis=-1)).reshape(-1, 1, 3)
    points = (rays * (sheets.middle[2] * np.linspace(0.7, 1.4, 5)[:, None])).reshape(-1, 3)
    points = points[np.isfinite(points).all(axis=1)]
    offset = sheets.offset(points, np.zeros(len(points)), parameters=True)
    s, jacobian = offset.value, offset.by_parameter
    assert jacobian is not None
    sigma = np.sqrt(np.sum((jacobian @ sheets.covariance) * jacobian, axis=1))
    known = (offset.reach > 0.0) & (s > 0.0) & (s < sheets.stripes) & np.isfinite(sigma)
    if known.sum() < 50:
        raise BadInput(
            f"its light sheets are known at {known.sum()} of {len(points)} points in its camera's "
            "view, too few for a projector with a lens",
            remedy="calibrate the pair with boards over more of its image",
        )
    axis = 0 if sheets.direction == "vertical" else 1
    # The floor is a fifth of what the best codes leave uncertain in a pixel of the camera.
    return _Samples(points[known], s[known], np.hypot(sigma[known], 0.02), axis)


def _with_crossing_axis(
    projector: Camera, from_camera: RigidTransform, other: _Samples, stripes: int
) -> Camera:
    """Fit focal length and centre along the axis of the crossing stripes, and set its size."""
    points = from_camera.apply(other.points)
    real = projector.lens.distort(points[:, :2] / points[:, 2:])[:, other.axis]
    focal, centre = np.polyfit(real, other.s - 0.5, 1, w=1.0 / other.sigma).tolist()
    if focal <= 0.0:
        raise BadInput(
            "row and column codes form a mirrored image",
            remedy="reverse the pattern order of one direction, if nothing flips the projector's image",
        )
    if other.axis == 0:
        return replace(projector, alpha=focal, u0=centre, width=stripes)
    return replace(projector, beta=focal, v0=centre, height=stripes)


def _refine(
    projector: Camera, from_camera: RigidTransform, both: Sequence[_Samples], terms: int
) -> FittedProjector:
    """Fit pose, focal lengths, centre and the first `terms` of the lens jointly, without skew. Raises
    BadInput if the misfit is beyond three sigmas, RMS."""
    size, first_term = POSE + len(projector.parameters), POSE + len(MATRIX)
    free = np.setdiff1d(np.arange(first_term + terms), [POSE + MATRIX.index("gamma")])
    priors = projector.lens.prior_sigmas[:terms]

    def perturb(step: Array) -> tuple[Camera, RigidTransform]:
        whole = np.zeros(size)
        whole[free] = step
        return projector.retract(whole[POSE:]), from_camera.retract(whole[:POSE])

    def errors(step: Array) -> Array:
        """In sigmas: of the sheets across the stripes, then of the lens from its prior."""
        light, pose = perturb(step)
        return np.concatenate(
            [*(_compute_errors(light, pose, s) for s in both), step[-terms:] / priors]
        )

    from scipy.optimize import least_squares  # imported here because scans do not need it

    solved = least_squares(errors, np.zeros(len(free)), x_scale="jac", xtol=1e-12, ftol=1e-12)
    sigma = np.concatenate([samples.sigma for samples in both])
    misfit = rms(solved.fun[:-terms])
    predicted = float(np.sqrt(len(sigma) / np.sum(sigma**-2.0)))
    if not misfit < 3.0:
        raise BadInput(
            f"no lens model fits the projector's light sheets: RMS {predicted * misfit:.2g} projector "
            f"px, {predicted:.2g} px expected from noise"
        )
    return FittedProjector(*perturb(solved.x), predicted * misfit, predicted)


def _compute_errors(light: Camera, from_camera: RigidTransform, samples: _Samples) -> Array:
    """Reprojection errors across the stripes (N,) in sigmas; far off behind the projector."""
    points = from_camera.apply(samples.points)
    with np.errstate(all="ignore"):
        error = (light.project(points)[:, samples.axis] - (samples.s - 0.5)) / samples.sigma
    return np.where(points[:, 2] > 0.0, error, 1e6)
