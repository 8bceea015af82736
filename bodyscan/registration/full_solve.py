"""The joint solve's last steps, over all parameters of our own cameras.

COLMAP's cameras have neither skew nor pixels that are not square; what each pair's own calibration
got wrong of these would go into the poses, unseen by their covariance.
"""

from __future__ import annotations

from collections.abc import Sequence

from bodyscan.arrays import Array
from bodyscan.calibration.board_views import LocatedView
from bodyscan.registration.joint_solve import JointSolution
from bodyscan.registration.normal_equations import NormalEquations, normal_equations

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
    first_board, first_camera = equations.first_board, equations.first_camera
    pairs = zip(equations.names, step[:first_board].reshape(-1, 6), strict=True)
    boards = zip(equations.targets, step[first_board:first_camera].reshape(-1, 6), strict=True)
    cameras = dict(solution.cameras)
    if equations.cameras_free:
        changes = zip(equations.names, equations.camera_columns, strict=True)
        cameras |= {name: cameras[name].moved(step[columns]) for name, columns in changes}
    return JointSolution(
        {name: solution.root_from_camera[name].moved(twist) for name, twist in pairs},
        {target: solution.root_from_board[target].moved(twist) for target, twist in boards},
        cameras,
    )
