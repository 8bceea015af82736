"""Choose the lens that a camera needs by held-out boards, and estimate how well its rays are known.

A richer lens is chosen where it predicts held-out boards better than the simpler one by more than
chance. Poses of held-out boards are fitted with either lens, so that only the lens differs; boards
near one another are held out in one group.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from bodyscan.arrays import Array, Indices, Mask
from bodyscan.calibration.board_views import PlanarView, match_corners
from bodyscan.calibration.camera import (
    CameraCalibration,
    LensTrial,
    calibrate_camera,
    fit_camera,
    locate_boards,
    minimize_camera,
    weighted_rms,
)
from bodyscan.calibration.model_selection import (
    MAX_FOLDS,
    MIN_GAIN,
    ResidualPair,
    gain,
    shared_weights,
)
from bodyscan.geometry.camera import Camera
from bodyscan.geometry.lenses.lens import Lens
from bodyscan.geometry.transforms import RigidTransform, twist_jacobian
from bodyscan.geometry.uncertainty import RayUncertainty, node_pixels

MIN_CLUSTERS = 4
"""Clusters of poses: with one held out, a camera still has the three that it needs."""


@dataclass(frozen=True, eq=False)
class ChosenLens:
    """The chosen lens.

    fit: the camera fitted with it.
    trials: how each lens did; () if there were too few clusters of poses, or one lens only.
    rays: how well the boards determine each pixel's ray.
    refused: the fit with the lens tried last, if it was not taken.
    """

    fit: CameraCalibration
    trials: tuple[LensTrial, ...]
    rays: RayUncertainty
    refused: CameraCalibration | None = None


def calibrate_with_lenses(
    kinds: Sequence[type[Lens]], views: Sequence[PlanarView], width: int, height: int
) -> CameraCalibration:
    """Calibrate a camera like `calibrate_camera`, with the lens that held-out boards choose.

    kinds: lenses to choose from, simplest first.

    Raises DegeneratePoses as `calibrate_camera` does.
    """
    start = calibrate_camera(views, width, height, kinds[-1]())
    chosen = choose_lens(kinds, start.camera, start.poses, views)
    return replace(chosen.fit, lenses=chosen.trials, rays=chosen.rays)


def choose_lens(
    kinds: Sequence[type[Lens]],
    camera: Camera,
    poses: Sequence[RigidTransform],
    views: Sequence[PlanarView],
) -> ChosenLens:
    """Choose the simplest lens that no richer one clearly beats.

    kinds: simplest first, each with all coefficients of the one before and more.
    camera: a start, with the last kind of lens.
    poses: approximate `camera_from_board` of each view.
    """
    chosen = _fit(kinds[0], camera, poses, views)
    cluster = cluster_poses(views)
    if len(kinds) == 1 or len(set(cluster.tolist())) < MIN_CLUSTERS:
        richest = chosen if len(kinds) == 1 else _fit(kinds[1], camera, poses, views)
        return ChosenLens(chosen, (), ray_uncertainty(chosen.camera, richest, views))
    residuals = _hold_out(chosen, views, cluster)
    trials: list[tuple[CameraCalibration, Array, float | None]] = [(chosen, residuals, None)]
    corner_cluster = np.repeat(cluster, [len(view.points) for view in views])
    for kind in kinds[1:]:
        tried = _fit(kind, camera, poses, views)
        richer = _hold_out(tried, views, cluster)
        better_by = gain(ResidualPair(residuals, richer, corner_cluster))
        trials.append((tried, richer, better_by))
        if better_by < MIN_GAIN:
            break  # the next has all coefficients of this one, and more
        chosen, residuals = tried, richer
    weights = shared_weights([one for _, one, _ in trials])
    figures = tuple(
        LensTrial(fit.camera.lens.kind, weighted_rms(one, weights), better_by, fit is chosen)
        for fit, one, better_by in trials
    )
    last = trials[-1][0]
    rays = ray_uncertainty(chosen.camera, last, views)
    return ChosenLens(chosen, figures, rays, None if last is chosen else last)


def _fit(
    kind: type[Lens], camera: Camera, poses: Sequence[RigidTransform], views: Sequence[PlanarView]
) -> CameraCalibration:
    ideal = np.concatenate(
        [pose.apply(view.points) for pose, view in zip(poses, views, strict=True)]
    )
    lens = kind().fit_to(camera.lens, ideal[:, :2] / ideal[:, 2:])
    return fit_camera(replace(camera, lens=lens), poses, views)


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


def ray_uncertainty(
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
    rays = chosen.rays(node_pixels(camera.width, camera.height))
    valid: Mask = np.asarray(np.isfinite(rays).all(axis=-1))
    points = rays[valid] * np.median(corners[:, 2])
    by_nodes, by_corners = _changes(chosen, camera, points), _changes(chosen, camera, corners)
    change, motion = (part.reshape(-1, part.shape[2]) for part in by_corners)
    remaining = by_nodes[0] - by_nodes[1] @ np.linalg.lstsq(motion, change, rcond=None)[0]
    by_parameter, difference = remaining[..., :-1], remaining[..., -1]
    noise = np.einsum("npi,ij,npj->n", by_parameter, richest.covariance, by_parameter) / 2.0
    lens = np.sum(difference**2, axis=1) / 2.0
    return RayUncertainty(
        *(_on_all_nodes(np.sqrt(np.maximum(part, 0.0)), valid) for part in (noise, lens))
    )


def _changes(chosen: Camera, camera: Camera, points: Array) -> tuple[Array, Array]:
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


def _on_all_nodes(values: Array, valid: Mask) -> Array:
    """Spread values over all nodes; those without rays, where the lens folds, get the largest."""
    filled = np.full(valid.shape, values.max(initial=0.0))
    filled[valid] = values
    return filled
