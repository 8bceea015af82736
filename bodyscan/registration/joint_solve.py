"""The joint solve: all poses with the cameras fixed, then poses and cameras, by least squares.

The first brings everything together from a start that may be centimetres off, with a wide loss. Then
every parameter of the cameras is free, with a Cauchy loss scaled by the corners' own robust sigma;
this runs again after views are dropped or boards found bent.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from bodyscan.arrays import Array, Indices
from bodyscan.boards.view import ViewKey
from bodyscan.calibration.board_views import BoardShape, LocatedView, apply_shape
from bodyscan.calibration.camera import CORNERS, evaluate_camera_prior
from bodyscan.geometry.camera import MATRIX, Camera, CameraPrior
from bodyscan.geometry.least_squares import EXACT, Block, Noise, minimize
from bodyscan.geometry.transforms import RigidTransform, adjoint, twist_jacobian
from bodyscan.registration.view_graph import Target


@dataclass(frozen=True, eq=False)
class JointSolution:
    """Cameras, and all poses in the root camera's frame, mm: the start or the result of a solve.

    shapes: of all boards if their corners are unknowns, none if they lie as described.
    motions: by view, (6, K): how its board may have moved since the others saw it; independent twists
        of one sigma each, board frame, over the corners' sigma in px. Of all views or of none.
    """

    root_from_camera: dict[str, RigidTransform]
    root_from_board: dict[Target, RigidTransform]
    cameras: dict[str, Camera]
    shapes: dict[str, BoardShape] = field(default_factory=dict)
    motions: Mapping[ViewKey, Array] = field(default_factory=dict)


def solve_poses(
    views: Sequence[LocatedView], start: JointSolution, *, root: str, loss_px: float
) -> JointSolution:
    """Solve for all poses from a start that may be far off; the cameras are fixed.

    loss_px: distance beyond which corners count less and less (Cauchy).
    """
    fixed = {
        name: replace(camera, prior=CameraPrior(camera.parameters, 1e-6 * camera.prior_sigmas))
        for name, camera in start.cameras.items()
    }
    noise = Noise("corners", group=2, cauchy=loss_px, known=1.0)
    solution = replace(start, cameras=fixed)
    solution = refine_solution(views, solution, root=root, equal_noise=True, noise=noise)
    return replace(solution, cameras=start.cameras)


def refine_solution(
    views: Sequence[LocatedView],
    solution: JointSolution,
    *,
    root: str,
    equal_noise: bool = False,
    noise: Noise = CORNERS,
) -> JointSolution:
    """Solve for all poses, cameras and board shapes from poses that nearly fit, in the root's frame.

    views: of boards as described.
    equal_noise: whether all views are taken to be as noisy as each other.
    noise: of the corners.
    """
    unknowns = _Unknowns(solution, root)
    of_pair = [
        [view for view in views if view.pair == name] for name in sorted({v.pair for v in views})
    ]
    # Convergence, in variances: before the last step all unknowns were within 0.03 standard
    # deviations of the minimum; that step leaves a few thousandths.
    return minimize(
        solution,
        lambda state: _make_blocks(of_pair, state, unknowns, equal_noise, noise),
        unknowns.retract,
        unknowns=unknowns.count,
        steps=12,
        tolerance=1e-3,
        damping=1e-9,
    ).state


class _Unknowns:
    """Columns of the unknowns: motions of all pairs but the root, of boards, cameras, then corners."""

    def __init__(self, solution: JointSolution, root: str) -> None:
        names = sorted(solution.root_from_camera)
        self.count = 0
        self.of_pair = {name: self._next(6) for name in names if name != root}
        self.of_pair[root] = np.zeros(0, np.int64)
        self.of_board = {target: self._next(6) for target in sorted(solution.root_from_board)}
        self.of_camera = {n: self._next(len(solution.cameras[n].parameters)) for n in names}
        self.of_corners = {
            name: self._next(shape.points.size).reshape(-1, 3)
            for name, shape in solution.shapes.items()
        }

    def _next(self, size: int) -> Indices:
        self.count += size
        return np.arange(self.count - size, self.count)

    def retract(self, solution: JointSolution, step: Array) -> JointSolution:
        root_from_camera = {
            name: pose.retract(step[self.of_pair[name]]) if len(self.of_pair[name]) else pose
            for name, pose in solution.root_from_camera.items()
        }
        boards = {
            target: pose.retract(step[self.of_board[target]])
            for target, pose in solution.root_from_board.items()
        }
        cameras = solution.cameras | {
            name: solution.cameras[name].retract(step[columns])
            for name, columns in self.of_camera.items()
        }
        shapes = {
            name: replace(shape, offsets=shape.offsets + step[self.of_corners[name]])
            for name, shape in solution.shapes.items()
        }
        return JointSolution(root_from_camera, boards, cameras, shapes, solution.motions)

    def select_columns(self, view: LocatedView, shapes: Mapping[str, BoardShape]) -> Indices:
        """Columns of a view, or of each of its corners if those are unknowns, (1 or N, C)."""
        columns = np.concatenate(
            [self.of_pair[view.pair], self.of_board[view.target], self.of_camera[view.pair]]
        )
        if not shapes:
            return columns[None]
        corners = self.of_corners[view.board][shapes[view.board].numbers(view.points)]
        return np.hstack([np.tile(columns, (len(corners), 1)), corners])


def _make_blocks(
    of_pair: Sequence[Sequence[LocatedView]],
    solution: JointSolution,
    unknowns: _Unknowns,
    equal_noise: bool,
    noise: Noise,
) -> Iterator[Block]:
    """The corners of each pair's views, then the priors on cameras and shapes."""
    poses = solution.cameras, solution.root_from_camera, solution.root_from_board
    errors = [
        linearize_marginalized(
            [apply_shape(v, solution.shapes) for v in views], *poses, solution.motions
        )
        for views in of_pair
    ]
    runs = [np.array([2 * len(view.points) for view in views]) for views in of_pair]
    by_view = [
        np.split(residuals, np.cumsum(lengths)[:-1])
        for (residuals, _), lengths in zip(errors, runs, strict=True)
    ]
    every = [one for views in by_view for one in views]
    sigmas = iter(np.ones(len(every)) if equal_noise else estimate_view_sigmas(every))
    for views, (residuals, linearize), lengths in zip(of_pair, errors, runs, strict=True):
        columns = np.concatenate([unknowns.select_columns(view, solution.shapes) for view in views])
        # The root camera fixes the frame: it has no motion.
        first = 0 if len(unknowns.of_pair[views[0].pair]) else 6
        jacobian = partial(_take_columns, linearize, first, columns.shape[1])
        sigma = np.repeat([next(sigmas) for _ in views], lengths)
        each = np.full(len(columns), 2) if solution.shapes else lengths
        yield Block(residuals, jacobian, columns, noise, sigma, runs=each)
    for name, parameters in unknowns.of_camera.items():
        camera = solution.cameras[name]
        if camera.prior is None:
            # Around the current values: no gradient, but it keeps what no view shows from running away.
            known = np.diag(1.0 / camera.prior_sigmas[: len(MATRIX)])
            matrix = parameters[: len(MATRIX)]
            yield Block(np.zeros(len(MATRIX)), partial(np.asarray, known), matrix, EXACT)
        yield evaluate_camera_prior(camera, parameters)
    for name, shape in solution.shapes.items():
        known = shape.compute_prior_jacobian()
        deviation = known @ shape.offsets.ravel()
        yield Block(deviation, partial(np.asarray, known), unknowns.of_corners[name].ravel(), EXACT)


def _take_columns(linearize: Callable[[], Array], first: int, count: int) -> Array:
    return linearize()[:, first : first + count]


def estimate_view_sigmas(residuals: Sequence[Array]) -> Array:
    """Estimate the noise of each view's corners, (V,), relative to that of all views, from its
    residuals (2N,).

    A board seen at a slant has less to find its corners by: rendered ones err 0.016 px face on and
    0.065 px at 65 degrees. With equal weights the solve would trust just those that it should not,
    and the board on the floor, which fixes the frame, is seen so by every camera.
    """
    # No corner is found better than to 1e-4 px: smaller residuals are of computed views.
    single = np.maximum([CORNERS.mean_square(one) for one in residuals], 1e-8)
    counts = np.array([len(one) for one in residuals], float)
    every = float(single @ counts / counts.sum())
    # Ten residuals know a variance to 45 %: there a view's estimate counts for half.
    shrunk = (10.0 * every + counts * single) / (10.0 + counts)
    # Boards at 65 degrees err 3 times as much; a view that seems worse is wrong, not noisy.
    return np.clip(np.sqrt(shrunk / every), 0.25, 4.0)


def linearize_reprojection(
    views: Sequence[LocatedView],
    cameras: Mapping[str, Camera],
    rig_from_camera: Mapping[str, RigidTransform],
    rig_from_board: Mapping[Target, RigidTransform],
) -> tuple[Array, Callable[[], Array]]:
    """Reprojection errors (2N,) px (projected - observed) of a pair's views; computes their Jacobian.

    views: with points where the boards' corners really lie.

    The Jacobian (2N, 12 + P + 3) is by the camera's and its board's twist in the rig frame, the
    camera's parameters, and the corner's place on its board. A corner q in the rig frame is observed at
    R^T (q - t): a motion of the board and the opposite motion of the camera have the same effect.
    """
    pair = views[0].pair
    camera = cameras[pair]
    in_rig = np.concatenate([rig_from_board[view.target].apply(view.points) for view in views])
    pixels = np.concatenate([view.pixels for view in views])
    camera_from_rig = rig_from_camera[pair].inverse()
    points = camera_from_rig.apply(in_rig)

    def linearize() -> Array:
        by_parameter, by_point = camera.jacobians(points)
        in_rig_frame = by_point @ camera_from_rig.rotation
        by_motion = in_rig_frame @ twist_jacobian(in_rig)
        rotations = [rig_from_board[view.target].rotation for view in views]
        by_corner = in_rig_frame @ np.repeat(rotations, [len(v.points) for v in views], axis=0)
        jacobian = np.concatenate([-by_motion, by_motion, by_parameter, by_corner], axis=2)
        return jacobian.reshape(-1, jacobian.shape[2])

    return (camera.project(points) - pixels).ravel(), linearize


def linearize_marginalized(
    views: Sequence[LocatedView],
    cameras: Mapping[str, Camera],
    rig_from_camera: Mapping[str, RigidTransform],
    rig_from_board: Mapping[Target, RigidTransform],
    motions: Mapping[ViewKey, Array],
) -> tuple[Array, Callable[[], Array]]:
    """`linearize_reprojection` with the motion of each view's board marginalized: whitened by
    (1 + M M^T)^-1/2, M being the residuals' derivatives by the motion (see `JointSolution`)."""
    poses = cameras, rig_from_camera, rig_from_board
    if not motions:
        return linearize_reprojection(views, *poses)
    parts = []
    for view in views:
        residuals, linearize = linearize_reprojection([view], *poses)
        rows = np.column_stack([residuals, linearize()])
        by_motion = rows[:, 7:13] @ adjoint(rig_from_board[view.target]) @ motions[view.key]
        left, size, _ = np.linalg.svd(by_motion, full_matrices=False)
        known = left * (1.0 - 1.0 / np.hypot(1.0, size))
        parts.append(rows - known @ (left.T @ rows))
    whitened = np.concatenate(parts)
    return whitened[:, 0], lambda: whitened[:, 1:]
