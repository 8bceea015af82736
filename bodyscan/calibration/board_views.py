"""A board in one image: its corners with their positions on the board, then with its pose as well."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from bodyscan.arrays import Array, Indices
from bodyscan.boards.board_layout import corner_grid, corner_points, corners_per_face
from bodyscan.boards.view import BoardView, ViewKey
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.rig.board import Board
from bodyscan.rig.rig import Rig


@dataclass(frozen=True, eq=False)
class PlanarView:
    """One board in one image: points (N, 3) mm, board frame, all at one z, and pixels (N, 2)."""

    shot: str
    points: Array
    pixels: Array


@dataclass(frozen=True, eq=False)
class LocatedView:
    """Points (N, 3) mm of a board observed at pixels (N, 2) by `pair`, with the pose they give.

    alternatives: every `board_from_seen` under which the board looks the same to the detector,
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

    def resolve(self, board_from_seen: RigidTransform) -> LocatedView:
        """Take one of the alternatives as true."""
        return replace(
            self,
            points=board_from_seen.apply(self.points),
            camera_from_board=self.camera_from_board @ board_from_seen.inverse(),
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


def planar_view(view: BoardView, board: Board) -> PlanarView:
    """Look up where the corners of a view lie in the board frame."""
    return PlanarView(view.shot, corner_points(board)[view.corner_ids], view.pixels)


def has_enough_corners(view: BoardView, board: Board) -> bool:
    """Whether a view has eight corners or more, not all along one line of the board."""
    grid = view.corner_ids % corners_per_face(board)
    width = corner_grid(board)[0]
    columns, rows = grid % width, grid // width
    return len(grid) >= 8 and len(set(columns)) >= 3 and len(set(rows)) >= 3


def corner_keys(points: Array) -> list[tuple[float, ...]]:
    """Keys by which corners (M, 3) mm are identified: rounded to a nanometre, without a -0."""
    return [tuple(point) for point in (np.round(points, 6) + 0.0).tolist()]


def match_corners(points: Array, known: Array) -> Indices:
    """Indices (M,) of corners (M, 3) mm in `known` (N, 3) mm, -1 where it has none."""
    index = {key: k for k, key in enumerate(corner_keys(known))}
    return np.array([index.get(key, -1) for key in corner_keys(points)], np.int64)


def max_displacement_mm(a: RigidTransform, b: RigidTransform, radius_mm: float) -> float:
    """Difference of two transforms: translation plus rotation acting at `radius_mm`."""
    difference = a.inverse() @ b
    return float(np.linalg.norm(difference.translation) + difference.angle * radius_mm)


def board_symmetries(board: Board) -> tuple[RigidTransform, ...]:
    """Every `board_from_seen` under which a plain board looks the same to the detector.

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


def covered_share(pixels: Sequence[Array], width: int, height: int) -> float:
    """Share of an image inside the convex hulls of all views' corners; pixels: (N, 2) each."""
    cells = 64  # across and down
    mask = np.zeros((cells, cells), np.uint8)
    scale = np.array([cells / width, cells / height])
    for corners in pixels:
        hull = cv2.convexHull(((corners + 0.5) * scale - 0.5).astype(np.float32))
        cv2.fillConvexPoly(mask, np.rint(hull).astype(np.int32), 1)
    return float(mask.mean())


def coverage_notes(rig: Rig, views: Sequence[BoardView]) -> list[str]:
    """One line that names the cameras whose boards cover too little of the image to determine the
    lens."""
    narrow = []
    for pair in rig.pairs:
        pixels = [view.pixels for view in views if view.pair == pair.name]
        share = covered_share(pixels, pair.camera.width, pair.camera.height)
        if pixels and share < 0.2:
            narrow.append(f"{100 * share:.0f} % of {pair.name}'s")
    if not narrow:
        return []
    return [
        f"in all views together the board covers only {', '.join(narrow)} picture, so that lens and "
        "focal length are poorly known there: bring the board closer, and into the corners"
    ]
