"""A board in one image: its corners with their positions on the board, then with its pose as well."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from bodyscan.arrays import Array, Indices
from bodyscan.boards.board_layout import (
    compute_corner_grid,
    compute_corner_points,
    count_corners_per_face,
)
from bodyscan.boards.view import BoardView, ViewKey
from bodyscan.geometry.robust import compute_rms_length, rms
from bodyscan.geometry.transforms import RigidTransform, twist_jacobian
from bodyscan.rig.board import Board


@dataclass(frozen=True, eq=False)
class PlanarView:
    """One board in one image: points (N, 3) mm, board frame, all at one z, and pixels (N, 2)."""

    shot: str
    points: Array
    pixels: Array


@dataclass(frozen=True, eq=False)
class LocatedView:
    """Points (N, 3) mm of a board observed at pixels (N, 2) by `pair`, with the pose they give.

    alternatives: every `board_from_observed` under which the board looks the same to the detector,
        identity first: a plain board may be numbered from its other end or seen from its back.
    """

    pair: str
    shot: str
    board: str
    points: Array
    pixels: Array
    camera_from_board: RigidTransform
    alternatives: tuple[RigidTransform, ...] = (RigidTransform.identity(),)

    @property
    def key(self) -> ViewKey:
        return self.pair, self.shot, self.board

    @property
    def target(self) -> tuple[str, str]:
        """(shot, board): what several cameras may observe at once."""
        return self.shot, self.board

    @property
    def ambiguous(self) -> bool:
        return len(self.alternatives) > 1

    def resolve(self, board_from_observed: RigidTransform) -> LocatedView:
        """Take one of the alternatives as true."""
        return replace(
            self,
            points=board_from_observed.apply(self.points),
            camera_from_board=self.camera_from_board @ board_from_observed.inverse(),
            alternatives=(RigidTransform.identity(),),
        )


@dataclass(frozen=True, eq=False)
class BoardFace:
    """The surface on which the corners of one face lie, board frame.

    Above the plane z = z_mm it is a polynomial of third degree in x and y, scaled so that `middle`
    (2,) mm becomes 0 and `half` (2,) mm from it becomes 1; coefficients: (4, 4) mm.
    """

    z_mm: float
    middle: Array
    half: Array
    coefficients: Array

    @staticmethod
    def fit(points: Array) -> BoardFace:
        """Fit the face to corners (N, 3) mm, board frame, by least squares."""
        low, high = points[:, :2].min(axis=0), points[:, :2].max(axis=0)
        middle, half = (low + high) / 2.0, np.maximum((high - low) / 2.0, 1e-9)
        z_mm, (x, y) = float(np.median(points[:, 2])), ((points[:, :2] - middle) / half).T
        third_degree = np.add.outer(np.arange(4), np.arange(4)) <= 3
        powers = np.polynomial.polynomial.polyvander2d(x, y, (3, 3)) * third_degree.ravel()
        found = np.linalg.lstsq(powers, points[:, 2] - z_mm, rcond=1e-9)[0]
        return BoardFace(z_mm, middle, half, found.reshape(4, 4))

    def height(self, xy: Array) -> Array:
        """Heights (...) mm above the plane at (..., 2) mm of the board."""
        x, y = np.moveaxis((xy - self.middle) / self.half, -1, 0)
        return np.asarray(np.polynomial.polynomial.polyval2d(x, y, self.coefficients))


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
        return compute_rms_length(self.offsets)

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

    def compute_prior_jacobian(self, size_sigma: float = 0.0) -> Array:
        """Jacobian (3N + 7, 3N) of residuals of the prior on the offsets, in standard deviations:
        each coordinate, the gauge constraint that the shape has no rigid motion (the board's pose
        has it), and the size, which is off by `size_sigma`."""
        arms, sigma_mm = self.points - self.points.mean(axis=0), PRIOR * self.diagonal
        motions, _ = np.linalg.qr(twist_jacobian(arms).reshape(-1, 6))
        gauge_mm = 1e-4 * sigma_mm  # a thousandth of what views determine
        radius = float(np.linalg.norm(arms))
        size_mm = max(size_sigma * radius, gauge_mm)
        known = (
            np.eye(arms.size) / sigma_mm,
            motions.T / gauge_mm,
            arms.ravel() / (radius * size_mm),
        )
        return np.vstack(known)

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


def apply_shape(view: LocatedView, shapes: Mapping[str, BoardShape]) -> LocatedView:
    """The view with its corners where they lie on a board of that shape."""
    if view.board not in shapes:
        return view
    return replace(view, points=shapes[view.board].apply(view.points))


def make_planar_view(view: BoardView, board: Board) -> PlanarView:
    """Look up where the corners of a view lie in the board frame."""
    return PlanarView(view.shot, compute_corner_points(board)[view.corner_ids], view.pixels)


def has_enough_corners(view: BoardView, board: Board) -> bool:
    """Whether a view has eight corners or more, not all along one line of the board."""
    grid = view.corner_ids % count_corners_per_face(board)
    width = compute_corner_grid(board)[0]
    columns, rows = grid % width, grid // width
    return len(grid) >= 8 and len(set(columns)) >= 3 and len(set(rows)) >= 3


def make_corner_keys(points: Array) -> list[tuple[float, ...]]:
    """Keys by which corners (M, 3) mm are identified: rounded to a nanometre, without a -0."""
    return [tuple(point) for point in (np.round(points, 6) + 0.0).tolist()]


def match_corners(points: Array, known: Array) -> Indices:
    """Indices (M,) of corners (M, 3) mm in `known` (N, 3) mm, -1 where it has none."""
    index = {key: k for k, key in enumerate(make_corner_keys(known))}
    return np.array([index.get(key, -1) for key in make_corner_keys(points)], np.int64)


def compute_max_displacement_mm(a: RigidTransform, b: RigidTransform, radius_mm: float) -> float:
    """Difference of two transforms: translation plus rotation acting at `radius_mm`."""
    difference = a.inverse() @ b
    return float(np.linalg.norm(difference.translation) + difference.angle * radius_mm)


def find_board_symmetries(board: Board) -> tuple[RigidTransform, ...]:
    """Every `board_from_observed` under which a plain board looks the same to the detector.

    A plain board may be numbered from its other end, unless the colour of its first square shows
    which end it is, or from any corner if it has as many columns as rows; or be seen from its back.
    """
    width, height = board.size_mm
    found = [RigidTransform.identity()]
    if (board.columns + board.rows) % 2 == 0:
        found.append(RigidTransform(np.diag([-1.0, -1.0, 1.0]), np.array([width, height, 0.0])))
    if board.columns == board.rows:
        quarter = RigidTransform(
            np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]), np.array([width, 0, 0])
        )
        found += [quarter @ symmetry for symmetry in found]
    if board.faces == 2:
        front_from_back = RigidTransform(
            np.diag([-1.0, 1.0, -1.0]), np.array([width, 0.0, board.thickness_mm])
        )
        found += [front_from_back @ symmetry for symmetry in found]
    return tuple(found)


def measure_covered_share(pixels: Sequence[Array], width: int, height: int) -> float:
    """Share of an image inside the convex hulls of all views' corners; pixels: (N, 2) each."""
    cells = 64  # across and down
    mask = np.zeros((cells, cells), np.uint8)
    scale = np.array([cells / width, cells / height])
    for corners in pixels:
        hull = cv2.convexHull(((corners + 0.5) * scale - 0.5).astype(np.float32))
        cv2.fillConvexPoly(mask, np.rint(hull).astype(np.int32), 1)
    return float(mask.mean())
