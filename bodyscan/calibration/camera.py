"""Calibrate a camera and its board poses by maximum likelihood, with covariance (3.1); choose its lens.

The lens is chosen that predicts held-out boards best. Poses of held-out boards are fitted with either
lens, so that only the lens differs; boards near one another are held out in one group.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from bodyscan.arrays import Array, Indices, Mask
from bodyscan.calibration.board_views import PlanarView, match_corners
from bodyscan.calibration.model_selection import (
    MAX_FOLDS,
    MIN_GAIN,
    ResidualPair,
    compute_shared_weights,
    gain,
)
from bodyscan.calibration.zhang import matrix_from_homographies
from bodyscan.errors import DegeneratePoses
from bodyscan.geometry.camera import MATRIX, Camera
from bodyscan.geometry.least_squares import EXACT, Block, Noise, Solution, minimize
from bodyscan.geometry.lenses.fisheye import Fisheye
from bodyscan.geometry.lenses.lens import Lens
from bodyscan.geometry.lenses.opencv import Brown, Radial, Rational
from bodyscan.geometry.transforms import RigidTransform, twist_jacobian
from bodyscan.geometry.uncertainty import RayUncertainty, list_node_pixels

MIN_POSES = 3
CHAPTER_LENS = Radial()
CORNERS = Noise("corners", group=2, cauchy=4.0)


@dataclass(frozen=True)
class LensTrial:
    """How one kind of lens did on held-out boards."""

    kind: str
    rms_px: float  # RMS error of their corners, px, robustly weighted
    # Standard errors by which it beat the lens chosen so far; None for the first.
    gain: float | None = None
    chosen: bool = False

    @property
    def is_open(self) -> bool:
        """Whether held-out boards speak neither for this lens nor against it."""
        return self.gain is not None and abs(self.gain) < MIN_GAIN


@dataclass(frozen=True, eq=False)
class CameraCalibration:
    """A calibrated camera."""

    camera: Camera
    covariance: Array  # of the camera's parameters, (P, P)
    poses: tuple[RigidTransform, ...]  # `camera_from_board` of each view that it was fitted to
    rms_px: float  # RMS distance of corners from their reprojection, robustly weighted


@dataclass(frozen=True, eq=False)
class _State:
    camera: Camera
    poses: tuple[RigidTransform, ...]

    def retract(self, step: Array) -> _State:
        size = len(self.camera.parameters)
        return _State(self.camera.retract(step[:size]), self.retract_poses(step[size:]).poses)

    def retract_poses(self, step: Array) -> _State:
        twists = zip(self.poses, step.reshape(-1, 6), strict=True)
        return _State(self.camera, tuple(pose.retract(twist) for pose, twist in twists))


def calibrate_camera(
    views: Sequence[PlanarView], width: int, height: int, lens: Lens = CHAPTER_LENS
) -> CameraCalibration:
    """Calibrate a camera from planes, with skew and a lens of the kind of `lens`, the start.

    Started by Zhang's closed form. Raises DegeneratePoses for fewer than three poses, or poses that
    differ only by a translation.
    """
    if len(views) < MIN_POSES:
        raise DegeneratePoses(
            f"{len(views)} usable board poses, at least {MIN_POSES} are needed",
            remedy="capture the board in more poses, tilted differently, well inside the image",
        )
    homographies = [find_homography(view) for view in views]
    refuse_parallel(homographies, width, height)
    matrix = matrix_from_homographies(homographies, width, height)
    alpha, gamma, u0, _, beta, v0 = matrix[:2].ravel()
    start = Camera(alpha, beta, gamma, u0, v0, type(lens)(), width, height)
    poses = [estimate_pose(start, view) for view in views]
    return fit_camera(replace(start, lens=lens), poses, views)


def find_homography(view: PlanarView) -> Array:
    """H (3, 3), pixels ~ H (x, y, 1), of a view's corners."""
    return np.asarray(cv2.findHomography(view.points[:, :2], view.pixels, 0)[0])


def refuse_parallel(homographies: Sequence[Array], width: int, height: int) -> None:
    """Raise DegeneratePoses if all boards have one orientation (pure translation, Zhang 1998).

    Parallel planes share their vanishing line, which a rough camera turns into a plane normal.
    """
    rough = np.array([[1.2 * width, 0, width / 2], [0, 1.2 * width, height / 2], [0, 0, 1.0]])
    normals = np.stack([np.linalg.inv(h).T[:, 2] for h in homographies]) @ rough
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    angles = np.degrees(np.arccos(np.clip(np.abs(normals @ normals.T), 0.0, 1.0)))
    if np.max(angles) < 3.0:
        raise DegeneratePoses(
            f"the {len(homographies)} board poses differ by a translation only "
            f"(their orientations agree within {np.max(angles):.1f} degrees)",
            remedy="tilt the board by 15 to 35 degrees about different axes between the shots",
        )


def calibrate_known_camera(views: Sequence[PlanarView], camera: Camera) -> CameraCalibration:
    """Refine a camera with a prior on its views, within that prior; one view is enough.

    Raises DegeneratePoses if there is no view.
    """
    if not views:
        raise DegeneratePoses(
            "no board view of a camera that is known has enough corners",
            remedy="show it the board in a shot that others see too",
        )
    poses = [locate_board(camera, view)[0] for view in views]
    return fit_camera(camera, poses, views)


def fit_camera(
    camera: Camera, poses: Sequence[RigidTransform], views: Sequence[PlanarView]
) -> CameraCalibration:
    """Fit camera and `camera_from_board` of each view by least squares, starting from those given."""
    solution = minimize_camera(camera, poses, views)
    size, corners = len(camera.parameters), solution.blocks[0]
    return CameraCalibration(
        solution.state.camera,
        solution.variance * solution.covariance[:size, :size],
        solution.state.poses,
        compute_weighted_rms(corners.residuals.reshape(-1, 2), solution.weights[0][::2]),
    )


def minimize_camera(
    camera: Camera,
    poses: Sequence[RigidTransform],
    views: Sequence[PlanarView],
    *,
    tolerance: float = 1e-6,
    damping: float = 1e-3,
) -> Solution[_State]:
    """Minimise the corners' reprojection errors over camera and poses; see `minimize`."""
    size = len(camera.parameters)
    return minimize(
        _State(camera, tuple(poses)),
        lambda state: [
            _make_corner_block(state, views),
            evaluate_camera_prior(state.camera, np.arange(size)),
        ],
        _State.retract,
        unknowns=size + 6 * len(views),
        tolerance=tolerance,
        damping=damping,
    )


def compute_weighted_rms(residuals: Array, weights: Array) -> float:
    """Compute the weighted RMS length of residuals (N, 2)."""
    return float(np.sqrt(np.sum(weights * np.sum(residuals**2, axis=1)) / np.sum(weights)))


def evaluate_camera_prior(camera: Camera, columns: Indices) -> Block:
    """Residuals of the prior of a camera: the one it has, otherwise that its lens distorts little.

    The latter keeps coefficients that the boards do not determine, or only their sum, from growing
    without limit. columns: indices of the camera's parameters among the unknowns.
    """
    if camera.prior is None:
        weights = 1.0 / camera.lens.prior_sigmas
        residuals = weights * camera.lens.coefficients
        return Block(residuals, lambda: np.diag(weights), columns[len(MATRIX) :], EXACT)
    weights = 1.0 / camera.prior.sigmas
    residuals = weights * (camera.parameters - camera.prior.parameters)
    return Block(residuals, lambda: np.diag(weights), columns, EXACT)


def locate_board(camera: Camera, view: PlanarView) -> tuple[RigidTransform, Array]:
    """Fit `camera_from_board` of one view with a known camera; also return residuals (N, 2) px."""
    (pose,), (residuals,) = locate_boards(camera, [view], [estimate_pose(camera, view)])
    return pose, residuals


def estimate_pose(camera: Camera, view: PlanarView) -> RigidTransform:
    """Estimate `camera_from_board` of one view in closed form: a start for `locate_boards`.

    Source: Terzakis and Lourakis, A Consistently Fast and Globally Optimal Solution to the
    Perspective-n-Point Problem, ECCV 2020 (OpenCV's).
    """
    # Where the lens folds there is no ray: use the pixel with the lens ignored.
    rays = camera.rays(view.pixels)[:, :2]
    normalized = np.where(np.isfinite(rays), rays, camera.normalized_from_pixels(view.pixels))
    flags = cv2.SOLVEPNP_SQPNP
    _, turn, shift = cv2.solvePnP(view.points, normalized, np.eye(3), None, flags=flags)
    return RigidTransform.from_rotation_vector(turn, shift.ravel())


def locate_boards(
    camera: Camera,
    views: Sequence[PlanarView],
    starts: Sequence[RigidTransform],
    *,
    tolerance: float = 1e-6,
) -> tuple[tuple[RigidTransform, ...], tuple[Array, ...]]:
    """Fit `camera_from_board` of each view with a known camera; also return residuals (N, 2) px.

    All corners share one noise level.
    """
    solution = minimize(
        _State(camera, tuple(starts)),
        lambda state: [_make_corner_block(state, views, camera_free=False)],
        _State.retract_poses,
        unknowns=6 * len(views),
        steps=30,
        tolerance=tolerance,
    )
    ends = np.cumsum([len(view.points) for view in views])[:-1]
    residuals = solution.blocks[0].residuals.reshape(-1, 2)
    return solution.state.poses, tuple(np.split(residuals, ends))


def _make_corner_block(
    state: _State, views: Sequence[PlanarView], *, camera_free: bool = True
) -> Block:
    """Reprojection errors, px, one run for each view.

    Derivatives are by the camera's parameters, which come first if free, and by the board's pose.
    """
    points = np.concatenate(
        [pose.apply(view.points) for pose, view in zip(state.poses, views, strict=True)]
    )
    pixels = np.concatenate([view.pixels for view in views])
    camera = state.camera
    size = len(camera.parameters) if camera_free else 0
    boards = size + np.arange(6 * len(views)).reshape(-1, 6)

    def linearize() -> Array:
        by_parameter, by_point = camera.jacobians(points)
        by_pose = by_point @ twist_jacobian(points)
        return np.concatenate([by_parameter[..., :size], by_pose], axis=2).reshape(-1, size + 6)

    return Block(
        (camera.project(points) - pixels).ravel(),
        linearize,
        np.column_stack([np.tile(np.arange(size), (len(views), 1)), boards]),
        CORNERS,
        runs=np.array([2 * len(view.points) for view in views]),
    )


MIN_CLUSTERS = 4
"""Clusters of poses: with one held out, a camera still has the three that it needs."""


@dataclass(frozen=True, eq=False)
class ChosenLens:
    """The selected lens, its fit, and the trials of the others."""

    fit: CameraCalibration  # the camera fitted with it
    # How each lens did; () if there were too few clusters of poses, or one lens only.
    trials: tuple[LensTrial, ...]
    tried: tuple[CameraCalibration, ...]  # the fit of each trial
    rays: RayUncertainty  # how well the boards determine each pixel's ray


def calibrate_widest(
    kinds: Sequence[type[Lens]], views: Sequence[PlanarView], width: int, height: int
) -> CameraCalibration:
    """Calibrate a camera like `calibrate_camera`, with the lens that fits most of its corners: the
    richest; of a wide one a fisheye, unless that is clearly worse.

    kinds: lenses to choose from, as in `FAMILY`.

    Raises DegeneratePoses as `calibrate_camera` does.
    """
    ordinary = [kind for kind in kinds if kind is not Fisheye]
    fits = [calibrate_camera(views, width, height, kind()) for kind in ordinary[-1:]]
    if Fisheye in kinds:
        fits.append(calibrate_camera(views, width, height, Fisheye()))
    whole = [fit for fit in fits if not _folds(fit, views)]
    if not whole:  # boards that leave the richest open beyond them may still show a simpler one
        simpler = (calibrate_camera(views, width, height, kind()) for kind in ordinary[-2::-1])
        whole = [next((fit for fit in simpler if not _folds(fit, views)), fits[0])]
    if len(whole) == 1:
        return whole[0]
    needed = -MIN_GAIN if _is_wide(fits[1].camera, views) else MIN_GAIN
    better_by = gain(_compare_fits(fits[0], fits[1], views, cluster_poses(views)))
    return fits[1] if better_by > needed else fits[0]


def choose_lens(
    kinds: Sequence[type[Lens]],
    camera: Camera,
    poses: Sequence[RigidTransform],
    views: Sequence[PlanarView],
) -> ChosenLens:
    """Choose the lens that predicts held-out boards best.

    Brown's lens needs no margin: what it adds needlessly is in its covariance, what the chapter's lacks
    is in none. A rational lens, which runs away beyond its boards, has to be clearly better; a fisheye
    in its place only as good.

    kinds: simplest first, as in `FAMILY`.
    camera: a start, with the lens that fits most of the corners.
    poses: approximate `camera_from_board` of each view.
    """
    chosen = _fit(kinds[0], camera, poses, views)
    cluster = cluster_poses(views)
    if len(kinds) == 1 or len(set(cluster.tolist())) < MIN_CLUSTERS:
        richest = chosen if len(kinds) == 1 else _fit(kinds[1], camera, poses, views)
        return ChosenLens(chosen, (), (), estimate_ray_uncertainty(chosen.camera, richest, views))
    residuals = _hold_out(chosen, views, cluster)
    trials: list[tuple[CameraCalibration, Array, float | None]] = [(chosen, residuals, None)]
    corner_cluster = _repeat_by_corner(cluster, views)
    for kind in kinds[1:]:
        if kind is Fisheye and not _is_wide(camera, views):
            continue
        tried = _fit(kind, camera, poses, views)
        if _folds(tried, views):
            continue
        # A fisheye has half of a rational lens's coefficients: where it does as well, it is right. So
        # is what does as well and has rays where the other folds.
        simpler = kind is Fisheye and type(chosen.camera.lens) is Rational
        simpler |= tried.camera.ray_share() > chosen.camera.ray_share() + 0.05
        # Whether Brown's was close is asked for all cameras of a make together.
        needed = simpler or kind is kinds[1]
        if not needed and gain(_compare_fits(chosen, tried, views, cluster)) < MIN_GAIN:
            continue  # what gains nothing on its own boards gains less on others
        held_out = _hold_out(tried, views, cluster)
        better_by = gain(ResidualPair(residuals, held_out, corner_cluster))
        trials.append((tried, held_out, better_by))
        if better_by >= (-MIN_GAIN if simpler else 0.0 if kind is Brown else MIN_GAIN):
            chosen, residuals = tried, held_out
    weights = compute_shared_weights([one for _, one, _ in trials])
    figures = tuple(
        LensTrial(
            fit.camera.lens.kind, compute_weighted_rms(one, weights), better_by, fit is chosen
        )
        for fit, one, better_by in trials
    )
    tried_fits = tuple(fit for fit, _, _ in trials)
    after = tried_fits.index(chosen) + 1
    open_ = (f for f, t in zip(tried_fits[after:], figures[after:], strict=True) if t.is_open)
    rays = estimate_ray_uncertainty(chosen.camera, next(open_, chosen), views)
    return ChosenLens(chosen, figures, tried_fits, rays)


def _fit(
    kind: type[Lens], camera: Camera, poses: Sequence[RigidTransform], views: Sequence[PlanarView]
) -> CameraCalibration:
    ideal = np.concatenate(
        [pose.apply(view.points) for pose, view in zip(poses, views, strict=True)]
    )
    lens = kind().fit_to(camera.lens, ideal[:, :2] / ideal[:, 2:])
    return fit_camera(replace(camera, lens=lens), poses, views)


def _compare_fits(
    first: CameraCalibration,
    second: CameraCalibration,
    views: Sequence[PlanarView],
    cluster: Indices,
) -> ResidualPair:
    """Residuals of the same views in two fits to them."""
    first_px, second_px = (
        _make_corner_block(_State(fit.camera, fit.poses), views).residuals.reshape(-1, 2)
        for fit in (first, second)
    )
    return ResidualPair(first_px, second_px, _repeat_by_corner(cluster, views))


def _folds(fit: CameraCalibration, views: Sequence[PlanarView]) -> bool:
    """Whether a lens folds over before the outermost corner, or over most of the picture: what it does
    there is no camera's."""
    valid = np.isfinite(_compute_corner_rays(fit.camera, views)).all()
    return not valid or fit.camera.folds


def _is_wide(camera: Camera, views: Sequence[PlanarView]) -> bool:
    """Whether some corner is more than 60 degrees off the axis, where r^6 is 27: there lenses that go
    by the tangent run away, and elsewhere decentring, which a fisheye lacks, must not hide."""
    radius = np.linalg.norm(_compute_corner_rays(camera, views)[:, :2], axis=1)
    return bool(np.any(radius > 1.73))


def _compute_corner_rays(camera: Camera, views: Sequence[PlanarView]) -> Array:
    """Rays (N, 3) of all corners, z = 1; NaN where the lens folds."""
    return camera.rays(np.concatenate([view.pixels for view in views]))


def _repeat_by_corner(number: Indices, views: Sequence[PlanarView]) -> Indices:
    """Numbers (N,) of all corners from those (V,) of their views."""
    return np.repeat(number, [len(view.points) for view in views])


def cluster_poses(views: Sequence[PlanarView]) -> Indices:
    """Number (V,) the clusters of views that show their board at nearly the same pixels; views of
    one shot share theirs."""
    found: list[PlanarView] = []
    number = np.zeros(len(views), np.int64)
    by_shot: dict[str, int] = {}
    for k, view in enumerate(views):
        near = (n for n, first in enumerate(found) if _near(first, view))
        number[k] = by_shot.get(view.shot, next(near, len(found)))
        by_shot.setdefault(view.shot, int(number[k]))
        found += [view] if number[k] == len(found) else []
    return number


def _near(first: PlanarView, second: PlanarView) -> bool:
    """Whether corners in both views moved by less than 5 % of the board's size in the image, in the
    median: they test the lens at the same pixels."""
    index = match_corners(second.points, first.points)
    if not np.any(index >= 0):
        return False
    moved = np.linalg.norm(first.pixels[index[index >= 0]] - second.pixels[index >= 0], axis=1)
    return bool(np.median(moved) < 0.05 * np.linalg.norm(np.ptp(first.pixels, axis=0)))


def _hold_out(fit: CameraCalibration, views: Sequence[PlanarView], cluster: Indices) -> Array:
    """Residuals (N, 2) px of all views, from fits without their cluster, or one of MAX_FOLDS groups
    of clusters, that start from `fit`."""
    residuals: list[Array] = [np.empty(0)] * len(views)
    fold = cluster % MAX_FOLDS
    for number in np.unique(fold):
        rest = np.flatnonzero(fold != number).tolist()
        # A tenth of a standard deviation changes nothing on held-out boards. Fits start close to
        # their minimum, where full steps are right; damped ones creep along directions in which
        # boards hardly determine a lens.
        others = minimize_camera(
            fit.camera,
            [fit.poses[k] for k in rest],
            [views[k] for k in rest],
            tolerance=1e-2,
            damping=1e-9,
        ).state.camera
        held_out = np.flatnonzero(fold == number).tolist()
        found = locate_boards(
            others, [views[k] for k in held_out], [fit.poses[k] for k in held_out], tolerance=1e-2
        )
        for k, remaining in zip(held_out, found[1], strict=True):
            residuals[k] = remaining
    return np.concatenate(residuals)


def estimate_ray_uncertainty(
    chosen: Camera, richest: CameraCalibration, views: Sequence[PlanarView]
) -> RayUncertainty:
    """Estimate the uncertainty of the rays of the camera `chosen`, also where boards did not reach.

    richest: a fit to the same views with the richest lens that held-out boards cannot distinguish
        from the chosen one, or the chosen fit itself.

    Its covariance contains what the boards leave open, even far from them, where the chosen lens
    would extrapolate; and the chosen lens may be wrong by as much as the two differ. A motion of the
    camera relative to its boards is removed from both: it belongs to the pose and is in the pose's
    covariance.
    """
    camera = richest.camera
    corners = np.concatenate(
        [pose.apply(view.points) for pose, view in zip(richest.poses, views, strict=True)]
    )
    corners = corners[:: -(-len(corners) // 3000)]
    rays = chosen.rays(list_node_pixels(camera.width, camera.height))
    valid: Mask = np.asarray(np.isfinite(rays).all(axis=-1))
    points = rays[valid] * np.median(corners[:, 2])
    by_nodes, by_corners = (
        _compute_changes(chosen, camera, points),
        _compute_changes(chosen, camera, corners),
    )
    change, motion = (part.reshape(-1, part.shape[2]) for part in by_corners)
    remaining = by_nodes[0] - by_nodes[1] @ np.linalg.lstsq(motion, change, rcond=None)[0]
    by_parameter, difference = remaining[..., :-1], remaining[..., -1]
    noise = np.einsum("npi,ij,npj->n", by_parameter, richest.covariance, by_parameter) / 2.0
    lens = np.sum(difference**2, axis=1) / 2.0
    return RayUncertainty(
        *(_fill_nodes(np.sqrt(np.maximum(part, 0.0)), valid) for part in (noise, lens))
    )


def _compute_changes(chosen: Camera, camera: Camera, points: Array) -> tuple[Array, Array]:
    """Changes of pixels at points (N, 3), camera frame.

    (N, 2, P + 1): by the parameters of `camera`, and its difference from `chosen`.
    (N, 2, 6): by a motion of the points.
    """
    by_parameter, by_point = camera.jacobians(points)
    difference = camera.project(points) - chosen.project(points)
    return (
        np.concatenate([by_parameter, difference[..., None]], axis=2),
        by_point @ twist_jacobian(points),
    )


def _fill_nodes(values: Array, valid: Mask) -> Array:
    """Give values to all nodes; those without rays, where the lens folds, get the largest."""
    filled = np.full(valid.shape, values.max(initial=0.0))
    filled[valid] = values
    return filled
