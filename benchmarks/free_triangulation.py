"""Cameras judged by held-out boards: triangulated corners against the true board."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from benchmarks.triangulation import triangulate
from bodyscan.arrays import Array
from bodyscan.boards.view import BoardView
from bodyscan.calibration.board_views import BoardShape, LocatedView
from bodyscan.geometry.camera import Camera
from bodyscan.geometry.transforms import RigidTransform, fit_rigid_transform
from bodyscan.registration.rig_solve import RigSolution, solve_rig
from bodyscan.rig.rig import Rig
from bodyscan.workflows.find_boards import calibrate_cameras, locate_views


@dataclass(frozen=True)
class FreeTriangulation:
    """One shot, with the corners that two or more cameras saw.

    rms_px: RMS reprojection error of the triangulated corners.
    rms_mm: RMS distance of the triangulated corners to the rigidly fitted board of the rig file.
    rms_shaped_mm: the same for the board's shape as found from the other shots, if it was.
    """

    shot: str
    corners: int
    observations: int
    rms_px: float
    rms_mm: float
    rms_shaped_mm: float


def triangulate_board(
    views: Sequence[LocatedView],
    cameras: dict[str, Camera],
    rig_from_camera: dict[str, RigidTransform],
    shape: BoardShape | None = None,
) -> FreeTriangulation:
    """Triangulate each corner of one board in one shot independently."""
    corners, number = np.unique(
        np.concatenate([np.round(view.points, 6) for view in views]), axis=0, return_inverse=True
    )
    pixels = np.full((len(views), len(corners), 2), np.nan)
    for k, (view, numbers) in enumerate(
        zip(views, np.split(number, np.cumsum([len(v.pixels) for v in views])[:-1]), strict=True)
    ):
        pixels[k, numbers] = view.pixels
    own = [cameras[view.pair] for view in views]
    camera_from_rig = [rig_from_camera[view.pair].inverse() for view in views]
    points = triangulate(own, camera_from_rig, pixels)
    known = np.isfinite(points[:, 0])
    residuals = np.stack(
        [
            camera.project(transform.apply(points[known])) - seen[known]
            for camera, transform, seen in zip(own, camera_from_rig, pixels, strict=True)
        ]
    )
    squared = np.sum(residuals**2, axis=-1)
    observed = np.isfinite(squared)
    true = shape.apply(corners) if shape else corners
    return FreeTriangulation(
        views[0].shot,
        int(known.sum()),
        int(observed.sum()),
        float(np.sqrt(np.mean(squared[observed]))) if observed.any() else float("nan"),
        _off_board(corners[known], points[known]),
        _off_board(true[known], points[known]),
    )


def _off_board(corners: Array, points: Array) -> float:
    """RMS distance (mm) of points (N, 3) to the corners (N, 3) rigidly fitted to them."""
    if len(corners) < 4:
        return float("nan")
    fitted = fit_rigid_transform(corners, points).apply(corners)
    return float(np.sqrt(np.mean(np.sum((fitted - points) ** 2, axis=1))))


@dataclass(frozen=True, eq=False)
class RigWithoutShots:
    """A rig calibrated without some shots.

    cameras: each calibrated independently, without those shots.
    used: views of the other shots.
    placed: the rig as solved from these.
    left_out: views of the shots left out.
    """

    cameras: dict[str, Camera]
    used: tuple[LocatedView, ...]
    placed: RigSolution
    left_out: tuple[LocatedView, ...]


def without_shots(rig: Rig, found: Sequence[BoardView], shots: Collection[str]) -> RigWithoutShots:
    """The rig calibrated from all views except those of `shots`.

    Raises what `solve_rig` raises.
    """
    others = [view for view in found if view.shot not in shots]
    calibrated = calibrate_cameras(rig, others).value
    views = locate_views(rig, found, calibrated).value
    used = tuple(view for view in views if view.shot not in shots)
    cameras = {name: own.camera for name, own in calibrated.items()}
    left_out = tuple(view for view in views if view.shot in shots)
    return RigWithoutShots(cameras, used, solve_rig(rig, used, cameras).value, left_out)


def triangulate_shots(
    views: Sequence[LocatedView],
    cameras: dict[str, Camera],
    rig_from_camera: dict[str, RigidTransform],
    shapes: Mapping[str, BoardShape],
) -> list[FreeTriangulation]:
    """The board of every shot that two or more cameras saw; shapes: by the board's name."""
    by_shot = {
        shot: [view for view in views if view.shot == shot]
        for shot in sorted({view.shot for view in views})
    }
    return [
        triangulate_board(seen, cameras, rig_from_camera, shapes.get(seen[0].board))
        for seen in by_shot.values()
        if len(seen) >= 2
    ]


def pooled(results: Sequence[FreeTriangulation]) -> tuple[float, float, float]:
    """RMS over all shots: reprojection (px), distance to the
    board as described and as found (mm)."""
    px = sum(r.observations * r.rms_px**2 for r in results) / sum(r.observations for r in results)
    known = [r for r in results if np.isfinite(r.rms_mm)]
    count = sum(r.corners for r in known)
    mm = sum(r.corners * r.rms_mm**2 for r in known) / count
    shaped = sum(r.corners * r.rms_shaped_mm**2 for r in known) / count
    return float(np.sqrt(px)), float(np.sqrt(mm)), float(np.sqrt(shaped))
