"""The light of every pair: its stripes on the boards that the rig has placed, and sheets fitted."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from bodyscan.calibration.boundary_points import BoundaryPoints, binned
from bodyscan.calibration.camera import CameraCalibration, PlanarView
from bodyscan.calibration.joint_refinement import striped_board
from bodyscan.calibration.light import fit_light
from bodyscan.calibration.located_view import LocatedView
from bodyscan.calibration.pair import (
    BoardBoundaries,
    PairCalibration,
    PairQuality,
    boundaries_on_boards,
)
from bodyscan.calibration.refinement_choice import refine_where_better
from bodyscan.calibration.stripe_agreement import Disagreement, boards_off, find_disagreement
from bodyscan.errors import BodyscanError, PairFailed, plainly
from bodyscan.progress import Progress, silent, threaded
from bodyscan.registration.rig_solve import PlacedRig
from bodyscan.rig.rig import Rig

Array = NDArray[np.float64]


def calibrate_pairs(
    rig: Rig,
    cameras: Mapping[str, CameraCalibration],
    placed: PlacedRig,
    boundaries: Mapping[tuple[str, str, str], BoardBoundaries],
    failed: dict[str, str],
    notes: list[str],
    progress: Progress = silent,
) -> dict[str, PairCalibration]:
    """Light sheets of every pair; a pair whose projector fails is added to `failed`."""

    def calibrate(name: str) -> tuple[PairCalibration | str, list[str]]:
        own_notes: list[str] = []
        try:
            return _calibrate_pair(
                rig, name, cameras[name], placed, boundaries, own_notes
            ), own_notes
        except BodyscanError as error:
            return plainly(error), own_notes

    names = sorted(cameras)
    results = threaded(calibrate, names, stage="fitting light sheets", progress=progress)
    done: dict[str, PairCalibration] = {}
    for name, (result, own_notes) in zip(names, results, strict=True):
        notes += own_notes
        if isinstance(result, str):
            failed[name] = result
        else:
            done[name] = result
    return done


def _calibrate_pair(
    rig: Rig,
    name: str,
    own: CameraCalibration,
    placed: PlacedRig,
    boundaries: Mapping[tuple[str, str, str], BoardBoundaries],
    notes: list[str],
) -> PairCalibration:
    camera = placed.cameras[name]
    views = [view for view in placed.views if view.pair == name]
    quality = PairQuality(placed.rms_px[name], len(views))
    projector = rig.pair(name).projector
    if projector is None:
        return PairCalibration(name, camera, own.covariance, None, quality)
    lit = [view for view in views if (name, view.shot, view.board) in boundaries]
    camera_from_rig = placed.rig_from_camera[name].inverse()

    def carried(views: Sequence[LocatedView]) -> BoundaryPoints:
        shots = [
            (
                rig.board(view.board),
                camera_from_rig @ placed.rig_from_board[view.target],
                float(view.points[0, 2]),
                boundaries[name, view.shot, view.board],
            )
            for view in views
        ]
        return boundaries_on_boards(name, camera, projector, shots)

    points = carried(lit)
    disagreement = find_disagreement(points, camera, projector.stripes, projector.direction)
    if disagreement is not None:
        lit = agreeing(name, lit, disagreement, notes)
        points = carried(lit)
    fit = fit_light(points, projector.stripes, projector.direction, camera)
    quality = replace(
        quality,
        planes_rms_mm=fit.rms_mm,
        stripe_shots=len(lit),
        stripes_calibrated=fit.stripes_calibrated,
        stripes_projected=projector.stripes - 1,
        held_out=fit.held_out,
        boards_mm=_mean_and_rms(boards_off(points, fit.sheets)),
    )
    pair = PairCalibration(name, camera, own.covariance, fit.sheets, quality)
    # In a rig of several pairs the boards are held by all cameras together, far better than
    # one pair's stripes could.
    return pair if len(placed.cameras) > 1 else _refined(pair, own, lit, points)


def _mean_and_rms(values: Array) -> tuple[float, float] | None:
    return (float(values.mean()), float(np.sqrt((values**2).mean()))) if values.size else None


def agreeing(
    name: str, views: Sequence[LocatedView], found: Disagreement, notes: list[str]
) -> list[LocatedView]:
    """The views whose stripes fit together, if it is only one that does not; it is noted.

    Raises PairFailed, naming the shots, if the projector moved between two of them.
    """
    shots = [view.shot for view in views]
    misfit = f"{found.together_px:.1f} px off together, {found.apart_px:.1f} px apart"
    if not found.one_board:
        before, after = shots[found.kept[-1]], shots[found.others[0]]
        raise PairFailed(
            f"the projector moved between shots {before} and {after} (stripes are {misfit})",
            where=f"pair {name}",
            remedy="fasten it and capture the boards again, or delete the shots before it moved",
        )
    odd = int(found.others[0])
    notes.append(
        f"{name}: the stripes of shot {shots[odd]} do not fit the other shots' ({misfit}): the "
        "board or the projector moved during it; its stripes are not used"
    )
    return [view for number, view in enumerate(views) if number != odd]


def _refined(
    pair: PairCalibration,
    own: CameraCalibration,
    views: Sequence[LocatedView],
    points: BoundaryPoints,
) -> PairCalibration:
    """Camera, boards and light of a pair by itself in one solve, where held-out boards gain."""
    assert pair.light is not None
    data = binned(points, pair.camera, pair.light.direction)
    boards = [
        striped_board(PlanarView(view.shot, view.points, view.pixels), pair.camera, data, number)
        for number, view in enumerate(views)
    ]
    choice = refine_where_better(own, pair.light, boards, data)
    quality = replace(pair.quality, refinement=choice.reason, flatness_mm=choice.flatness_mm)
    if choice.joint is None:
        return replace(pair, quality=quality)
    return replace(
        pair,
        camera=choice.joint.camera,
        camera_covariance=choice.joint.camera_covariance,
        light=choice.joint.sheets,
        quality=replace(quality, corners_rms_px=choice.joint.corners_rms_px),
    )
