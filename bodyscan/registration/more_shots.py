"""Which further shots of a board would add most information on a pair's position."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, product

import numpy as np

from bodyscan.arrays import Array
from bodyscan.boards.board_layout import corner_points, corners_per_face
from bodyscan.calibration.board_views import LocatedView
from bodyscan.geometry.camera import Camera
from bodyscan.geometry.camera_tables import is_in_image
from bodyscan.geometry.linear_gaussian import invert_scaled
from bodyscan.geometry.transforms import RigidTransform, twist_jacobian
from bodyscan.registration.normal_equations import NormalEquations, normal_equations
from bodyscan.rig.board import Board
from bodyscan.rig.rig import Volume

MAX_SHOTS = 60


@dataclass(frozen=True, eq=False)
class BoardCandidate:
    """Where a board might be held: a few tilts of it at one place.

    height: `knee`, `waist` or `chest`.
    centre_mm: the board's centre, rig frame, (3,).
    facing_deg: azimuth of the front's normal, rig frame.
    rig_from_board: of each tilt.
    views: of each tilt, those of the pairs that would see it.
    """

    height: str
    centre_mm: Array
    facing_deg: float
    rig_from_board: tuple[RigidTransform, ...]
    views: tuple[tuple[LocatedView, ...], ...]

    @property
    def visible_to(self) -> tuple[str, ...]:
        """Pairs that see every tilt."""
        pairs = [{view.pair for view in tilt} for tilt in self.views]
        return tuple(sorted(set.intersection(*pairs)))

    def restrict_to(self, pairs: Sequence[str]) -> BoardCandidate:
        views = tuple(tuple(v for v in tilt if v.pair in pairs) for tilt in self.views)
        return replace(self, views=views)


def propose_board_poses(
    board: Board,
    volume: Volume,
    cameras: Mapping[str, Camera],
    rig_from_camera: Mapping[str, RigidTransform],
) -> list[BoardCandidate]:
    """Upright boards at knee, waist and chest height, facing between any two cameras.

    Only those that at least two pairs would see.
    """
    azimuths = candidate_azimuths(rig_from_camera.values(), board.faces == 2)
    heights = {"knee": 500.0, "waist": 1000.0, "chest": 1350.0}
    found = []
    # In the middle of the volume, and a third of its radius in front of and behind it.
    for (height, z), azimuth, share in product(heights.items(), azimuths, (-0.35, 0.0, 0.35)):
        if volume.bottom_mm < z < volume.top_mm:
            ahead = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
            centre = np.array([0.0, 0.0, z]) + share * volume.radius_mm * ahead
            poses = tuple(_tilted_poses(board, centre, ahead))
            views = tuple(tuple(_views(board, pose, cameras, rig_from_camera)) for pose in poses)
            found.append(BoardCandidate(height, centre, float(np.degrees(azimuth)), poses, views))
    return [candidate for candidate in found if len(candidate.visible_to) >= 2]


def candidate_azimuths(poses: Iterable[RigidTransform], two_faced: bool) -> list[float]:
    """Azimuths (radians) halfway between any two cameras, seen from the rig's axis, in steps of 15
    degrees."""
    positions = np.array([pose.translation[:2] for pose in poses])
    towards = positions / np.maximum(np.linalg.norm(positions, axis=1, keepdims=True), 1e-9)
    between = np.array([a + b for a, b in combinations(towards, 2)]).reshape(-1, 2)
    between = between[np.linalg.norm(between, axis=1) > 0.2]  # opposite cameras: nothing between
    degrees = np.degrees(np.arctan2(between[:, 1], between[:, 0]))
    steps = np.rint(degrees / 15.0) * 15.0 % (180.0 if two_faced else 360.0)
    return [float(np.radians(step)) for step in np.unique(steps)]


@dataclass(frozen=True, eq=False)
class SigmaReduction:
    """Variance (mm2, over all three axes) of one pair's position after 1, 2, ... more shots."""

    before_mm2: float
    after_mm2: Array

    @property
    def shots_to_halve(self) -> int | None:
        """Fewest shots that halve the sigma; None if the most that were tried do not."""
        enough = np.flatnonzero(self.after_mm2 <= self.before_mm2 / 4.0)
        return int(enough[0]) + 1 if enough.size else None


class RigInformation:
    """The information in the rig's shots, ready to have that of other shots added."""

    def __init__(
        self,
        equations: NormalEquations,
        cameras: Mapping[str, Camera],
        rig_from_camera: Mapping[str, RigidTransform],
    ) -> None:
        self._equations = equations
        self._cameras, self._rig_from_camera = cameras, rig_from_camera
        # A board that holds the frame has been eliminated already; a pair that does is removed here.
        reduced = equations.without_boards()
        fixed_pair = equations.fixed[equations.fixed < equations.first_board]
        self._free = np.setdiff1d(np.arange(reduced.size), fixed_pair)
        information = reduced.select(self._free).information
        self._scale = 1.0 / np.sqrt(np.maximum(np.diag(information), 1e-300))
        self._inverse = invert_scaled(information * np.outer(self._scale, self._scale))

    def information(self, candidate: BoardCandidate) -> Array:
        """Information in one shot there, averaged over its tilts; scaled, free unknowns only."""
        total = np.zeros((len(self._free), len(self._free)))
        for pose, views in zip(candidate.rig_from_board, candidate.views, strict=True):
            if len(views) < 2:  # a board seen by one camera adds nothing
                continue
            shot = normal_equations(
                views,
                self._cameras,
                self._rig_from_camera,
                {views[0].target: pose},
                fixed_pair=None,
                fixed_target=None,
                cameras_free=self._equations.cameras_free,
                camera_prior=False,
            )
            total += shot.without_boards().select(self._free).information
        return total * np.outer(self._scale, self._scale) / len(candidate.views)

    def after(self, information: Array, pair: str, max_shots: int = MAX_SHOTS) -> SigmaReduction:
        """How the variance of a pair's position falls with 1 to `max_shots` shots of that information.

        Uses the matrix inversion lemma in the basis in which the added information is diagonal,
        which gives all numbers of shots at once.
        """
        columns = 6 * self._equations.names.index(pair) + np.arange(6)
        jacobian = np.zeros((3, self._equations.system.size))
        jacobian[:, columns] = twist_jacobian(self._rig_from_camera[pair].translation[None])[0]
        jacobian = jacobian[:, self._free] * self._scale
        values, vectors = np.linalg.eigh(information)
        kept = values > 1e-12 * values[-1]
        root = vectors[:, kept] * np.sqrt(values[kept])
        eigenvalues, basis = np.linalg.eigh(root.T @ self._inverse @ root)
        reach = np.sum((basis.T @ root.T @ self._inverse @ jacobian.T) ** 2, axis=1)
        shots = np.arange(1, max_shots + 1)[:, None]
        drop = np.sum(reach / (1.0 / shots + np.maximum(eigenvalues, 0.0)), axis=1)
        before = float(np.trace(jacobian @ self._inverse @ jacobian.T))
        variance = self._equations.variance_px2
        return SigmaReduction(variance * before, variance * (before - drop))


def _tilted_poses(board: Board, centre: Array, ahead: Array) -> Iterator[RigidTransform]:
    """`rig_from_board` of an upright board whose front looks along `ahead`, with small tilts."""
    down = np.array([0.0, 0.0, -1.0])
    upright = np.column_stack([np.cross(down, -ahead), down, -ahead])
    middle = board.square_mm / 2.0 * np.array([board.columns, board.rows, 0.0])
    # Shots at one position differ a little, as hand-held boards do: about x, y and the normal.
    for tilt in ((20.0, 0.0, 0.0), (-20.0, 0.0, 15.0), (0.0, 20.0, -15.0)):
        turn = RigidTransform.from_rotation_vector(np.radians(tilt), np.zeros(3)).rotation
        yield RigidTransform(upright @ turn, centre - upright @ turn @ middle)


def _views(
    board: Board,
    rig_from_board: RigidTransform,
    cameras: Mapping[str, Camera],
    rig_from_camera: Mapping[str, RigidTransform],
) -> Iterator[LocatedView]:
    """Views that each camera would have of the board, without noise."""
    corners, count = corner_points(board), corners_per_face(board)
    for name, pose in rig_from_camera.items():
        camera_from_board = pose.inverse() @ rig_from_board
        sight = camera_from_board.apply(corners[:count].mean(axis=0))
        facing = camera_from_board.rotation[:, 2] @ sight / np.linalg.norm(sight)
        # The cosine between the board's normal and the line of sight.
        if abs(facing) < 0.4 or (facing < 0 and board.faces == 1):
            continue
        face = corners[:count] if facing > 0 else corners[-count:]
        points = camera_from_board.apply(face)
        visible = is_in_image(cameras[name], points, 5.0)
        if visible.sum() >= 12:
            pixels = cameras[name].project(points[visible])
            yield LocatedView(name, "more", board.name, face[visible], pixels, camera_from_board)
