"""Which pair or pole of a calibrated rig has moved, found from boards that several pairs see.

Every view of a board gives the board's pose in its camera. Carried through the calibration, all
views of one board must agree; pairs whose views do not have moved. Single pairs or whole poles are
freed one after another, each time the one that explains most, until the rest fits.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial

import numpy as np

from bodyscan.arrays import Array
from bodyscan.calibration.board_views import LocatedView
from bodyscan.geometry.camera import Camera
from bodyscan.geometry.least_squares import EXACT, Block, minimize
from bodyscan.geometry.transforms import RigidTransform, adjoint, twist_jacobian
from bodyscan.geometry.uncertainty import PoseCovariance, point_covariance
from bodyscan.registration.view_graph import Target

Group = tuple[str, tuple[str, ...]]
"""A name to show, and the pairs that move as one."""

SIGNIFICANT = 45.0
"""Chi-squared with six degrees of freedom exceeds this once in twenty million by chance."""
CORRELATED = 3.0
"""Corners of one view share errors of lens and detector: this many count as one."""


@dataclass(frozen=True, eq=False)
class ObservedPose:
    """A board as one pair sees it.

    covariance: (6, 6) of its motion in the camera frame (rotation vector in radians, translation in
        mm).
    """

    pair: str
    target: Target
    camera_from_board: RigidTransform
    covariance: Array

    @cached_property
    def whitener(self) -> Array:
        return _whitener(self.covariance)


def observe_pose(view: LocatedView, camera: Camera, sigma_px: float) -> ObservedPose:
    """A board's pose from a view's corners, each off by `sigma_px`, correlated as in CORRELATED."""
    points = view.camera_from_board.apply(view.points)
    jacobian = camera.jacobians(points)[1] @ twist_jacobian(points)
    jacobian = jacobian.reshape(-1, 6)
    information = jacobian.T @ jacobian / (CORRELATED * sigma_px**2)
    covariance = np.linalg.inv(information)
    return ObservedPose(
        view.pair, view.target, view.camera_from_board, np.asarray(covariance, np.float64)
    )


@dataclass(frozen=True, eq=False)
class Move:
    """A motion of pairs that moved together: one pair, or all of a pole.

    motion: in the rig frame, `new rig_from_camera = motion @ old`.
    covariance: (6, 6) of the motion's twist.
    shift_mm, sigma_mm: shift of the cameras' centroid, and its sigma over all axes.
    turn_deg: angle of the rotation.
    """

    name: str
    pairs: tuple[str, ...]
    motion: RigidTransform
    covariance: Array
    shift_mm: float
    sigma_mm: float
    turn_deg: float


@dataclass(frozen=True, eq=False)
class Drift:
    """What moved.

    moves: in the order found, the clearest first.
    rig_from_board: of the boards used.
    misfit_before, misfit: RMS of what the views are off, in sigmas, before and after all moves.
    lonely: pairs that share no board with another.
    """

    moves: tuple[Move, ...]
    rig_from_board: dict[Target, RigidTransform]
    misfit_before: float
    misfit: float
    lonely: tuple[str, ...]


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
    groups = _groups(pairs, poles)
    state = _State.start(shared, pairs, rig_from_camera, prior)
    fit = before = state.solve([])
    moved: list[Group] = []
    while True:
        candidates = [
            group
            for group in groups
            if group not in moved
            and not set(group[1]) & {p for _, group_pairs in moved for p in group_pairs}
        ]
        tried = [(state.solve([*moved, group]), group) for group in candidates]
        if not tried:
            break
        best, group = min(tried, key=lambda one: one[0].cost)
        if fit.cost - best.cost < SIGNIFICANT:
            break
        moved.append(group)
        fit = best
    # Moves below 0.1 mm and 0.005 degrees, however significant, harm no scan.
    moves = tuple(
        move
        for number, group in enumerate(moved)
        if (move := state.move(group, fit, number)).shift_mm > 0.1 or move.turn_deg > 0.005
    )
    freedoms = max(6 * (len(shared) - len(fit.rig_from_board)), 1)
    return Drift(
        moves,
        fit.rig_from_board,
        float(np.sqrt(before.cost / freedoms)),
        float(np.sqrt(fit.cost / freedoms)),
        lonely,
    )


def _groups(pairs: Sequence[str], poles: Mapping[str, str]) -> list[Group]:
    """Every pair, and every pole with several pairs."""
    groups: list[Group] = [(f"pair {name}", (name,)) for name in pairs]
    for pole in sorted({poles[name] for name in pairs if name in poles}):
        members = tuple(name for name in pairs if poles.get(name) == pole)
        if 1 < len(members) < len(pairs):
            groups.append((f"pole {pole}", members))
    return groups


@dataclass(frozen=True, eq=False)
class _Fit:
    """cost: chi-squared.  motions: of each freed group, covariance (6G, 6G) of their twists."""

    cost: float
    motions: list[RigidTransform]
    covariance: Array
    rig_from_board: dict[Target, RigidTransform]


@dataclass(frozen=True, eq=False)
class _Unknowns:
    """Unknowns: small twists (P, 6) of the pairs, motions of the groups, poses of the boards."""

    small: Array
    motions: list[RigidTransform]
    boards: dict[Target, RigidTransform]

    def retract(self, step: Array) -> _Unknowns:
        twists, count = step.reshape(-1, 6), len(self.small)
        of_groups, of_boards = np.split(twists[count:], [len(self.motions)])
        boards = zip(self.boards.items(), of_boards, strict=True)
        return _Unknowns(
            self.small + twists[:count],
            [motion.retract(twist) for motion, twist in zip(self.motions, of_groups, strict=True)],
            {target: board.retract(twist) for (target, board), twist in boards},
        )


@dataclass(frozen=True, eq=False)
class _State:
    """prior_root: (6P, 6P), square root of the information on the pairs' twists."""

    poses: tuple[ObservedPose, ...]
    pairs: tuple[str, ...]
    rig_from_camera: Mapping[str, RigidTransform]
    prior_root: Array
    start_boards: dict[Target, RigidTransform]

    @staticmethod
    def start(
        poses: Sequence[ObservedPose],
        pairs: tuple[str, ...],
        rig_from_camera: Mapping[str, RigidTransform],
        prior: PoseCovariance,
    ) -> _State:
        # The pair that fixes the rig frame has zero covariance: give it a micron.
        covariance = prior.select(pairs) + np.diag(
            np.tile([1e-6**2] * 3 + [1e-3**2] * 3, len(pairs))
        )
        boards = {
            target: _majority_pose([p for p in poses if p.target == target], rig_from_camera)
            for target in sorted({pose.target for pose in poses})
        }
        return _State(tuple(poses), pairs, rig_from_camera, _whitener(covariance), boards)

    def solve(self, groups: Sequence[Group]) -> _Fit:
        """Solve for pair motions within the calibration's covariance, free motions of the groups,
        and boards; all as twists in the rig frame."""
        first_group = 6 * len(self.pairs)
        first_board = first_group + 6 * len(groups)
        start = _Unknowns(
            np.zeros((len(self.pairs), 6)),
            [RigidTransform.identity()] * len(groups),
            self.start_boards,
        )
        # The tolerance is in units of chi-squared, of which SIGNIFICANT is 45.
        solution = minimize(
            start,
            lambda placings: self._blocks(groups, placings),
            _Unknowns.retract,
            unknowns=first_board + 6 * len(start.boards),
            steps=10,
            tolerance=1e-3,
            damping=1e-9,
        )
        columns, found = slice(first_group, first_board), solution.state
        return _Fit(
            solution.report.cost_after,
            found.motions,
            solution.covariance[columns, columns],
            found.boards,
        )

    def _blocks(self, groups: Sequence[Group], state: _Unknowns) -> Iterator[Block]:
        """The prior on the pairs, then for each view the offset of its board."""
        pairs, targets = list(self.pairs), list(state.boards)
        of_group = {name: g for g, (_, members) in enumerate(groups) for name in members}
        small_twists = state.small.ravel()
        yield Block(
            self.prior_root @ small_twists,
            lambda: self.prior_root,
            slice(0, small_twists.size),
            EXACT,
        )
        for pose in self.poses:
            pair, group = pairs.index(pose.pair), of_group.get(pose.pair)
            camera = self.rig_from_camera[pose.pair].retract(state.small[pair])
            board = len(pairs) + len(groups) + targets.index(pose.target)
            touched = [pair, board]
            if group is not None:
                camera = state.motions[group] @ camera
                touched.append(len(pairs) + group)
            residuals, root = _gap(pose, camera, state.boards[pose.target])
            signs = np.array([1.0, -1.0, 1.0])[: len(touched)]
            columns = (6 * np.array(touched)[:, None] + np.arange(6)).ravel()
            yield Block(residuals, partial(_side_by_side, signs, root), columns, EXACT)

    def move(self, group: Group, fit: _Fit, number: int) -> Move:
        name, pairs = group
        motion = fit.motions[number]
        rows = slice(6 * number, 6 * number + 6)
        covariance = fit.covariance[rows, rows]
        middle = np.mean([self.rig_from_camera[pair].translation for pair in pairs], axis=0)
        covariance_mm2 = point_covariance(covariance, middle)
        return Move(
            name,
            pairs,
            motion,
            covariance,
            float(np.linalg.norm(motion.apply(middle) - middle)),
            float(np.sqrt(np.trace(covariance_mm2))),
            float(np.degrees(motion.angle)),
        )


def _gap(
    pose: ObservedPose, rig_from_camera: RigidTransform, rig_from_board: RigidTransform
) -> tuple[Array, Array]:
    """Offset of a view's board from its current pose, and how twists change it.

    (6,): the offset as a twist in the rig frame, in standard deviations.
    (6, 6): the matrix that brings twists to standard deviations.
    """
    gap = rig_from_camera @ pose.camera_from_board @ rig_from_board.inverse()
    root = pose.whitener @ adjoint(rig_from_camera.inverse())
    return root @ gap.twist, root


def _side_by_side(signs: Array, root: Array) -> Array:
    """The matrix (6, 6), repeated with each of S signs, (6, 6 S)."""
    return np.concatenate([sign * root for sign in signs], axis=1)


def _whitener(covariance: Array) -> Array:
    """The matrix that maps a vector of this covariance to independent standard deviations."""
    if not len(covariance):
        return covariance
    return np.asarray(np.linalg.inv(np.linalg.cholesky(covariance)), np.float64)


def _majority_pose(
    poses: Sequence[ObservedPose], rig_from_camera: Mapping[str, RigidTransform]
) -> RigidTransform:
    """A board's pose by majority: the view from which the others differ least."""

    def median_distance(board: RigidTransform) -> float:
        """Median squared distance of all views from a pose, in sigmas squared."""
        gaps = (_gap(pose, rig_from_camera[pose.pair], board) for pose in poses)
        return float(np.median([sigmas @ sigmas for sigmas, _ in gaps]))

    return min(
        (rig_from_camera[pose.pair] @ pose.camera_from_board for pose in poses), key=median_distance
    )
