"""The joint solve's last steps, over all seven intrinsics of the chapter's camera.

COLMAP's cameras have neither skew nor pixels that are not square; what each pair's own calibration
got wrong of these would go into the placings, unseen by their covariance.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from bodyscan.calibration.camera import INTRINSICS
from bodyscan.calibration.located_view import LocatedView
from bodyscan.geometry.camera import Camera
from bodyscan.registration.joint_solve import JointSolution
from bodyscan.registration.normal_equations import LENS, NormalEquations, normal_equations

Array = NDArray[np.float64]

MOST_STEPS = 12
CONVERGED = 1e-5
"""The last step would have lowered the sum of squares by less than this many variances."""


def solve_fully(
    views: Sequence[LocatedView], solution: JointSolution, *, root: str, refine_cameras: bool
) -> JointSolution:
    """Gauss-Newton from a solution of `solve_jointly`, in the root camera's frame."""
    for _ in range(MOST_STEPS):
        equations = normal_equations(
            views,
            solution.cameras,
            solution.root_from_camera,
            solution.root_from_board,
            fixed_pair=root,
            fixed_target=None,
            cameras_free=refine_cameras,
        )
        step = equations.step()
        solution = _moved(solution, equations, step)
        if -step @ equations.gradient < CONVERGED * equations.variance_px2:
            break
    return solution


def _moved(solution: JointSolution, equations: NormalEquations, step: Array) -> JointSolution:
    first_board, first_lens = equations.first_board, equations.first_lens
    pairs = zip(equations.names, step[:first_board].reshape(-1, 6), strict=True)
    boards = zip(equations.targets, step[first_board:first_lens].reshape(-1, 6), strict=True)
    lenses = step[first_lens:].reshape(-1, LENS)
    cameras = dict(solution.cameras)
    if equations.cameras_free:
        cameras |= {
            name: _changed(cameras[name], change)
            for name, change in zip(equations.names, lenses, strict=True)
        }
    return JointSolution(
        {name: solution.root_from_camera[name].moved(twist) for name, twist in pairs},
        {target: solution.root_from_board[target].moved(twist) for target, twist in boards},
        cameras,
    )


def _changed(camera: Camera, change: Array) -> Camera:
    return replace(
        camera,
        **{
            name: getattr(camera, name) + float(value)
            for name, value in zip(INTRINSICS, change, strict=True)
        },
    )
