"""Which pair or pole of a calibrated rig has moved, found from boards that several pairs see.

Every view of a board gives the board's pose in its camera. Carried through the calibration, all
views of one board must agree; pairs whose views do not have moved. Single pairs or whole poles are
freed one after another, each time the one that explains most, until the rest fits.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from bodyscan.arrays import Array
from bodyscan.calibration.board_views import LocatedView
from bodyscan.geometry.camera import Camera
from bodyscan.geometry.linear_gaussian import LinearGaussianSystem, invert_scaled
from bodyscan.geometry.transforms import RigidTransform, adjoint, twist_jacobian
from bodyscan.geometry.uncertainty import PoseCovariance, point_covariance
from bodyscan.registration.view_graph import Target

Group = tuple[str, tuple[str, ...]]
"""A name to show, and the pairs that move as one."""


@dataclass(frozen=True, eq=False)
class ObservedPose:
    """A board as one pair sees it.

    whitener: (6, 6), from a motion of the board in the camera frame (rotation vector in radians,
        translation in mm) to independent standard deviations.
    """

    pair: str
    target: Target
    camera_from_board: RigidTransform
    whitener: Array


def observe_pose(view: LocatedView, camera: Camera, sigma_px: float) -> ObservedPose:
    """A board's pose from a view's corners, each off by `sigma_px`."""
    points = view.camera_from_board.apply(view.points)
    jacobian = (camera.jacobians(points)[1] @ twist_jacobian(points)).reshape(-1, 6)
    # Corners of one view share errors of lens and detector: three count as one.
    information = jacobian.T @ jacobian / (3.0 * sigma_px**2)
    whitener = np.asarray(np.linalg.cholesky(information).T, np.float64)
    return ObservedPose(view.pair, view.target, view.camera_from_board, whitener)


@dataclass(frozen=True, eq=False)
class Move:
    """A motion of pairs that moved together: one pair, or all of a pole."""

    name: str
    pairs: tuple[str, ...]
    motion: RigidTransform  # in the rig frame, `new rig_from_camera = motion @ old`
    covariance: Array  # (6, 6) of the motion's twist
    # shift_mm, sigma_mm: shift of the cameras' centroid, and its sigma over all axes.
    shift_mm: float
    sigma_mm: float

    @property
    def turn_deg(self) -> float:
        """Angle of the rotation."""
        return float(np.degrees(self.motion.angle))


@dataclass(frozen=True, eq=False)
class Drift:
    """What moved."""

    moves: tuple[Move, ...]  # in the order found, the clearest first
    rig_from_board: dict[Target, RigidTransform]  # of the boards used
    # misfit_before, misfit: RMS error of the views in sigmas, before and after all moves.
    misfit_before: float
    misfit: float
    lonely: tuple[str, ...]  # pairs that share no board with another


def find_drift(
    poses: Sequence[ObservedPose],
    rig_from_camera: Mapping[str, RigidTransform],
    prior: PoseCovariance,
    poles: Mapping[str, str],
) -> Drift:
    """Find the pairs and poles that moved.

    prior: covariance of the calibrated `rig_from_camera`.
    poles: the pole of each pair that stands on one.

    Boards that only one pair sees carry no information.
    """
    shared = [pose for pose in poses if len({p.pair for p in poses if p.target == pose.target}) > 1]
    pairs = tuple(sorted({pose.pair for pose in shared}))
    lonely = tuple(sorted({pose.pair for pose in poses} - set(pairs)))
    if not shared:
        return Drift((), {}, 0.0, 0.0, lonely)
    poses_of_pairs = {name: rig_from_camera[name] for name in pairs}
    # The pair that fixes the rig frame has zero covariance: give it a micron.
    micron = np.diag(np.tile([1e-6**2] * 3 + [1e-3**2] * 3, len(pairs)))
    known = LinearGaussianSystem.from_prior(invert_scaled(prior.select(pairs) + micron))
    candidates = _list_groups(pairs, poles)
    fit = before = _fit(shared, poses_of_pairs, known, [])
    while candidates:
        fits = [_fit(shared, poses_of_pairs, known, [*fit.groups, one]) for one in candidates]
        best = min(fits, key=lambda one: one.cost)
        # Chi-squared with six degrees of freedom exceeds 45 once in twenty million by chance.
        if fit.cost - best.cost < 45.0:
            break
        fit, (_, moved) = best, best.groups[-1]
        candidates = [other for other in candidates if not set(other[1]) & set(moved)]
    moves = (fit.move(number, poses_of_pairs) for number in range(len(fit.groups)))
    freedoms = max(6 * (len(shared) - len(fit.boards)), 1)
    return Drift(
        # Moves below 0.1 mm and 0.005 degrees, however significant, harm no scan.
        tuple(move for move in moves if move.shift_mm > 0.1 or move.turn_deg > 0.005),
        fit.boards,
        float(np.sqrt(before.cost / freedoms)),
        float(np.sqrt(fit.cost / freedoms)),
        lonely,
    )


def _list_groups(pairs: Sequence[str], poles: Mapping[str, str]) -> list[Group]:
    """Every pair, and every pole with several pairs."""
    groups: list[Group] = [(f"pair {name}", (name,)) for name in pairs]
    for pole in sorted({poles[name] for name in pairs if name in poles}):
        members = tuple(name for name in pairs if poles.get(name) == pole)
        if 1 < len(members) < len(pairs):
            groups.append((f"pole {pole}", members))
    return groups


@dataclass(frozen=True, eq=False)
class _Fit:
    """Groups that may have moved, their motions with the covariance (6, 6) of each, poses of the
    boards, and chi-squared."""

    groups: list[Group]
    motions: list[RigidTransform]
    covariances: list[Array]
    boards: dict[Target, RigidTransform]
    cost: float

    def move(self, number: int, rig_from_camera: Mapping[str, RigidTransform]) -> Move:
        (name, pairs), motion = self.groups[number], self.motions[number]
        middle = np.mean([rig_from_camera[pair].translation for pair in pairs], axis=0)
        shift_mm = float(np.linalg.norm(motion.apply(middle) - middle))
        covariance = self.covariances[number]
        sigma_mm = float(np.sqrt(np.trace(point_covariance(covariance, middle))))
        return Move(name, pairs, motion, covariance, shift_mm, sigma_mm)


def _fit(
    poses: Sequence[ObservedPose],
    rig_from_camera: Mapping[str, RigidTransform],
    prior: LinearGaussianSystem,
    groups: list[Group],
) -> _Fit:
    """Fit motions of groups, poses of boards, and twists of the pairs within the prior on these.

    prior: on the twists of all pairs.
    """
    pairs, motions = list(rig_from_camera), [RigidTransform.identity()] * len(groups)
    boards = {p.target: rig_from_camera[p.pair] @ p.camera_from_board for p in reversed(poses)}
    rows = {key: k for k, key in enumerate([*pairs, *boards])}
    # From twists of pairs and boards, then of groups, to those of each camera and board.
    members = [[float(key in pairs_of) for _, pairs_of in groups] for key in rows]
    basis = np.kron(np.hstack([np.eye(len(rows)), np.reshape(members, (len(rows), -1))]), np.eye(6))
    size = basis.shape[1]
    padded = LinearGaussianSystem.assemble([(np.arange(prior.size), prior)], size)
    for _ in range(5):  # the problem is nearly linear
        solution = dict(rig_from_camera)
        for motion, (_, moved) in zip(motions, groups, strict=True):
            solution |= {pair: motion @ rig_from_camera[pair] for pair in moved}
        views, squares = [], 0.0
        for pose in poses:
            offset = solution[pose.pair] @ pose.camera_from_board @ boards[pose.target].inverse()
            root = pose.whitener @ adjoint(solution[pose.pair].inverse())
            residual = root @ offset.twist
            squares += float(residual @ residual)
            columns = 6 * np.array([[rows[pose.pair]], [rows[pose.target]]]) + np.arange(6)
            jacobian = np.hstack([root, -root])
            view = LinearGaussianSystem.from_observations(jacobian, -residual, np.ones(6))
            views.append((columns.ravel(), view))
        system = LinearGaussianSystem.assemble(views, 6 * len(rows)).project(basis) + padded
        step = system.solve()
        twists = step.reshape(-1, 6)
        cost = squares - float(system.vector @ step)
        boards = {target: pose.retract(twists[rows[target]]) for target, pose in boards.items()}
        motions = [m.retract(t) for m, t in zip(motions, twists[len(rows) :], strict=True)]
    first = 6 * len(rows)
    covariance = system.covariance()[first:, first:]
    each = [covariance[k : k + 6, k : k + 6] for k in range(0, size - first, 6)]
    return _Fit(groups, motions, each, dict(sorted(boards.items())), max(cost, 0.0))
