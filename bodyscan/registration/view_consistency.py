"""Detect views of one board at one moment that cannot all be true, and solve the rig without them.

Judged with the cameras as solved: every view by itself fits some pose of the board to within the
corners' noise; all views together must fit one. A view that was rejected takes no part, but each
later solve judges it again: the reason may have been a lens that was too simple, a board thought to
be flat, or another view.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from bodyscan.arrays import Array
from bodyscan.boards.view import ViewKey
from bodyscan.calibration.board_views import LocatedView
from bodyscan.geometry.camera import Camera
from bodyscan.geometry.least_squares import Block, Noise, minimize
from bodyscan.geometry.robust import rms_length
from bodyscan.geometry.transforms import RigidTransform, twist_jacobian
from bodyscan.registration.bundle_adjustment import refine_solution
from bodyscan.registration.joint_solve import JointSolution
from bodyscan.registration.view_graph import by_target

MIN_ERROR_PX = 0.2
MIN_SIZE_ERROR = 0.005
"""A board whose squares seem to differ by this share is another board."""
CORNERS = Noise("corners", group=2, min_scale=0.1 * MIN_ERROR_PX)


@dataclass(frozen=True, eq=False)
class InconsistentViews:
    """Views that contradict the others.

    wrong: the views not to be used.
    notes: one line for each cause, naming shot and pairs.
    sizes: name and relative size of boards whose squares seem larger or smaller.
    """

    wrong: tuple[LocatedView, ...]
    notes: tuple[str, ...]
    sizes: tuple[tuple[str, float], ...] = ()


@dataclass(frozen=True, eq=False)
class BoardFit:
    """One board pose for several views.

    residuals: (N, 2) px of each view.
    size: the board's apparent size, relative to its description.
    """

    residuals: tuple[Array, ...]
    size: float

    @property
    def rms_px(self) -> Array:
        """RMS error of each view, (V,)."""
        return np.array([rms_length(residuals) for residuals in self.residuals])


def single_view_errors(views: Iterable[LocatedView], cameras: Mapping[str, Camera]) -> Array:
    """RMS error of each view at the pose it was located at by itself, (V,) px."""
    return np.array(
        [
            rms_length(
                cameras[view.pair].project(view.camera_from_board.apply(view.points)) - view.pixels
            )
            for view in views
        ]
    )


def error_limit(errors: Array) -> float:
    """Error in px above which a view is inconsistent; errors: (V,) from `single_view_errors`."""
    return max(6.0 * float(np.median(errors)), MIN_ERROR_PX)


def find_inconsistent_views(
    views: Sequence[LocatedView], solution: JointSolution, limit_px: float
) -> InconsistentViews:
    """Find the wrong views among those of each board at each moment."""
    found = [
        _examine_board(group, solution, limit_px)
        for group in by_target(views).values()
        if max(_error(view, solution, _board_pose(group, solution)) for view in group) > limit_px
    ]
    sizes = tuple(size for one in found for size in one.sizes)
    return InconsistentViews(
        tuple(view for one in found for view in one.wrong),
        (*_wrong_squares(sizes), *(note for one in found for note in one.notes)),
        sizes,
    )


def _wrong_squares(sizes: Sequence[tuple[str, float]]) -> Iterator[str]:
    """One line for each board that seems to have the same other size in shot after shot."""
    for name in sorted({name for name, _ in sizes}):
        sizes_of_board = np.array([size for board, size in sizes if board == name])
        median = float(np.median(sizes_of_board))
        if (
            len(sizes_of_board) >= 3
            and np.mean(np.abs(sizes_of_board - median) < MIN_SIZE_ERROR) > 0.5
        ):
            yield (
                f"board {name} has squares {median:.3f} times as large as the rig file says, measured "
                f"by the other boards in {len(sizes_of_board)} shots: correct its square_mm"
            )


def _examine_board(
    group: list[LocatedView], solution: JointSolution, limit_px: float
) -> InconsistentViews:
    """Find which of one board's views at one moment are wrong, given that not all can be true."""
    shot, board = group[0].target
    start = _board_pose(group, solution)
    errors = [_fit_from_two_starts([view], solution, start).rms_px[0] for view in group]
    bad = [view for view, error in zip(group, errors, strict=True) if error > limit_px]
    notes = [
        f"{view.pair}: board {board} in shot {shot} fits no pose "
        f"({error:.2f} px) with any lens that the other views allow; corners may be mixed up; not used"
        for view, error in zip(group, errors, strict=True)
        if error > limit_px
    ]
    kept = [view for view in group if view not in bad]
    joint_fit = _fit_from_two_starts(kept, solution, start) if kept else None
    if joint_fit is None or joint_fit.rms_px.max() <= limit_px:
        return InconsistentViews(tuple(bad), tuple(notes))
    scaled_fit = _fit_from_two_starts(kept, solution, start, free_size=True)
    if scaled_fit.rms_px.max() <= limit_px and abs(scaled_fit.size - 1.0) > MIN_SIZE_ERROR:
        note = (
            f"shot {shot}: the squares of board {board} seen by {_names(kept)} are "
            f"{scaled_fit.size:.3f} times as large as described; not used. Possible cause: another "
            "board"
        )
        return InconsistentViews(tuple(group), (*notes, note), ((board, scaled_fit.size),))
    agreeing = _largest_agreement(kept, solution, start, limit_px)
    others = [view for view in kept if view not in agreeing]
    note = (
        f"shot {shot}: the pose of board {board} differs for {_names(others)} "
        f"({joint_fit.rms_px.max():.2f} px, limit {limit_px:.2f}, with any lens); not used. Possible "
        "causes: the board moved, or the pictures were not taken at the same moment"
    )
    return InconsistentViews((*bad, *others), (*notes, note))


def _largest_agreement(
    views: list[LocatedView],
    solution: JointSolution,
    start: RigidTransform,
    limit_px: float,
) -> list[LocatedView]:
    """Leave out views one by one, each time the one without which the others agree best.

    Returns none if only two are left and disagree, since nothing shows which is right.
    """
    kept = list(views)
    while len(kept) > 2:
        rests = [[view for view in kept if view is not out] for out in kept]
        fits = [_fit_from_two_starts(rest, solution, start).rms_px for rest in rests]
        best = int(np.argmin([np.sum(rms**2) for rms in fits]))
        kept = rests[best]
        if fits[best].max() <= limit_px:
            return kept
    return []


def _fit_from_two_starts(
    views: Sequence[LocatedView],
    solution: JointSolution,
    start: RigidTransform,
    *,
    free_size: bool = False,
) -> BoardFit:
    """The board pose (and size) that fits all views, begun from the first view's or `start`."""
    root_from_view = solution.root_from_camera[views[0].pair] @ views[0].camera_from_board
    first = fit_board(views, solution, root_from_view, free_size=free_size)
    if len(views) == 1:
        return first
    second = fit_board(views, solution, start, free_size=free_size)
    return min(first, second, key=lambda fit: float(np.sum(fit.rms_px**2)))


def fit_board(
    views: Sequence[LocatedView],
    solution: JointSolution,
    root_from_board: RigidTransform,
    *,
    free_size: bool = False,
) -> BoardFit:
    """The board pose (and size) that fits all views, starting from `root_from_board`."""
    unknowns = 7 if free_size else 6
    # The tolerance, in variances, is far less than separates a wrong view from a right one.
    fitted = minimize(
        (root_from_board, 1.0),
        lambda state: [_corners(view, solution, state, unknowns) for view in views],
        lambda state, step: (state[0].retract(step[:6]), state[1] + float(np.sum(step[6:]))),
        unknowns=unknowns,
        steps=15,
        tolerance=1e-2,
        damping=1e-9,
    )
    residuals = tuple(block.residuals.reshape(-1, 2) for block in fitted.blocks)
    return BoardFit(residuals, fitted.state[1])


def _corners(
    view: LocatedView, solution: JointSolution, state: tuple[RigidTransform, float], unknowns: int
) -> Block:
    """Reprojection errors, px; derivatives by the board's motion and size."""
    (root_from_board, size), camera = state, solution.cameras[view.pair]
    camera_from_root = solution.root_from_camera[view.pair].inverse()
    in_root = root_from_board.apply(size * view.points)
    in_camera = camera_from_root.apply(in_root)

    def linearize() -> Array:
        by_root = camera.jacobians(in_camera)[1] @ camera_from_root.rotation
        by_size = by_root @ root_from_board.rotate(view.points)[..., None]
        jacobian = np.concatenate([by_root @ twist_jacobian(in_root), by_size], axis=2)
        return jacobian.reshape(-1, 7)[:, :unknowns]

    residuals = (camera.project(in_camera) - view.pixels).ravel()
    return Block(residuals, linearize, slice(0, unknowns), CORNERS)


def _error(view: LocatedView, solution: JointSolution, root_from_board: RigidTransform) -> float:
    camera_from_root = solution.root_from_camera[view.pair].inverse()
    camera_from_board = camera_from_root @ root_from_board
    projected = solution.cameras[view.pair].project(camera_from_board.apply(view.points))
    return rms_length(projected - view.pixels)


def _board_pose(group: Sequence[LocatedView], solution: JointSolution) -> RigidTransform:
    """Pose of the views' board; if none took part in the solve, that of the first view."""
    root_from_view = solution.root_from_camera[group[0].pair] @ group[0].camera_from_board
    return solution.root_from_board.get(group[0].target, root_from_view)


def _names(views: Sequence[LocatedView]) -> str:
    return ", ".join(sorted(view.pair for view in views))


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
        solved = refine_solution(
            kept, _with_boards_of(kept, at.solution), root=root, refine_cameras=refine_cameras
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


def _with_boards_of(views: Sequence[LocatedView], solution: JointSolution) -> JointSolution:
    """The solution with poses of exactly those boards that the views show."""
    poses = {
        view.target: solution.root_from_camera[view.pair] @ view.camera_from_board for view in views
    }
    return replace(
        solution,
        root_from_board={k: solution.root_from_board.get(k, start) for k, start in poses.items()},
    )
