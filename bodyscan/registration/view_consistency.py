"""Detect views of one board in one shot that contradict each other, and solve the rig without them.

Judged with the cameras as solved: every view by itself fits some pose of the board to within the
corners' noise; all views together must fit one. A view that was rejected takes no part, but each
later solve judges it again: the reason may have been a lens that was too simple, a board thought to
be flat, or another view.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from bodyscan.arrays import Array
from bodyscan.boards.view import ViewKey
from bodyscan.calibration.board_views import LocatedView, apply_shape
from bodyscan.geometry.camera import Camera
from bodyscan.geometry.least_squares import Block, Noise, minimize
from bodyscan.geometry.robust import compute_rms_length
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.outcome import Outcome
from bodyscan.registration.joint_solve import JointSolution, linearize_reprojection, refine_solution
from bodyscan.registration.view_graph import by_target

MIN_ERROR_PX = 0.2
CORNERS = Noise("corners", group=2, min_scale=0.1 * MIN_ERROR_PX)


def compute_error_limit(views: Iterable[LocatedView], cameras: Mapping[str, Camera]) -> float:
    """Error in px above which a view is inconsistent, by those of views at the poses that each was
    located at by itself."""
    errors = [_measure_misfit(view, cameras, view.camera_from_board) for view in views]
    return max(6.0 * float(np.median(errors)), MIN_ERROR_PX)


def find_inconsistent_views(
    views: Sequence[LocatedView], solution: JointSolution, limit_px: float
) -> Outcome[list[LocatedView]]:
    """Find the views that contradict the others of their board at their moment; one note for each
    cause, naming shot and pairs."""
    found = []
    for group in by_target(apply_shape(view, solution.shapes) for view in views).values():
        # A board of which no view took part in the solve is where the first view has it.
        root_from_view = solution.root_from_camera[group[0].pair] @ group[0].camera_from_board
        root_from_board = solution.root_from_board.get(group[0].target, root_from_view)
        errors = [
            _measure_misfit(
                view,
                solution.cameras,
                solution.root_from_camera[view.pair].inverse() @ root_from_board,
            )
            for view in group
        ]
        if max(errors) > limit_px:
            found.append(_examine_board(group, solution, root_from_board, limit_px))
    return Outcome(
        [view for one in found for view in one.value],
        tuple(note for one in found for note in one.notes),
    )


def _examine_board(
    group: list[LocatedView], solution: JointSolution, start: RigidTransform, limit_px: float
) -> Outcome[list[LocatedView]]:
    """Find which of one board's views in one shot are wrong, given that they contradict each other."""
    shot, board = group[0].target
    bad, notes = [], []
    for view in group:
        (error,) = _fit_from_two_starts([view], solution, start)
        if error > limit_px:
            bad.append(view)
            notes.append(
                f"{view.pair}: board {board} in shot {shot}: no pose fits (RMS {error:.2f} px), with "
                "any lens that the other views allow: view discarded, corners may be misnumbered"
            )
    kept = [view for view in group if view not in bad]
    errors = _fit_from_two_starts(kept, solution, start) if kept else np.zeros(1)
    if errors.max() > limit_px:
        agreeing = _find_largest_agreement(kept, solution, start, limit_px)
        others = [view for view in kept if view not in agreeing]
        bad += others
        notes.append(
            f"shot {shot}: the pose of board {board} differs for "
            f"{', '.join(sorted(view.pair for view in others))} (RMS {errors.max():.2f} px, limit "
            f"{limit_px:.2f}, with any lens); not used. Possible causes: the board moved, the "
            "images were not taken at the same moment, or its square_mm is not that of the rig file"
        )
    return Outcome(bad, tuple(notes))


def _find_largest_agreement(
    views: list[LocatedView], solution: JointSolution, start: RigidTransform, limit_px: float
) -> list[LocatedView]:
    """Leave out views one by one, each time the one without which the others agree best. Returns none
    if only two are left and disagree, since nothing shows which is right."""
    kept = list(views)
    while len(kept) > 2:
        rests = [[view for view in kept if view is not out] for out in kept]
        fits = [_fit_from_two_starts(rest, solution, start) for rest in rests]
        best = int(np.argmin([np.sum(rms**2) for rms in fits]))
        kept = rests[best]
        if fits[best].max() <= limit_px:
            return kept
    return []


def _fit_from_two_starts(
    views: Sequence[LocatedView], solution: JointSolution, start: RigidTransform
) -> Array:
    """RMS errors (V,) px at the board pose that fits all views, begun from the first view's pose
    and from `start`."""
    starts = [solution.root_from_camera[views[0].pair] @ views[0].camera_from_board]
    starts += [start] if len(views) > 1 else []
    fits = [np.array([*map(compute_rms_length, fit_board(views, solution, one))]) for one in starts]
    return min(fits, key=lambda rms: float(np.sum(rms**2)))


def fit_board(
    views: Sequence[LocatedView], solution: JointSolution, root_from_board: RigidTransform
) -> tuple[Array, ...]:
    """Fit one board pose to several views, from `root_from_board`; residuals (N, 2) px of each."""
    # The tolerance, in variances, is far less than separates a wrong view from a right one.
    fitted = minimize(
        root_from_board,
        lambda pose: [_evaluate_corners(view, solution, pose) for view in views],
        RigidTransform.retract,
        unknowns=6,
        steps=15,
        tolerance=1e-2,
        damping=1e-9,
    )
    return tuple(block.residuals.reshape(-1, 2) for block in fitted.blocks)


def _evaluate_corners(
    view: LocatedView, solution: JointSolution, root_from_board: RigidTransform
) -> Block:
    """Reprojection errors, px; derivatives by the board's motion."""
    poses = solution.cameras, solution.root_from_camera, {view.target: root_from_board}
    residuals, linearize = linearize_reprojection([view], *poses)
    return Block(residuals, lambda: linearize()[:, 6:12], slice(0, 6), CORNERS)


def _measure_misfit(
    view: LocatedView, cameras: Mapping[str, Camera], camera_from_board: RigidTransform
) -> float:
    """RMS reprojection error of a view with its board at that pose, px."""
    return compute_rms_length(
        cameras[view.pair].project(camera_from_board.apply(view.points)) - view.pixels
    )


@dataclass(frozen=True, eq=False)
class ConsistentSolve:
    """The joint solve of consistent views."""

    solution: JointSolution  # of all views but the wrong ones
    wrong: frozenset[ViewKey]  # keys of those
    notes: tuple[str, ...] = ()  # one line for each cause of being wrong

    def select_consistent(self, views: Sequence[LocatedView]) -> list[LocatedView]:
        """The views that took part."""
        return [view for view in views if view.key not in self.wrong]


def solve_consistently(
    views: Sequence[LocatedView],
    solution: JointSolution,
    *,
    root: str,
    limit_px: float,
    wrong: Collection[ViewKey] = (),
) -> ConsistentSolve:
    """Alternate between solving and judging until both settle; `wrong`: views to begin without."""
    at = ConsistentSolve(solution, frozenset(wrong))
    rounds = 4
    for number in range(rounds):
        kept = at.select_consistent(views)
        solved = refine_solution(kept, _with_boards_of(kept, at.solution), root=root)
        found = find_inconsistent_views(views, solved, limit_px)
        now = frozenset(view.key for view in found.value)
        if now == at.wrong:
            return ConsistentSolve(solved, now, found.notes)
        whole_cameras = 2 * len(now) > len(views)  # see `rig_solve`
        # In the last rounds no view returns, lest one leave and return for ever.
        last = whole_cameras or number >= rounds - 2
        at = ConsistentSolve(solved, now | at.wrong if last else now, found.notes)
        if whole_cameras:
            break
    return at


def _with_boards_of(views: Sequence[LocatedView], solution: JointSolution) -> JointSolution:
    """The solution with poses of exactly those boards that the views show."""
    poses = {
        view.target: solution.root_from_camera[view.pair] @ view.camera_from_board for view in views
    }
    return replace(
        solution,
        root_from_board={k: solution.root_from_board.get(k, start) for k, start in poses.items()},
    )
