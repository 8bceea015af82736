"""Boards as they really are, bent or printed a little off, found from all views of them together.

Like OpenCV's calibrateCameraRO this frees the object's points, but for every board of a rig at once
and with all cameras together; it is used only where held-out boards fit better with it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import KDTree

from bodyscan.arrays import Array, Indices
from bodyscan.calibration.board_views import (
    BoardFace,
    LocatedView,
    corner_keys,
    match_corners,
)
from bodyscan.calibration.model_selection import MIN_GAIN, ResidualPair, gain
from bodyscan.geometry.linear_gaussian import LinearGaussianSystem
from bodyscan.geometry.robust import rms, rms_length
from bodyscan.geometry.transforms import fit_rigid_transform, twist_jacobian
from bodyscan.registration.joint_solve import (
    CORNERS,
    JointSolution,
    refine_solution,
    reprojection_errors,
    view_sigmas,
)
from bodyscan.registration.view_consistency import fit_board

PRIOR = 4e-3
"""Prior sigma of a corner's place, as a share of the board's diagonal (a millimetre in 250),
because boards may be given in any unit."""


@dataclass(frozen=True, eq=False)
class BoardShape:
    """Where a board's corners lie: nominal points (N, 3) and offsets (N, 3), board frame, mm.

    The offsets contain no common motion, and on average keep the size that the rig file gives,
    since images alone cannot tell a larger board farther away.
    """

    points: Array
    offsets: Array

    @property
    def diagonal(self) -> float:
        """Distance from the first corner to the last, mm."""
        return float(np.linalg.norm(np.ptp(self.points, axis=0)))

    @property
    def rms_mm(self) -> float:
        return rms_length(self.offsets)

    @property
    def out_of_plane_mm(self) -> float:
        """Height from the lowest to the highest corner of a face, mm."""
        return max(
            float(np.ptp(self.offsets[self.points[:, 2] == z, 2]))
            for z in np.unique(self.points[:, 2])
        )

    @property
    def stretch(self) -> tuple[float, float]:
        """Relative excess length of the board along its columns and along its rows."""
        along = (np.polyfit(self.points[:, axis], self.offsets[:, axis], 1)[0] for axis in range(2))
        x, y = (float(value) for value in along)
        return x, y

    @property
    def size_sigma(self) -> float:
        """Standard deviation of the size as a whole, relative, which images cannot tell.

        What stretches a print one way only, or shears it, is seen. Errors that know no direction
        change its size as much: each face shows two such strains, as large as the third is unseen.
        """
        strains = []
        for z in np.unique(self.points[:, 2]):
            face = self.points[:, 2] == z
            arms = self.points[face, :2] - self.points[face, :2].mean(axis=0)
            (xx, xy), (yx, yy) = np.linalg.lstsq(arms, self.offsets[face, :2], rcond=None)[0]
            strains += [0.5 * (xx - yy), 0.5 * (xy + yx)]
        return rms(np.array(strains))

    @property
    def prior_information(self) -> Array:
        """Information (3N, 3N) per mm2 on the corners before any view: the prior on each coordinate,
        the gauge constraint that the shape has no motion (the board has it), and the prior on its
        size."""
        points, sigma_mm = self.points + self.offsets, PRIOR * self.diagonal
        arms = points - points.mean(axis=0)
        motions, _ = np.linalg.qr(twist_jacobian(arms).reshape(-1, 6))
        gauge_mm = 1e-4 * sigma_mm  # a thousandth of what views determine
        size = arms.ravel() / np.linalg.norm(arms)
        size_mm = max(self.size_sigma * float(np.linalg.norm(arms)), gauge_mm)
        prior = np.eye(arms.size) / sigma_mm**2
        return prior + motions @ motions.T / gauge_mm**2 + np.outer(size, size) / size_mm**2

    def nearest(self, points: Array) -> Indices:
        """Indices (M,) of the corners nearest to the true points (M, 3) mm of a view."""
        return np.asarray(KDTree(self.points + self.offsets).query(points)[1], np.int64)

    def face(self, points: Array) -> BoardFace:
        """The face on which a view saw corners (M, 3), through every corner of it in any view."""
        away = np.abs(self.points[:, 2] - np.median(points[:, 2]))
        return BoardFace.fit((self.points + self.offsets)[away <= away.min() + 1e-3])

    def numbers(self, points: Array) -> Indices:
        """Indices (M,) of nominal points (M, 3) among its corners, -1 for unknown ones."""
        return match_corners(points, self.points)

    def apply(self, points: Array) -> Array:
        """Where nominal points (M, 3) of this board lie; unknown ones stay."""
        chosen = self.numbers(points)
        return points + np.where(chosen[:, None] >= 0, self.offsets[chosen], 0.0)


@dataclass(frozen=True, eq=False)
class ShapedSolution:
    """The solve with boards as found: shapes by board name, and views with their true points."""

    solution: JointSolution
    views: list[LocatedView]
    shapes: dict[str, BoardShape]
    notes: tuple[str, ...]


def estimate_board_shapes(
    views: Sequence[LocatedView], solution: JointSolution, *, root: str
) -> ShapedSolution:
    """Estimate board shapes if the residuals call for it; keep them if held-out boards agree."""
    plain = ShapedSolution(solution, list(views), {}, ())
    targets = sorted({view.target for view in views})
    # Each freed coordinate lowers the squared residuals by one variance by noise alone, and with
    # 48 corners or more by 1.25 once in 700 times.
    if len(targets) < 6 or _gain_per_unknown(views, solution) < 1.25:
        return plain
    held_out = _hold_out(views, solution, root)
    shaped = _estimate(views, solution, root)
    sizes = "; ".join(_describe(name, shape) for name, shape in sorted(shaped.shapes.items()))
    better_by = gain(held_out)
    figures = (
        f"boards held out fit to {_median(held_out.rich):.3f} px with it, "
        f"{_median(held_out.simple):.3f} without, by {better_by:.0f} standard errors"
    )
    if better_by < MIN_GAIN:
        return replace(plain, notes=(f"{sizes}: not used, {figures}",))
    return replace(shaped, notes=(f"{sizes}: used, {figures}",))


def reestimate_board_shapes(
    views: Sequence[LocatedView], solution: JointSolution, found: ShapedSolution, *, root: str
) -> ShapedSolution:
    """Estimate the shapes in `found` again, for other lenses or other views."""
    if not found.shapes:
        return replace(found, solution=solution, views=list(views))
    return replace(_estimate(views, solution, root, found.shapes), notes=found.notes)


def apply_shape(view: LocatedView, shapes: Mapping[str, BoardShape]) -> LocatedView:
    """The view with its corners where they lie on a board of that shape."""
    if view.board not in shapes:
        return view
    return replace(view, points=shapes[view.board].apply(view.points))


def _describe(name: str, shape: BoardShape) -> str:
    across, down = shape.stretch
    return (
        f"board {name} is not as described: corners {shape.rms_mm:.3f} mm RMS off, "
        f"{shape.out_of_plane_mm:.2f} mm out of plane, "
        f"{1e3 * (across - down):+z.2f} per mille wider than high (its size as a whole cannot be seen)"
    )


def _estimate(
    views: Sequence[LocatedView],
    solution: JointSolution,
    root: str,
    start: Mapping[str, BoardShape] | None = None,
    *,
    equal_noise: bool = False,
) -> ShapedSolution:
    """Alternate between shapes and everything else until both settle.

    start: shapes that the solution has; None for boards as described.
    equal_noise: see `refine_solution`.
    """
    shapes = _flat(views)
    if start:
        shapes = {
            name: replace(shape, offsets=start[name].apply(shape.points) - shape.points)
            for name, shape in shapes.items()
        }
    shaped = [apply_shape(view, shapes) for view in views]
    numbers = [shapes[view.board].numbers(view.points) for view in views]
    for _ in range(30):
        steps = _corner_steps(shaped, numbers, shapes, solution, equal_noise)
        # Over-relaxation of the corner steps: cameras and poses follow the corners.
        shapes = {
            name: _without_motion(replace(shape, offsets=shape.offsets + 1.6 * steps[name]))
            for name, shape in shapes.items()
        }
        shaped = [
            replace(view, points=view.points + shapes[view.board].offsets[corners])
            for view, corners in zip(views, numbers, strict=True)
        ]
        solution = refine_solution(shaped, solution, root=root, equal_noise=equal_noise)
        moved = (np.sqrt(np.mean(steps[name] ** 2)) / s.diagonal for name, s in shapes.items())
        # RMS of a step, as a share of the board's diagonal: at twice that a stretch was found to
        # 88 %.
        if max(moved) < 2e-6:
            break
    return ShapedSolution(solution, shaped, shapes, ())


def _flat(views: Sequence[LocatedView]) -> dict[str, BoardShape]:
    """Flat shapes of all corners that any view shows, by board."""
    boards = sorted({view.board for view in views})
    observed = (np.concatenate([v.points for v in views if v.board == name]) for name in boards)
    nominal = (np.unique(corner_keys(points), axis=0) for points in observed)
    return {n: BoardShape(p, np.zeros_like(p)) for n, p in zip(boards, nominal, strict=True)}


def _without_motion(shape: BoardShape) -> BoardShape:
    """The same shape, with the pose and size of the nominal board."""
    moved = shape.points + shape.offsets
    fitted = fit_rigid_transform(moved, shape.points).apply(moved)
    middle = shape.points.mean(axis=0)
    arms, found = shape.points - middle, fitted - fitted.mean(axis=0)
    size = np.sum(arms * arms) / np.sum(arms * found)
    return replace(shape, offsets=size * found - arms)


def _corner_steps(
    shaped: Sequence[LocatedView],
    numbers: Sequence[Indices],
    shapes: Mapping[str, BoardShape],
    solution: JointSolution,
    equal_noise: bool,
) -> dict[str, Array]:
    """Gauss-Newton steps (N, 3) mm of single corners, with a prior at the nominal board."""
    systems, variance = _corner_systems(shaped, numbers, shapes, solution, equal_noise)
    steps = {}
    for name, shape in shapes.items():
        weight = variance / (PRIOR * shape.diagonal) ** 2
        prior = LinearGaussianSystem(weight * np.eye(3), -weight * shape.offsets)
        steps[name] = (systems[name] + prior).solve()
    return steps


def _gain_per_unknown(views: Sequence[LocatedView], solution: JointSolution) -> float:
    """Mean reduction of the squared residuals per coordinate of freed corners, in variances."""
    shapes = _flat(views)
    numbers = [shapes[view.board].numbers(view.points) for view in views]
    systems, variance = _corner_systems(views, numbers, shapes, solution, True)
    gain = sum(
        np.einsum(
            "ni,nij,nj->",
            system.vector,
            np.linalg.pinv(system.information, rcond=1e-6, hermitian=True),
            system.vector,
        )
        for system in systems.values()
    )
    return float(gain / (variance * sum(system.vector.size for system in systems.values())))


def _corner_systems(
    shaped: Sequence[LocatedView],
    numbers: Sequence[Indices],
    shapes: Mapping[str, BoardShape],
    solution: JointSolution,
    equal_noise: bool,
) -> tuple[dict[str, LinearGaussianSystem], float]:
    """Systems of each board's corners, a stack (N, 3), and the variance in px2.

    shaped: views with points where they are thought to lie.
    numbers: indices of these points in their board's shape.
    """
    ends = np.cumsum([len(shape.points) for shape in shapes.values()])
    first = dict(zip(shapes, [0, *ends[:-1].tolist()], strict=True))
    corners, parts = [], []
    for pair in sorted({view.pair for view in shaped}):
        of_pair = [k for k, view in enumerate(shaped) if view.pair == pair]
        corners += [first[shaped[k].board] + numbers[k] for k in of_pair]
        parts.append(_by_corner([shaped[k] for k in of_pair], solution))
    every = [residuals for _, of_pair in parts for residuals in of_pair]
    sigmas = np.ones(len(every)) if equal_noise else view_sigmas([one.ravel() for one in every])
    sigma = np.repeat(sigmas, [len(residuals) for residuals in every])
    jacobian = np.concatenate([by_corner for by_corner, _ in parts]) / sigma[:, None, None]
    residuals = np.concatenate(every) / sigma[:, None]
    weights = CORNERS.weights(residuals.ravel() / CORNERS.estimate_scale(residuals.ravel()))
    variance = float(np.sum(weights * residuals.ravel() ** 2) / np.sum(weights))
    each = LinearGaussianSystem.from_observations(jacobian, -residuals, weights.reshape(-1, 2))
    information, vector = np.zeros((ends[-1], 3, 3)), np.zeros((ends[-1], 3))
    np.add.at(information, np.concatenate(corners), each.information)
    np.add.at(vector, np.concatenate(corners), each.vector)
    split = zip(np.split(information, ends[:-1]), np.split(vector, ends[:-1]), strict=True)
    systems = [LinearGaussianSystem(*arrays) for arrays in split]
    return dict(zip(shapes, systems, strict=True)), variance


def _by_corner(views: Sequence[LocatedView], solution: JointSolution) -> tuple[Array, list[Array]]:
    """Derivatives and residuals of the corners seen by one pair.

    (N, 2, 3) px/mm: of pixels by the corners' places on their boards.
    (M, 2) px of each view: residuals.
    """
    poses = solution.cameras, solution.root_from_camera, solution.root_from_board
    residuals, linearize = reprojection_errors(views, *poses, cameras_free=False)
    counts = [len(view.points) for view in views]
    rotations = [solution.root_from_board[view.target].rotation for view in views]
    # A corner's position in the root frame acts as its board's translation does.
    by_corner = linearize().reshape(-1, 2, 12)[:, :, 9:] @ np.repeat(rotations, counts, axis=0)
    return by_corner, np.split(residuals.reshape(-1, 2), np.cumsum(counts)[:-1])


def _hold_out(views: Sequence[LocatedView], solution: JointSolution, root: str) -> ResidualPair:
    """Residuals of held-out boards, flat and in the shape found from the rest, both posed by the
    rest's cameras."""
    targets = sorted({view.target for view in views})
    flat_residuals, shaped_residuals, part = [], [], []
    for half in range(2):
        left_out = set(targets[half::2])
        others = [view for view in views if view.target not in left_out]
        kept = {t: p for t, p in solution.root_from_board.items() if t not in left_out}
        start = replace(solution, root_from_board=kept)
        # While it is open whether boards are as described, what they err by for that is no noise.
        flat = refine_solution(others, start, root=root, equal_noise=True)
        shaped = _estimate(others, flat, root, equal_noise=True)
        for target in sorted(left_out):
            of_board = [view for view in views if view.target == target]
            true = [apply_shape(view, shaped.shapes) for view in of_board]
            root_from_board = solution.root_from_board[target]
            flat_residuals.append(np.concatenate(fit_board(of_board, flat, root_from_board)))
            shaped_residuals.append(
                np.concatenate(fit_board(true, shaped.solution, root_from_board))
            )
            part.append(np.full(len(flat_residuals[-1]), targets.index(target)))
    every = ResidualPair(
        np.concatenate(flat_residuals), np.concatenate(shaped_residuals), np.concatenate(part)
    )
    return _without_extremes(every)


def _without_extremes(compared: ResidualPair) -> ResidualPair:
    """Drop the board most in favour of the shape and the one most against it.

    Where half of the views leave a lens open beyond their boards, one board there would decide
    alone.
    """
    better = np.sum(compared.simple**2 - compared.rich**2, axis=1)
    boards = np.unique(compared.cluster)
    order = np.argsort([better[compared.cluster == board].mean() for board in boards])
    kept = np.isin(compared.cluster, boards[order[1:-1]])
    return ResidualPair(compared.simple[kept], compared.rich[kept], compared.cluster[kept])


def _median(residuals: Array) -> float:
    """Median length, px."""
    return float(np.sqrt(np.median(np.sum(residuals**2, axis=1))))
