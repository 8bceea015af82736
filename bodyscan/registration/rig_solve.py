"""From board views of many pairs to one solved rig: graph, joint solve, bad views out, rig frame.

Two solves follow each other (`joint_solve`): the first brings all poses together from the graph's rough
start; the second, with every parameter of the cameras, is repeated when views are dropped or boards
found to be bent.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence, Set
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from bodyscan.arrays import Array
from bodyscan.boards.view import ViewKey
from bodyscan.calibration.board_views import BoardShape, LocatedView, PlanarView, apply_shape
from bodyscan.calibration.boundary_points import BoardBoundaries, StripedView
from bodyscan.calibration.camera import CORNERS, locate_board, locate_boards
from bodyscan.calibration.lens_selection import LensTrial
from bodyscan.calibration.pair import LocatedPair, PairCalibration
from bodyscan.geometry.camera import Camera
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.geometry.uncertainty import PoseCovariance, RayUncertainty
from bodyscan.outcome import Outcome
from bodyscan.registration.board_motion import estimate_motions
from bodyscan.registration.board_shape import estimate_board_shapes
from bodyscan.registration.cluster_covariance import (
    build_normal_equations,
    cluster_board_poses,
    cluster_robust_covariance,
)
from bodyscan.registration.joint_solve import JointSolution, refine_solution, solve_poses
from bodyscan.registration.rig_calibration import ObservedCorners
from bodyscan.registration.rig_frame import (
    find_frame_board_rotation,
    find_frame_target,
    find_rig_from_root,
    hold_frame,
)
from bodyscan.registration.rig_lenses import ChosenLenses, choose_lenses
from bodyscan.registration.view_consistency import (
    ConsistentSolve,
    compute_error_limit,
    find_inconsistent_views,
    solve_consistently,
)
from bodyscan.registration.view_graph import (
    Target,
    build_view_graph,
    by_target,
    find_initial_poses,
    locate_boards_jointly,
)
from bodyscan.rig.rig import Rig

LOSSES_PX = (10.0, 0.3)
"""The first is as wide as a start from one wrong view is off: with the second alone a pair stays
with the few views that it was placed by, and all others seem wrong."""


@dataclass(frozen=True, eq=False)
class RigSolution:
    """The solved rig, rig frame.

    rig_from_camera, covariance: poses of the pairs.
    cameras: as the joint solve left them.
    views: those used, with points where the boards' corners really lie.
    board_shapes: of boards that differ from their description, confirmed by held-out boards.
    lenses: by camera whose lens was open, those tried on held-out boards.
    camera_covariances: (P, P) of each camera's parameters.
    variance_inflation: factor by which variances exceed those of independent corners, estimated
        from clusters of board poses.
    rays: by camera, how well each pixel's ray is known.
    motions: of boards between the pictures of one shot, as in `JointSolution`.
    """

    rig_from_camera: dict[str, RigidTransform]
    rig_from_board: dict[Target, RigidTransform]
    cameras: dict[str, Camera]
    covariance: PoseCovariance
    views: tuple[LocatedView, ...]
    board_shapes: dict[str, BoardShape]
    lenses: dict[str, tuple[LensTrial, ...]] = field(default_factory=dict)
    camera_covariances: dict[str, Array] = field(default_factory=dict)
    variance_inflation: float = 1.0
    rays: dict[str, RayUncertainty] = field(default_factory=dict)
    motions: Mapping[ViewKey, Array] = field(default_factory=dict)

    def residuals(self, name: str) -> Array:
        """Projected less seen corners (N, 2) px of a pair's views; of each view by itself where boards
        moved between the pictures of one shot, which the sigmas of poses contain."""
        camera, camera_from_rig = self.cameras[name], self.rig_from_camera[name].inverse()
        views = [view for view in self.views if view.pair == name]
        if views and self.motions:
            planar = [PlanarView(view.shot, view.points, view.pixels) for view in views]
            starts = [view.camera_from_board for view in views]
            return np.concatenate(locate_boards(camera, planar, starts)[1])
        parts = [
            camera.project((camera_from_rig @ self.rig_from_board[view.target]).apply(view.points))
            - view.pixels
            for view in views
        ]
        return np.concatenate(parts) if parts else np.empty((0, 2))

    @property
    def rms_px(self) -> dict[str, float]:
        """RMS distance of corners, by pair, with the weights of the solve's loss against outliers."""
        residuals = {name: self.residuals(name).ravel() for name in sorted(self.rig_from_camera)}
        return {
            name: float(np.sqrt(2.0 * CORNERS.mean_square(one))) if one.size else float("nan")
            for name, one in residuals.items()
        }


@dataclass(frozen=True, eq=False)
class _Solved:
    """judged: the last solve.  views: all, of boards as described.  notes: on the boards' shapes.
    lenses: None if not chosen."""

    judged: ConsistentSolve
    views: list[LocatedView]
    notes: tuple[str, ...]
    lenses: ChosenLenses | None


def solve_rig(
    rig: Rig, views: Sequence[LocatedView], cameras: Mapping[str, Camera]
) -> Outcome[RigSolution]:
    """Join all pairs by their shared board views.

    cameras: with the richest lens to be tried; boards choose where the rig file leaves it open.

    Pairs that agree with the others in too few shots are in `failures`. Raises RigDisconnected if
    groups of pairs share no view, only views whose board numbering leaves their poses open, or only
    views that contradict each other by far; BadInput if nothing fixes the rig frame.
    """
    start, left_out = find_initial_poses(views, sorted(cameras))
    shared = [view for view in views if view.pair in start]
    joined = {name: cameras[name] for name in sorted(start)}
    solved = _solve(rig, shared, joined, start)
    if _are_unsynchronised(solved.views, solved.judged.wrong):
        solved = _solve(rig, shared, joined, start, weigh=True)
    solution = _transfer_to_rig_frame(rig, solved)
    return Outcome(solution, (*solved.judged.notes, *solved.notes), left_out)


def _solve(
    rig: Rig,
    views: Sequence[LocatedView],
    cameras: dict[str, Camera],
    start: Mapping[str, RigidTransform],
    *,
    weigh: bool = False,
) -> _Solved:
    """Solve with the richest lenses, drop wrong views, choose the lenses, solve again, and take
    back views that fit after all. weigh: drop none; robust weights and their spread are the noise."""
    names = sorted(start)
    graph = build_view_graph(views, names)
    root = max(names, key=lambda name: (graph.degree(name), name))
    to_root = start[root].inverse()
    root_from_camera = {name: to_root @ pose for name, pose in start.items()}
    resolved, boards, inconsistent = locate_boards_jointly(views, root_from_camera)
    solution = JointSolution(root_from_camera, boards, cameras)
    if weigh:
        judged, limit_px = _weigh_views(resolved, solution, root), np.inf
    else:
        judged, limit_px = _judge_views(resolved, solution, inconsistent, root)
        if _are_unsynchronised(resolved, judged.wrong):
            return _Solved(judged, resolved, (), None)  # all is solved again
    solve = partial(solve_consistently, root=root, limit_px=limit_px)
    moved = judged.notes if weigh else ()
    shaped = estimate_board_shapes(resolved, judged, root=root)
    true = [apply_shape(v, shaped.value.shapes) for v in judged.select_consistent(resolved)]
    lenses = choose_lenses(rig, true, shaped.value)
    solution = lenses.solution
    if solution.shapes or solution.cameras != judged.solution.cameras:
        judged = solve(resolved, solution, wrong=judged.wrong)
    return _Solved(judged, resolved, (*moved, *shaped.notes), lenses)


def _judge_views(
    views: Sequence[LocatedView], solution: JointSolution, inconsistent: Set[Target], root: str
) -> tuple[ConsistentSolve, float]:
    """Solve without the views that contradict the others; also return the limit on a view's error."""
    # The graph's poses alone are rough: 30 px.
    doubtful = [view for view in views if view.target in inconsistent]
    gross = {view.key for view in find_inconsistent_views(doubtful, solution, 30.0).value}
    kept = [view for view in views if view.key not in gross]
    limit_px = compute_error_limit(kept, solution.cameras)
    for loss_px in LOSSES_PX:
        solution = solve_poses(kept, solution, root=root, loss_px=loss_px)
    judged = solve_consistently(views, solution, root=root, limit_px=limit_px, wrong=gross)
    return judged, limit_px


def _weigh_views(
    views: Sequence[LocatedView], solution: JointSolution, root: str
) -> ConsistentSolve:
    """Solve with all views, each of a moment of its own: see `board_motion`."""
    errors = [
        solution.cameras[view.pair].project(view.camera_from_board.apply(view.points)) - view.pixels
        for view in views
    ]
    noise_px = CORNERS.estimate_scale(np.concatenate(errors).ravel())
    for _round in range(4):  # the last changes spreads by less than a hundredth
        motions, rms_mm = estimate_motions(views, solution, noise_px)
        solution = refine_solution(views, replace(solution, motions=motions), root=root)
    largest = max(rms_mm.values())
    moved = [f"{name} by {mm:.2g} mm" for name, mm in rms_mm.items() if mm > 0.1 * largest]
    note = (
        f"the board had moved when these took their images (RMS): {', '.join(moved)}. They were not "
        "taken together with the others'. All views are used, weighted by how well they agree, with "
        "sigmas to match; synchronise the cameras, or hold the board still"
    )
    return ConsistentSolve(solution, frozenset(), (note,))


def _are_unsynchronised(views: Sequence[LocatedView], wrong: Collection[ViewKey]) -> bool:
    """Whether views disagree as those of different moments do, and not as slips, one by one: most of
    a pair's shared views are wrong, or some in more than a tenth of the shots of every board."""
    shared = [group for group in by_target(views).values() if len(group) > 1]
    number = Counter(view.pair for group in shared for view in group)
    dropped = Counter(view.pair for group in shared for view in group if view.key in wrong)
    shots = Counter(group[0].board for group in shared)
    odd = Counter(group[0].board for group in shared if any(v.key in wrong for v in group))
    return any(2 * dropped[name] > number[name] for name in number) or (
        bool(shots) and all(10 * odd[board] > count for board, count in shots.items())
    )


def _transfer_to_rig_frame(rig: Rig, solved: _Solved) -> RigSolution:
    """The solution carried into the rig frame, with its covariance there."""
    solution, kept = solved.judged.solution, solved.judged.select_consistent(solved.views)
    rig = hold_frame(rig, kept, solution.cameras)
    fixed = find_frame_target(rig)
    turn = find_frame_board_rotation(rig, solution.root_from_camera, solution.root_from_board)
    oriented = {
        target: root_from_board @ turn.inverse() if target == fixed else root_from_board
        for target, root_from_board in solution.root_from_board.items()
    }
    to_rig = find_rig_from_root(rig, solution.root_from_camera, oriented)
    rig_from_camera = {name: to_rig @ t for name, t in solution.root_from_camera.items()}
    rig_from_board = {target: to_rig @ t for target, t in oriented.items()}
    equations = build_normal_equations(
        kept,  # a turned board's motion is the same, but its shape would be turned
        solution.cameras,
        rig_from_camera,
        {target: to_rig @ t for target, t in solution.root_from_board.items()},
        fixed_pair=rig.frame_pair.name if rig.frame_pair else None,
        fixed_target=fixed,
        shapes=solution.shapes,
        motions=solution.motions,
    )
    true = [apply_shape(view, solution.shapes) for view in kept]
    views = [view.resolve(turn) if view.target == fixed else view for view in true]
    covariance = cluster_robust_covariance(equations, cluster_board_poses(views, rig_from_board))
    return RigSolution(
        rig_from_camera,
        rig_from_board,
        solution.cameras,
        covariance.poses,
        tuple(views),
        solution.shapes,
        solved.lenses.trials if solved.lenses else {},
        covariance.cameras,
        covariance.variance_inflation,
        {
            name: rays.inflate_noise(covariance.variance_inflation)
            for name, rays in (solved.lenses.rays if solved.lenses else {}).items()
        },
        solution.motions,
    )


def collect_corners(solution: RigSolution, names: Iterable[str]) -> dict[str, ObservedCorners]:
    """The corners by pair, for those of `names` that were solved."""
    number = {target: k for k, target in enumerate(sorted(solution.rig_from_board))}
    corners = {}
    for name in names:
        of_pair = [view for view in solution.views if view.pair == name]
        if of_pair:
            targets = [np.full(len(v.pixels), number[v.target], np.int16) for v in of_pair]
            corners[name] = ObservedCorners(
                np.concatenate([view.pixels for view in of_pair]).astype(np.float32),
                solution.residuals(name).astype(np.float32),
                np.concatenate(targets),
            )
    return corners


def _with_pose(solution: RigSolution, view: LocatedView) -> LocatedView:
    camera_from_rig = solution.rig_from_camera[view.pair].inverse()
    return replace(view, camera_from_board=camera_from_rig @ solution.rig_from_board[view.target])


def make_solved_pair(
    rig: Rig, solution: RigSolution, name: str, boundaries: Mapping[ViewKey, BoardBoundaries]
) -> LocatedPair:
    """A pair with the camera, and the poses and shapes of its boards, of the joint solve.

    boundaries: of stripes on the boards, by view; views without any take part with their corners.
    """
    views = [view for view in solution.views if view.pair == name]
    shapes = solution.board_shapes
    return LocatedPair(
        name,
        solution.cameras[name],
        solution.camera_covariances[name],
        solution.rays.get(name),
        solution.lenses.get(name, ()),
        solution.rms_px[name],
        rig.pair(name).projector,
        tuple(_with_pose(solution, view) for view in views),
        tuple(
            StripedView(
                _with_pose(solution, view),
                rig.board(view.board),
                boundaries[view.key],
                shapes[view.board].face(view.points) if view.board in shapes else None,
            )
            for view in views
            if view.key in boundaries
        ),
        rig.boards,
        alone=len(solution.cameras) == 1,
    )


def update_poses(rig: Rig, solution: RigSolution, pair: PairCalibration) -> RigSolution:
    """Locate the boards again by a pair's camera, where its stripes refined that.

    The board that fixes the rig frame stays where it is, or else the camera. Only a pair by itself is
    refined by its stripes.
    """
    if pair.camera == solution.cameras[pair.name]:
        return solution
    camera_from_board = {
        view.target: locate_board(pair.camera, PlanarView(view.shot, view.points, view.pixels))[0]
        for view in solution.views
    }
    frame = find_frame_target(rig)
    rig_from_camera = (
        solution.rig_from_board[frame] @ camera_from_board[frame].inverse()
        if frame in camera_from_board
        else solution.rig_from_camera[pair.name]
    )
    return replace(
        solution,
        cameras={pair.name: pair.camera},
        rig_from_camera={pair.name: rig_from_camera},
        rig_from_board={
            target: rig_from_camera @ pose for target, pose in camera_from_board.items()
        },
    )
