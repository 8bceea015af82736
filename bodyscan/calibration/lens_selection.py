"""Choose a camera's lens: the one that predicts held-out boards best, and what stays open of its rays.

Poses of held-out boards are fitted with either lens, so that only the lens differs; boards near one
another are held out in one group.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from bodyscan.arrays import Array, Indices, Mask
from bodyscan.calibration.board_views import PlanarView, match_corners
from bodyscan.calibration.camera import (
    CameraCalibration,
    calibrate_camera,
    compute_corner_residuals,
    compute_weighted_rms,
    fit_camera,
    locate_boards,
    minimize_camera,
)
from bodyscan.calibration.model_selection import (
    MAX_FOLDS,
    MIN_GAIN,
    ResidualPair,
    compute_shared_weights,
    gain,
)
from bodyscan.geometry.camera import Camera
from bodyscan.geometry.lenses.fisheye import Fisheye
from bodyscan.geometry.lenses.lens import Lens
from bodyscan.geometry.lenses.opencv import Brown, Rational
from bodyscan.geometry.transforms import RigidTransform, twist_jacobian
from bodyscan.geometry.uncertainty import RayUncertainty, list_node_pixels

MIN_CLUSTERS = 4
"""Clusters of poses: with one held out, a camera still has the three that it needs."""


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
    first_px, second_px = (compute_corner_residuals(fit, views) for fit in (first, second))
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
    """Changes of pixels at points (N, 3), camera frame. (N, 2, P + 1): by the parameters of `camera`,
    and its difference from `chosen`. (N, 2, 6): by a motion of the points."""
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
