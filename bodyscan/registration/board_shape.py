"""Boards as they really are, bent or printed a little off, found from all views of them together.

Like OpenCV's calibrateCameraRO this frees the object's points, but for every board of a rig at once
and with all cameras together; it is used only where held-out boards fit better with it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from bodyscan.arrays import Array
from bodyscan.calibration.board_views import BoardShape, LocatedView, apply_shape, make_corner_keys
from bodyscan.calibration.camera import CORNERS
from bodyscan.calibration.model_selection import MIN_GAIN, ResidualPair, gain
from bodyscan.geometry.linear_gaussian import LinearGaussianSystem
from bodyscan.outcome import Outcome
from bodyscan.registration.joint_solve import JointSolution, linearize_reprojection, refine_solution
from bodyscan.registration.view_consistency import ConsistentSolve, fit_board
from bodyscan.registration.view_graph import by_target


def estimate_board_shapes(
    every: Sequence[LocatedView], judged: ConsistentSolve, *, root: str
) -> Outcome[JointSolution]:
    """Free the boards' corners if the residuals call for it; keep them if held-out boards agree.

    every: views, of boards as described, from which `judged` selects the consistent ones. The
        solution has shapes of all corners of these, or none.
    """
    views, solution, flat = judged.select_consistent(every), judged.solution, _make_flat(every)
    targets = sorted({view.target for view in views})
    # Each freed coordinate lowers the squared residuals by one variance by noise alone, and with
    # 48 corners or more by 1.25 once in 700 times.
    if len(targets) < 6 or _compute_gain_per_unknown(views, solution, flat) < 1.25:
        return Outcome(solution)
    held_out = _hold_out(views, solution, flat, root)
    shaped = refine_solution(views, replace(solution, shapes=flat), root=root)
    sizes = "; ".join(_describe(name, shape) for name, shape in sorted(shaped.shapes.items()))
    better_by = gain(held_out)
    figures = (
        f"boards held out fit to {_compute_median(held_out.rich):.3f} px with it, "
        f"{_compute_median(held_out.simple):.3f} without, by {better_by:.0f} standard errors"
    )
    if better_by < MIN_GAIN:
        return Outcome(solution, (f"{sizes}: not used, {figures}",))
    return Outcome(shaped, (f"{sizes}: used, {figures}",))


def _make_flat(views: Sequence[LocatedView]) -> dict[str, BoardShape]:
    """Flat shapes of all corners that any view shows, by board."""
    boards = sorted({view.board for view in views})
    observed = (np.concatenate([v.points for v in views if v.board == name]) for name in boards)
    nominal = (np.unique(make_corner_keys(points), axis=0) for points in observed)
    return {n: BoardShape(p, np.zeros_like(p)) for n, p in zip(boards, nominal, strict=True)}


def _describe(name: str, shape: BoardShape) -> str:
    across, down = shape.stretch
    return (
        f"board {name} is not as described: corners {shape.rms_mm:.3f} mm RMS off, "
        f"{shape.out_of_plane_mm:.2f} mm out of plane, "
        f"{1e3 * (across - down):+z.2f} per mille wider than high (its size as a whole cannot be seen)"
    )


def _compute_gain_per_unknown(
    views: Sequence[LocatedView], solution: JointSolution, shapes: Mapping[str, BoardShape]
) -> float:
    """Mean reduction of the squared residuals per coordinate of freed corners, in variances."""
    ends = np.cumsum([len(shape.points) for shape in shapes.values()])
    first = dict(zip(shapes, [0, *ends[:-1].tolist()], strict=True))
    corners, errors, derivatives = [], [], []
    for view in views:
        residuals, linearize = linearize_reprojection(
            [view], solution.cameras, solution.root_from_camera, solution.root_from_board
        )
        corners.append(first[view.board] + shapes[view.board].numbers(view.points))
        errors.append(residuals.reshape(-1, 2))
        derivatives.append(linearize()[:, -3:].reshape(-1, 2, 3))
    residuals = np.concatenate(errors)
    weights = CORNERS.weights(residuals.ravel() / CORNERS.estimate_scale(residuals.ravel()))
    variance = float(np.sum(weights * residuals.ravel() ** 2) / np.sum(weights))
    each = LinearGaussianSystem.from_observations(
        np.concatenate(derivatives), -residuals, weights.reshape(-1, 2)
    )
    information, vector = np.zeros((ends[-1], 3, 3)), np.zeros((ends[-1], 3))
    np.add.at(information, np.concatenate(corners), each.information)
    np.add.at(vector, np.concatenate(corners), each.vector)
    inverse = np.linalg.pinv(information, rcond=1e-6, hermitian=True)
    return float(np.einsum("ni,nij,nj->", vector, inverse, vector) / (variance * vector.size))


def _hold_out(
    views: Sequence[LocatedView], solution: JointSolution, shapes: dict[str, BoardShape], root: str
) -> ResidualPair:
    """Residuals of held-out boards, flat and with the shape fitted to the rest; cameras are the
    rest's in both."""
    targets = sorted({view.target for view in views})
    flat_residuals, shaped_residuals, part = [], [], []
    for half in range(2):
        left_out = set(targets[half::2])
        others = [view for view in views if view.target not in left_out]
        kept = {t: p for t, p in solution.root_from_board.items() if t not in left_out}
        start = replace(solution, root_from_board=kept)
        # While it is open whether boards are as described, what they err by for that is no noise.
        flat = refine_solution(others, start, root=root, equal_noise=True)
        start = replace(flat, shapes=shapes)
        shaped = refine_solution(others, start, root=root, equal_noise=True)
        groups = [group for target, group in by_target(views).items() if target in left_out]
        if solution.motions:  # then each view shows its board where only it saw it
            groups = [[view] for group in groups for view in group]
        for group in groups:
            true = [apply_shape(view, shaped.shapes) for view in group]
            root_from_board = solution.root_from_board[group[0].target]
            flat_residuals.append(np.concatenate(fit_board(group, flat, root_from_board)))
            shaped_residuals.append(np.concatenate(fit_board(true, shaped, root_from_board)))
            part.append(np.full(len(flat_residuals[-1]), targets.index(group[0].target)))
    every = ResidualPair(
        np.concatenate(flat_residuals), np.concatenate(shaped_residuals), np.concatenate(part)
    )
    return _drop_extremes(every)


def _drop_extremes(compared: ResidualPair) -> ResidualPair:
    """Drop the board most in favour of the shape and the one most against it.

    Where half of the views leave a lens open beyond their boards, one board would decide alone.
    """
    better = np.sum(compared.simple**2 - compared.rich**2, axis=1)
    boards = np.unique(compared.cluster)
    order = np.argsort([better[compared.cluster == board].mean() for board in boards])
    kept = np.isin(compared.cluster, boards[order[1:-1]])
    return ResidualPair(compared.simple[kept], compared.rich[kept], compared.cluster[kept])


def _compute_median(residuals: Array) -> float:
    """Median length, px."""
    return float(np.sqrt(np.median(np.sum(residuals**2, axis=1))))
