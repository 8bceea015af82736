"""The joint solve with every view judged by itself: wrong ones out, and back in where they fit.

A view that is out takes no part, but is judged again by each solve that follows: what it was put out
for may have been a lens that was too simple, a board thought flat, or a neighbour.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

from bodyscan.boards.view import ViewKey
from bodyscan.calibration.board_views import LocatedView
from bodyscan.registration.full_solve import solve_fully
from bodyscan.registration.inconsistent_views import find_inconsistent_views
from bodyscan.registration.joint_solve import JointSolution

ROUNDS = 4


@dataclass(frozen=True, eq=False)
class ConsistentSolve:
    """solution: of all views but the wrong ones.  notes: a line for each cause of being wrong."""

    solution: JointSolution
    wrong: frozenset[ViewKey]
    notes: tuple[str, ...] = ()

    def kept(self, views: Sequence[LocatedView]) -> list[LocatedView]:
        """Those of the views that took part."""
        return [view for view in views if view.key not in self.wrong]


def solve_consistently(
    views: Sequence[LocatedView],
    solution: JointSolution,
    *,
    root: str,
    refine_cameras: bool,
    limit_px: float,
    wrong: Collection[ViewKey] = (),
) -> ConsistentSolve:
    """Solve and judge in turn until both stand; `wrong`: views to begin without."""
    at = ConsistentSolve(solution, frozenset(wrong))
    for turn in range(ROUNDS):
        kept = at.kept(views)
        solved = solve_fully(
            kept, _boards_of(kept, at.solution), root=root, refine_cameras=refine_cameras
        )
        found = find_inconsistent_views(views, solved, limit_px)
        now = frozenset(view.key for view in found.wrong)
        if now == at.wrong:
            return ConsistentSolve(solved, now, found.notes)
        whole_cameras = 2 * len(now) > len(views)  # see `rig_solve`
        last = whole_cameras or turn >= ROUNDS - 2  # nothing comes and goes for ever
        at = ConsistentSolve(solved, now | at.wrong if last else now, found.notes)
        if whole_cameras:
            break
    return at


def _boards_of(views: Sequence[LocatedView], solution: JointSolution) -> JointSolution:
    """With a pose of each of the views' boards and of no other."""
    own = {
        view.target: solution.root_from_camera[view.pair] @ view.camera_from_board for view in views
    }
    return replace(
        solution,
        root_from_board={k: solution.root_from_board.get(k, start) for k, start in own.items()},
    )
