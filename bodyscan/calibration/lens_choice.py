"""Choose the lens that a camera needs by held-out boards.

A richer lens is taken where it predicts held-out boards better than the simpler one by more than
chance. Poses of held-out boards are fitted with either lens, so that only the lens differs; boards
near one another are held out together.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from bodyscan.arrays import Array, Indices
from bodyscan.calibration.board_views import PlanarView
from bodyscan.calibration.camera import (
    CameraCalibration,
    CameraFit,
    LensTrial,
    fit_camera,
    fit_from_scratch,
    locate_boards,
    weighted_rms,
)
from bodyscan.calibration.held_out import CLEARLY, Compared, gain, shared_weights
from bodyscan.calibration.ray_uncertainty import ray_uncertainty
from bodyscan.geometry.camera import Camera
from bodyscan.geometry.lenses.lens import Lens
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.geometry.uncertainty import RayUncertainty

FEWEST_PLACES = 4
"""With one place held out, a camera still has the three that it needs."""
MOST_FOLDS = 6
SETTLED = 1e-2
"""Convergence, in variances: a tenth of a standard deviation changes nothing on held-out boards."""
UNDAMPED = 1e-9
"""Fits without a fold start close to their minimum, where full steps are right; damped ones creep
along directions in which boards hardly determine a lens."""
NEAR = 0.05
"""Boards share a place if corners moved by less than this share of the board's own size in the
image: they test the lens where it was tested before."""


@dataclass(frozen=True, eq=False)
class ChosenLens:
    """The chosen lens.

    fit: the camera fitted with it.
    trials: how each lens did; () if there were too few places, or one lens only.
    rays: how well the boards determine each pixel's ray.
    refused: the fit with the lens tried last, if it was not taken.
    """

    fit: CameraFit
    trials: tuple[LensTrial, ...]
    rays: RayUncertainty
    refused: CameraFit | None = None


@dataclass(frozen=True, eq=False)
class _HeldOut:
    """Residuals (N, 2) px of each view, from fits without it."""

    residuals: tuple[Array, ...]

    @property
    def stacked(self) -> Array:
        """(N, 2) of all views."""
        return np.concatenate(self.residuals)


def calibrate_with_lenses(
    kinds: Sequence[type[Lens]], views: Sequence[PlanarView], width: int, height: int
) -> CameraCalibration:
    """Calibrate a camera like `calibrate_camera`, with the lens that held-out boards choose.

    kinds: lenses to choose from, simplest first.

    Raises DegeneratePoses as `calibrate_camera` does.
    """
    start = fit_from_scratch(views, width, height, kinds[-1]())
    chosen = choose_lens(kinds, start.camera, start.poses, views)
    return replace(chosen.fit.calibration(views), lenses=chosen.trials, rays=chosen.rays)


def choose_lens(
    kinds: Sequence[type[Lens]],
    camera: Camera,
    poses: Sequence[RigidTransform],
    views: Sequence[PlanarView],
) -> ChosenLens:
    """The simplest lens that no richer one clearly beats.

    kinds: simplest first, each with all coefficients of the one before and more.
    camera: a start, with the last kind of lens.
    poses: approximate `camera_from_board` of each view.
    """
    chosen = _fit(kinds[0], camera, poses, views)
    place = places(views)
    if len(kinds) == 1 or len(set(place.tolist())) < FEWEST_PLACES:
        richest = chosen if len(kinds) == 1 else _fit(kinds[1], camera, poses, views)
        return ChosenLens(chosen, (), ray_uncertainty(chosen.camera, richest, views))
    held = _hold_out(chosen, views, place)
    trials: list[tuple[CameraFit, _HeldOut, float | None]] = [(chosen, held, None)]
    of_corner = np.repeat(place, [len(view.points) for view in views])
    for kind in kinds[1:]:
        tried = _fit(kind, camera, poses, views)
        out = _hold_out(tried, views, place)
        better_by = gain(Compared(held.stacked, out.stacked, of_corner))
        trials.append((tried, out, better_by))
        if better_by < CLEARLY:
            break  # the next has all coefficients of this one, and more
        chosen, held = tried, out
    weights = [shared_weights([out.stacked for _, out, _ in trials])]
    told = tuple(
        LensTrial(
            fit.camera.lens.kind, weighted_rms([out.stacked], weights), better_by, fit is chosen
        )
        for fit, out, better_by in trials
    )
    last = trials[-1][0]
    rays = ray_uncertainty(chosen.camera, last, views)
    return ChosenLens(chosen, told, rays, None if last is chosen else last)


def _fit(
    kind: type[Lens], camera: Camera, poses: Sequence[RigidTransform], views: Sequence[PlanarView]
) -> CameraFit:
    ideal = np.concatenate(
        [pose.apply(view.points) for pose, view in zip(poses, views, strict=True)]
    )
    lens = kind().fit_to(camera.lens, ideal[:, :2] / ideal[:, 2:])
    return fit_camera(replace(camera, lens=lens), poses, views)


def places(views: Sequence[PlanarView]) -> Indices:
    """Number (V,) of the place in the image at which each view shows its board; views of one shot
    share theirs."""
    found: list[PlanarView] = []
    number = np.zeros(len(views), np.int64)
    of_shot: dict[str, int] = {}
    for k, view in enumerate(views):
        near = (n for n, first in enumerate(found) if _near(first, view))
        number[k] = of_shot.get(view.shot, next(near, len(found)))
        of_shot.setdefault(view.shot, int(number[k]))
        found += [view] if number[k] == len(found) else []
    return number


def _near(first: PlanarView, second: PlanarView) -> bool:
    """Whether most of the corners seen in both views hardly moved."""
    number = {tuple(point): k for k, point in enumerate(np.round(first.points, 6).tolist())}
    both = [(number.get(tuple(p)), k) for k, p in enumerate(np.round(second.points, 6).tolist())]
    shared = np.array([pair for pair in both if pair[0] is not None])
    if not len(shared):
        return False
    moved = np.linalg.norm(first.pixels[shared[:, 0]] - second.pixels[shared[:, 1]], axis=1)
    return bool(np.median(moved) < NEAR * np.linalg.norm(np.ptp(first.pixels, axis=0)))


def _hold_out(fit: CameraFit, views: Sequence[PlanarView], place: Indices) -> _HeldOut:
    """Leave out each place, or one of MOST_FOLDS groups of them, in turn; fits start from `fit`."""
    residuals: list[Array] = [np.empty(0)] * len(views)
    fold = place % MOST_FOLDS
    for number in np.unique(fold):
        rest = np.flatnonzero(fold != number).tolist()
        others = fit_camera(
            fit.camera,
            [fit.poses[k] for k in rest],
            [views[k] for k in rest],
            settled=SETTLED,
            damping=UNDAMPED,
        ).camera
        held = np.flatnonzero(fold == number).tolist()
        own, starts = [views[k] for k in held], [fit.poses[k] for k in held]
        found = locate_boards(others, own, starts, settled=SETTLED)[1]
        for k, left in zip(held, found, strict=True):
            residuals[k] = left
    return _HeldOut(tuple(residuals))
