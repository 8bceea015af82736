"""The joint solve with every view judged separately: wrong ones leave, and return once they fit.

A view that has left takes no part, but each later solve judges it again: the reason may have been a
lens that was too simple, a board thought to be flat, or another view.
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
    """The joint solve of consistent views.

    solution: of all views but the wrong ones.
    wrong: keys of those.
    notes: one line for each cause of being wrong.
    """

    solution: JointSolution
    wrong: frozenset[ViewKey]
    notes: tuple[str, ...] = ()

    def kept(self, views: Sequence[LocatedView]) -> list[LocatedView]:
        """The views that took part."""
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
    """Alternate between solving and judging until both settle; `wrong`: views to begin without."""
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
        last = whole_cameras or turn >= ROUNDS - 2  # so that no view leaves and returns for ever
        at = ConsistentSolve(solved, now | at.wrong if last else now, found.notes)
        if whole_cameras:
            break
    return at


def _boards_of(views: Sequence[LocatedView], solution: JointSolution) -> JointSolution:
    """The solution with poses of exactly those boards that the views show."""
    own = {
        view.target: solution.root_from_camera[view.pair] @ view.camera_from_board for view in views
    }
    return replace(
        solution,
        root_from_board={k: solution.root_from_board.get(k, start) for k, start in own.items()},
    )
