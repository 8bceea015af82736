"""From board views of many pairs to one placed rig: graph, joint solve, bad views out, rig frame."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bodyscan.capture.rig import Rig
from bodyscan.geometry.camera import Camera
from bodyscan.geometry.least_squares import cauchy_weights, spread
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.registration.joint_solve import solve_jointly
from bodyscan.registration.located_view import LocatedView
from bodyscan.registration.rig_frame import frame_target, rig_from_root
from bodyscan.registration.uncertainty import PlacingCovariance, placing_covariance
from bodyscan.registration.view_graph import (
    Target,
    place_boards,
    placings,
    view_graph,
)

BAD_VIEW_SIGMAS = 6.0
LEAST_BAD_PX = 0.5
LOSS_PX = 0.3
ROBUST_SIGMAS = 4.0

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class PlacedRig:
    """Everything in the rig frame; cameras as the joint solve left them; rms_px of each pair."""

    rig_from_camera: dict[str, RigidTransform]
    rig_from_board: dict[Target, RigidTransform]
    cameras: dict[str, Camera]
    covariance: PlacingCovariance
    rms_px: dict[str, float]
    views: tuple[LocatedView, ...]
    notes: tuple[str, ...]


def place_rig(
    rig: Rig,
    views: Sequence[LocatedView],
    cameras: Mapping[str, Camera],
    *,
    refine_cameras: bool = True,
) -> PlacedRig:
    """Join all pairs by their shared board views.

    Raises RigDisconnected if groups of pairs share no view, or only views whose board numbering
    leaves their placing open; BadInput if nothing fixes the rig frame.
    """
    names = sorted(cameras)
    graph = view_graph(views, names)
    root = max(names, key=lambda name: (graph.degree(name), name))
    start = placings(views, names, root)
    kept, boards, notes = place_boards(views, start)
    # One camera alone was solved with its skew already; nothing is left to join.
    refine = refine_cameras and len(names) > 1
    solution = None
    for _ in range(2):
        solution = solve_jointly(
            kept,
            dict(cameras),
            solution.root_from_camera if solution else start,
            solution.root_from_board if solution else boards,
            root=root,
            refine_cameras=refine,
            loss_px=LOSS_PX,
        )
        errors = [
            _rms(
                _residuals(
                    view, solution.cameras, solution.root_from_camera, solution.root_from_board
                )
            )
            for view in kept
        ]
        limit = max(BAD_VIEW_SIGMAS * float(np.median(errors)), LEAST_BAD_PX)
        bad = [view for view, error in zip(kept, errors, strict=True) if error > limit]
        if not bad:
            break
        notes += [
            f"{view.pair}: board {view.board} in shot {view.shot} does not fit the rig "
            f"({errors[kept.index(view)]:.2f} px, the usual is {np.median(errors):.2f}); not used"
            for view in bad
        ]
        kept = [view for view in kept if view not in bad]
    assert solution is not None
    to_rig = rig_from_root(rig, solution.root_from_camera, solution.root_from_board)
    rig_from_camera = {name: to_rig @ t for name, t in solution.root_from_camera.items()}
    seen = {view.target for view in kept}
    rig_from_board = {k: to_rig @ t for k, t in solution.root_from_board.items() if k in seen}
    covariance = placing_covariance(
        kept,
        solution.cameras,
        rig_from_camera,
        rig_from_board,
        fixed_pair=rig.frame_pair.name if rig.frame_pair else None,
        fixed_target=frame_target(rig),
        cameras_free=refine,
    )
    rms = {
        name: _robust_rms(
            [
                _residuals(v, solution.cameras, rig_from_camera, rig_from_board)
                for v in kept
                if v.pair == name
            ]
        )
        for name in names
    }
    return PlacedRig(
        rig_from_camera,
        rig_from_board,
        solution.cameras,
        covariance,
        rms,
        tuple(kept),
        tuple(notes),
    )


def _residuals(
    view: LocatedView,
    cameras: Mapping[str, Camera],
    rig_from_camera: Mapping[str, RigidTransform],
    rig_from_board: Mapping[Target, RigidTransform],
) -> Array:
    camera_from_board = rig_from_camera[view.pair].inverse() @ rig_from_board[view.target]
    return cameras[view.pair].project(camera_from_board.apply(view.points)) - view.pixels


def _rms(residuals: Array) -> float:
    return float(np.sqrt(np.mean(np.sum(residuals**2, axis=1))))


def _robust_rms(parts: Sequence[Array]) -> float:
    """RMS distance of corners, px, with the weights of the solve's loss: outliers do not count."""
    if not parts:
        return float("nan")
    residuals = np.concatenate(parts).ravel()
    weights = cauchy_weights(residuals, 2, ROBUST_SIGMAS * spread(residuals))
    return float(np.sqrt(2.0 * np.sum(weights * residuals**2) / np.sum(weights)))
