"""Which pair or pole of a calibrated rig has moved, found from boards that several pairs see.

Every view of a board gives the board's pose in its camera. Carried through the calibration, all
views of one board must agree; pairs whose views do not have moved. Single pairs or whole poles are
freed one after another, each time the one that explains most, until the rest fits.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from bodyscan.arrays import Array
from bodyscan.calibration.board_views import LocatedView
from bodyscan.geometry.camera import Camera
from bodyscan.geometry.least_squares import EXACT, Block, Solution, minimize
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
    """A motion of pairs that moved together: one pair, or all of a pole.

    motion: in the rig frame, `new rig_from_camera = motion @ old`.
    covariance: (6, 6) of the motion's twist.
    shift_mm, sigma_mm: shift of the cameras' centroid, and its sigma over all axes.
    """

    name: str
    pairs: tuple[str, ...]
    motion: RigidTransform
    covariance: Array
    shift_mm: float
    sigma_mm: float

    @property
    def turn_deg(self) -> float:
        """Angle of the rotation."""
        return float(np.degrees(self.motion.angle))


@dataclass(frozen=True, eq=False)
class Drift:
    """What moved.

    moves: in the order found, the clearest first.
    rig_from_board: of the boards used.
    misfit_before, misfit: RMS error of the views in sigmas, before and after all moves.
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
    problem = _Problem(shared, pairs, rig_from_camera, _whiten_prior(prior, pairs))
    candidates = _groups(pairs, poles)
    fit = before = problem.solve([])
    moved: list[Group] = []
    while candidates:
        tried = [(problem.solve([*moved, group]), group) for group in candidates]
        best, group = min(tried, key=lambda one: one[0].report.cost_after)
        # Chi-squared with six degrees of freedom exceeds 45 once in twenty million by chance.
        if fit.report.cost_after - best.report.cost_after < 45.0:
            break
        moved.append(group)
        fit = best
        candidates = [other for other in candidates if not set(other[1]) & set(group[1])]
    moves = (problem.move(group, fit, number) for number, group in enumerate(moved))
    freedoms = max(6 * (len(shared) - len(fit.state.boards)), 1)
    return Drift(
        # Moves below 0.1 mm and 0.005 degrees, however significant, harm no scan.
        tuple(move for move in moves if move.shift_mm > 0.1 or move.turn_deg > 0.005),
        fit.state.boards,
        float(np.sqrt(before.report.cost_after / freedoms)),
        float(np.sqrt(fit.report.cost_after / freedoms)),
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


def _whiten_prior(prior: PoseCovariance, pairs: Sequence[str]) -> Array:
    """The matrix (6P, 6P) from the pairs' twists to independent standard deviations."""
    if not pairs:
        return np.zeros((0, 0))
    # The pair that fixes the rig frame has zero covariance: give it a micron.
    micron = np.diag(np.tile([1e-6**2] * 3 + [1e-3**2] * 3, len(pairs)))
    return np.asarray(np.linalg.inv(np.linalg.cholesky(prior.select(pairs) + micron)), np.float64)


@dataclass(frozen=True, eq=False)
class _Unknowns:
    """Twists (P, 6) of the pairs within the calibration's covariance, motions of the groups, poses
    of the boards; all in the rig frame."""

    twists: Array
    motions: list[RigidTransform]
    boards: dict[Target, RigidTransform]

    def retract(self, step: Array) -> _Unknowns:
        twists, count = step.reshape(-1, 6), len(self.twists)
        of_groups, of_boards = np.split(twists[count:], [len(self.motions)])
        boards = zip(self.boards.items(), of_boards, strict=True)
        return _Unknowns(
            self.twists + twists[:count],
            [motion.retract(twist) for motion, twist in zip(self.motions, of_groups, strict=True)],
            {target: board.retract(twist) for (target, board), twist in boards},
        )


@dataclass(frozen=True, eq=False)
class _Problem:
    """Poses of boards that several pairs see; prior: `_whiten_prior`."""

    poses: Sequence[ObservedPose]
    pairs: tuple[str, ...]
    rig_from_camera: Mapping[str, RigidTransform]
    prior: Array

    def solve(self, groups: Sequence[Group]) -> Solution[_Unknowns]:
        """Fit all unknowns, with free motions of these groups."""
        boards = {target: self._majority_pose(target) for target in {p.target for p in self.poses}}
        start = _Unknowns(
            np.zeros((len(self.pairs), 6)),
            [RigidTransform.identity()] * len(groups),
            dict(sorted(boards.items())),
        )
        return minimize(
            start,
            lambda state: self._blocks(groups, state),
            _Unknowns.retract,
            unknowns=6 * (len(self.pairs) + len(groups) + len(boards)),
            steps=10,
            tolerance=1e-3,  # of chi-squared
            damping=1e-9,
        )

    def _blocks(self, groups: Sequence[Group], state: _Unknowns) -> Iterator[Block]:
        """The prior on the pairs, then for each view the offset of its board."""
        twists, targets = state.twists.ravel(), list(state.boards)
        yield Block(self.prior @ twists, lambda: self.prior, slice(0, twists.size), EXACT)
        group_of = {name: g for g, (_, members) in enumerate(groups) for name in members}
        for pose in self.poses:
            pair, group = self.pairs.index(pose.pair), group_of.get(pose.pair)
            camera = self.rig_from_camera[pose.pair].retract(state.twists[pair])
            touched = [pair, len(self.pairs) + len(groups) + targets.index(pose.target)]
            if group is not None:
                camera = state.motions[group] @ camera
                touched.append(len(self.pairs) + group)
            residuals, root = _offset(pose, camera, state.boards[pose.target])
            jacobian = np.concatenate([root, -root, root][: len(touched)], axis=1)
            columns = (6 * np.array(touched)[:, None] + np.arange(6)).ravel()
            yield Block(residuals, partial(np.asarray, jacobian), columns, EXACT)

    def _majority_pose(self, target: Target) -> RigidTransform:
        """`rig_from_board` by the view from which the median of all views differs least."""
        poses = [pose for pose in self.poses if pose.target == target]

        def median_distance(board: RigidTransform) -> float:
            offsets = [_offset(p, self.rig_from_camera[p.pair], board)[0] for p in poses]
            return float(np.median(np.sum(np.square(offsets), axis=1)))

        boards = (self.rig_from_camera[pose.pair] @ pose.camera_from_board for pose in poses)
        return min(boards, key=median_distance)

    def move(self, group: Group, fit: Solution[_Unknowns], number: int) -> Move:
        """The motion of the group that was freed as that number."""
        name, pairs = group
        motion, first = fit.state.motions[number], 6 * (len(self.pairs) + number)
        covariance = fit.covariance[first : first + 6, first : first + 6]
        middle = np.mean([self.rig_from_camera[pair].translation for pair in pairs], axis=0)
        shift_mm = float(np.linalg.norm(motion.apply(middle) - middle))
        sigma_mm = float(np.sqrt(np.trace(point_covariance(covariance, middle))))
        return Move(name, pairs, motion, covariance, shift_mm, sigma_mm)


def _offset(
    pose: ObservedPose, rig_from_camera: RigidTransform, rig_from_board: RigidTransform
) -> tuple[Array, Array]:
    """Offset of a view's board from a pose (6,), in standard deviations, and the matrix (6, 6) that
    brings twists in the rig frame to standard deviations."""
    offset = rig_from_camera @ pose.camera_from_board @ rig_from_board.inverse()
    root = pose.whitener @ adjoint(rig_from_camera.inverse())
    return root @ offset.twist, root
