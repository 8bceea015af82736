"""From board views of many pairs to one placed rig: graph, joint solve, bad views out, rig frame.

Two solvers follow each other: pycolmap's bundle adjustment (`joint_solve`) brings everything together
from the graph's rough start; our own least squares (`full_solve`) ends it with every parameter of our
cameras, and is what is repeated when views are taken out or boards turn out bent.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from bodyscan.arrays import Array
from bodyscan.calibration.board_views import LocatedView
from bodyscan.errors import RigDisconnected
from bodyscan.geometry.camera import Camera
from bodyscan.geometry.pose_covariance import PoseCovariance
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.outcome import Outcome
from bodyscan.registration.board_shape import BoardShape, ShapedSolution, with_board_shapes
from bodyscan.registration.full_solve import solve_fully
from bodyscan.registration.inconsistent_views import (
    error_limit,
    find_inconsistent_views,
    single_view_errors,
)
from bodyscan.registration.joint_solve import JointSolution, solve_jointly
from bodyscan.registration.normal_equations import CORNERS, normal_equations
from bodyscan.registration.rig_frame import frame_board_turn, frame_target, rig_from_root
from bodyscan.registration.view_graph import (
    Target,
    initial_poses,
    not_together,
    place_boards,
    view_graph,
)
from bodyscan.rig.rig import Rig

LOSS_PX = 0.3
COARSE_PX = 30.0
"""What a view may be off where only the graph has placed the pairs."""
ROUNDS = 3


@dataclass(frozen=True, eq=False)
class RigSolution:
    """Everything in the rig frame; cameras as the joint solve left them; rms_px of each pair.

    views: those used, their points where the boards' corners really lie.  board_shapes: of boards
    that are not as described, where others' views confirm it.
    """

    rig_from_camera: dict[str, RigidTransform]
    rig_from_board: dict[Target, RigidTransform]
    cameras: dict[str, Camera]
    covariance: PoseCovariance
    rms_px: dict[str, float]
    views: tuple[LocatedView, ...]
    board_shapes: dict[str, BoardShape]


@dataclass(frozen=True, eq=False)
class _Solved:
    solution: JointSolution
    views: list[LocatedView]
    dropped: list[LocatedView]
    notes: list[str]


def solve_rig(
    rig: Rig,
    views: Sequence[LocatedView],
    cameras: Mapping[str, Camera],
) -> Outcome[RigSolution]:
    """Join all pairs by their shared board views.

    Pairs that agree with the others in too few shots to be placed are failures.

    Raises RigDisconnected if groups of pairs share no view, only views whose board numbering leaves
    their poses open, or only views that contradict each other; BadInput if nothing fixes the rig
    frame.
    """
    start, left_out = initial_poses(views, sorted(cameras))
    while True:
        names = sorted(start)
        own = [view for view in views if view.pair in start]
        solved = _solve(own, {n: cameras[n] for n in names}, start)
        strangers = _strangers(solved)
        if not strangers:
            break
        if 2 * len(strangers) >= len(names):
            raise RigDisconnected(
                not_together(names),
                remedy="synchronise the cameras, or hold the board still until all have taken "
                "their picture; check the board's description in the rig file too",
            )
        left_out |= {name: not_together([name]) for name in strangers}
        start = {name: placing for name, placing in start.items() if name not in strangers}
    refine = len(start) > 1
    shaped = ShapedSolution(solved.solution, solved.views, {}, ())
    if refine:
        root = min(start)
        shaped = with_board_shapes(solved.views, solved.solution, root=root, refine_cameras=True)
    placed = _placed(rig, shaped, refine)
    return Outcome(placed, (*solved.notes, *shaped.notes), left_out)


def _solve(
    views: Sequence[LocatedView],
    cameras: dict[str, Camera],
    start: Mapping[str, RigidTransform],
) -> _Solved:
    """Solve, take out what cannot be true, solve again."""
    names = sorted(start)
    graph = view_graph(views, names)
    root = max(names, key=lambda name: (graph.degree(name), name))
    to_root = start[root].inverse()
    placed = {name: to_root @ placing for name, placing in start.items()}
    kept, boards, doubtful = place_boards(views, placed)
    solution = JointSolution(placed, boards, cameras)
    gross = find_inconsistent_views(
        [view for view in kept if view.target in doubtful], solution, COARSE_PX
    )
    notes, dropped = list(gross.notes), list(gross.wrong)
    kept = [view for view in kept if view not in gross.wrong]
    limit = error_limit(single_view_errors(kept, cameras))
    # One camera alone was solved with its skew already; nothing is left to join.
    refine = len(names) > 1
    solution = solve_jointly(kept, solution, root=root, refine_cameras=refine, loss_px=LOSS_PX)
    for _ in range(ROUNDS):
        solution = solve_fully(kept, solution, root=root, refine_cameras=refine)
        found = find_inconsistent_views(kept, solution, limit)
        if not found.wrong:
            break
        notes += found.notes
        dropped += found.wrong
        kept = [view for view in kept if view not in found.wrong]
        if 2 * len(found.wrong) > len(kept):
            break  # whole cameras are wrong, see `_strangers`
        seen = {view.target for view in kept}
        solution = replace(
            solution,
            root_from_board={k: t for k, t in solution.root_from_board.items() if k in seen},
        )
    return _Solved(solution, kept, dropped, notes)


def _strangers(solved: _Solved) -> list[str]:
    """Pairs most of whose shared views had to be taken out."""
    everything = [*solved.views, *solved.dropped]
    count = Counter(view.target for view in everything)
    shared = Counter(view.pair for view in everything if count[view.target] > 1)
    out = Counter(view.pair for view in solved.dropped if count[view.target] > 1)
    return sorted(name for name, number in shared.items() if 2 * out[name] > number)


def _placed(rig: Rig, solved: ShapedSolution, refine: bool) -> RigSolution:
    """The solution carried into the rig frame, with its covariance there."""
    solution, kept = _frame_board_turned(rig, solved.solution, solved.views)
    to_rig = rig_from_root(rig, solution.root_from_camera, solution.root_from_board)
    rig_from_camera = {name: to_rig @ t for name, t in solution.root_from_camera.items()}
    rig_from_board = {target: to_rig @ t for target, t in solution.root_from_board.items()}
    covariance = normal_equations(
        kept,
        solution.cameras,
        rig_from_camera,
        rig_from_board,
        fixed_pair=rig.frame_pair.name if rig.frame_pair else None,
        fixed_target=frame_target(rig),
        cameras_free=refine,
    ).covariance()
    rms = {
        name: _robust_rms(
            [
                corner_residuals(v, solution.cameras, rig_from_camera, rig_from_board)
                for v in kept
                if v.pair == name
            ]
        )
        for name in sorted(rig_from_camera)
    }
    return RigSolution(
        rig_from_camera,
        rig_from_board,
        solution.cameras,
        covariance,
        rms,
        tuple(kept),
        solved.shapes,
    )


def _frame_board_turned(
    rig: Rig, solution: JointSolution, views: list[LocatedView]
) -> tuple[JointSolution, list[LocatedView]]:
    target = frame_target(rig)
    turn = frame_board_turn(rig, solution.root_from_camera, solution.root_from_board)
    boards = {
        key: placing @ turn.inverse() if key == target else placing
        for key, placing in solution.root_from_board.items()
    }
    turned = [view.resolved(turn) if view.target == target else view for view in views]
    return replace(solution, root_from_board=boards), turned


def corner_residuals(
    view: LocatedView,
    cameras: Mapping[str, Camera],
    rig_from_camera: Mapping[str, RigidTransform],
    rig_from_board: Mapping[Target, RigidTransform],
) -> Array:
    """(N, 2) px: where a view's corners should be seen less where they are."""
    camera_from_board = rig_from_camera[view.pair].inverse() @ rig_from_board[view.target]
    return cameras[view.pair].project(camera_from_board.apply(view.points)) - view.pixels


def _robust_rms(parts: Sequence[Array]) -> float:
    """RMS distance of corners, px, with the weights of the solve's loss: outliers do not count."""
    if not parts:
        return float("nan")
    residuals = np.concatenate(parts).ravel()
    weights = CORNERS.weights(residuals / CORNERS.spread_of(residuals))
    return float(np.sqrt(2.0 * np.sum(weights * residuals**2) / np.sum(weights)))
