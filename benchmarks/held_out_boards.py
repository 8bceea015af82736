"""How well a pair measures a held-out board: planes against rival projectors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from benchmarks.pinhole_opencv import fit_pinhole_opencv
from bodyscan.arrays import Array
from bodyscan.boards.board_layout import compute_corner_points
from bodyscan.boards.view import BoardView
from bodyscan.calibration.board_views import LocatedView, make_planar_view
from bodyscan.calibration.boundary_points import (
    BoardBoundaries,
    BoundaryPoints,
    StripedView,
    concatenate,
    on_board,
)
from bodyscan.calibration.camera import CameraCalibration, locate_board
from bodyscan.calibration.lens_selection import choose_lens
from bodyscan.calibration.sheet_fit import fit_light_planes, fit_pinhole
from bodyscan.calibration.sheet_selection import fit_light_sheets
from bodyscan.captures.folder import Captures
from bodyscan.errors import PairFailed
from bodyscan.geometry.lenses import FAMILY
from bodyscan.geometry.light_planes import Axis, LightPlanes, LightSheets
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.rig.rig import Rig
from bodyscan.stripes.stripe_map import StripeMap
from bodyscan.workflows.decode import decode_sequence
from bodyscan.workflows.find_boards import calibrate_cameras, find_all_boards


@dataclass(frozen=True)
class HeldOutBoard:
    """One model on one held-out board.

    median_mm: median absolute distance of measured points to the board's plane.
    flatness_rms_mm: RMS of the points about their own best plane.
    measured: share of points measured.
    """

    model: str
    shot: str
    median_mm: float
    flatness_rms_mm: float
    measured: float


@dataclass(frozen=True, eq=False)
class _Shot:
    view: BoardView
    camera_from_board: RigidTransform
    points: BoundaryPoints
    stripes: StripeMap


def hold_out_boards(rig: Rig, captures: Captures, pair: str) -> list[HeldOutBoard]:
    """Hold each shot out in turn, fit every model to the others, measure the held-out board.

    Boards are located by their corners and a camera calibrated on all of them; the stripes of the
    held-out board take no part in any fit. Raises PairFailed with fewer than three boards.
    """
    camera, shots = _shots(rig, captures, pair)
    results = []
    for held in shots:
        others = [shot for shot in shots if shot is not held]
        for name, sheets in _models(rig, pair, camera, others).items():
            results.append(_measure(name, sheets, held))
    return results


def _models(
    rig: Rig, pair: str, camera: CameraCalibration, shots: Sequence[_Shot]
) -> dict[str, LightSheets]:
    projector = rig.pair(pair).projector
    assert projector is not None
    points = concatenate([shot.points for shot in shots])
    stripes, direction = projector.stripes, projector.direction
    pinhole = fit_pinhole(points.points, points.index.astype(float))
    corners = [_corners_with_stripe(rig, shot) for shot in shots]
    opencv = fit_pinhole_opencv(
        camera.camera,
        [c[0] for c in corners],
        [c[1] for c in corners],
        [c[2] for c in corners],
        pinhole,
    )
    return {
        "free planes": fit_light_planes(points, stripes, direction, min_points=2).planes,
        "chosen by held-out boards": fit_light_sheets(points, stripes, direction).sheets,
        "pinhole (2 x 4, stripes)": _planes(pinhole, stripes, direction),
        "pinhole (OpenCV, corners)": _planes(opencv, stripes, direction),
    }


def _planes(pinhole: Array, stripes: int, direction: Axis) -> LightPlanes:
    """The planes of a projector without a lens, (2, 4)."""
    s = np.arange(stripes + 1.0)[:, None]
    return LightPlanes.from_planes(pinhole[0] - s * pinhole[1], direction)


def _shots(rig: Rig, captures: Captures, pair: str) -> tuple[CameraCalibration, list[_Shot]]:
    views = [view for view in find_all_boards(rig, captures).value if view.pair == pair]
    cameras = calibrate_cameras(rig, views)
    if pair not in cameras.value:
        raise PairFailed(cameras.failures.get(pair, "no boards"), where=f"pair {pair}")
    start, spec = cameras.value[pair], rig.pair(pair)
    # As the joint solve chooses it: the start's lens is the richest.
    planar = [make_planar_view(view, rig.board(view.board)) for view in views]
    camera = choose_lens(FAMILY, start.camera, start.poses, planar).fit
    assert spec.projector is not None
    shots = []
    sequences = {sequence.shot: sequence for sequence in captures.pair_sequences(pair)}
    for number, view in enumerate(views):
        sequence = sequences.get(view.shot)
        if sequence is None or not sequence.has_stripes:
            continue
        stripes = decode_sequence(sequence, spec)
        board = rig.board(view.board)
        pose = locate_board(camera.camera, make_planar_view(view, board))[0]
        corners = compute_corner_points(board)[view.corner_ids]
        located = LocatedView(pair, view.shot, view.board, corners, view.pixels, pose)
        boundaries = BoardBoundaries(
            stripes.boundary_index,
            stripes.boundary_pixels,
            stripes.boundary_sigma_px.astype(np.float64),
        )
        shot = StripedView(located, board, boundaries)
        points = on_board(
            camera.camera, spec.projector, board, shot.camera_from_face, boundaries, number
        )
        shots.append(_Shot(view, pose, points, stripes))
    if len(shots) < 3:
        raise PairFailed(
            f"{len(shots)} boards with stripes, holding one out needs three", where=f"pair {pair}"
        )
    return camera, shots


def _corners_with_stripe(rig: Rig, shot: _Shot) -> tuple[Array, Array, Array]:
    """Corners (N, 3), their pixels (N, 2) and stripe
    coordinates (N,), where all three are known."""
    u, v = np.split(shot.view.pixels.astype(np.float32), 2, axis=1)
    s = cv2.remap(
        shot.stripes.s, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=np.nan
    ).ravel()
    known = np.isfinite(s)
    corners = compute_corner_points(rig.board(shot.view.board))[shot.view.corner_ids]
    return corners[known], shot.view.pixels[known], s[known].astype(float)


def _measure(model: str, sheets: LightSheets, held: _Shot) -> HeldOutBoard:
    rays = held.points.points / held.points.points[:, 2:]
    depth = sheets.intersect(rays, held.points.index.astype(float)).depth
    known = np.isfinite(depth)
    measured = rays[known] * depth[known, None]
    centre = held.points.points.mean(axis=0)
    distance = (measured - centre) @ held.camera_from_board.rotation[:, 2]
    typical = float(np.median(np.abs(distance)))
    near = np.abs(distance - np.median(distance)) < 10.0 * max(typical, 1e-6)
    centred = measured[near] - measured[near].mean(axis=0)
    flatness = float(np.sqrt(max(np.linalg.eigvalsh(centred.T @ centred)[0], 0.0) / len(centred)))
    return HeldOutBoard(model, held.view.shot, typical, flatness, float(known.mean()))
