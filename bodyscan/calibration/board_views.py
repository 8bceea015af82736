"""A board in one image: its corners with their places on the board, then with its pose as well."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from bodyscan.arrays import Array
from bodyscan.boards.board_layout import corner_grid, corner_points, corners_per_face
from bodyscan.boards.view import BoardView, ViewKey
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.rig.board import Board

FEWEST_CORNERS = 8


@dataclass(frozen=True, eq=False)
class PlanarView:
    """One board in one image: points (N, 3) mm, board frame, all at one z, and pixels (N, 2)."""

    shot: str
    points: Array
    pixels: Array


def planar_view(view: BoardView, board: Board) -> PlanarView:
    """A board view with its corners' places in the board frame."""
    return PlanarView(view.shot, corner_points(board)[view.corner_ids], view.pixels)


def has_enough_corners(view: BoardView, board: Board) -> bool:
    """Whether a view has enough corners, not all along one line of the board."""
    grid = view.corner_ids % corners_per_face(board)
    width = corner_grid(board)[0]
    columns, rows = grid % width, grid // width
    return len(grid) >= FEWEST_CORNERS and len(set(columns)) >= 3 and len(set(rows)) >= 3


@dataclass(frozen=True, eq=False)
class LocatedView:
    """Points (N, 3) mm of a board seen at pixels (N, 2) by `pair`, with the pose they give.

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
        """(shot, board): what several cameras may see together."""
        return self.shot, self.board

    @property
    def ambiguous(self) -> bool:
        return len(self.alternatives) > 1

    def resolved(self, board_from_seen: RigidTransform) -> LocatedView:
        """The same view with one of its alternatives taken as true."""
        return replace(
            self,
            points=board_from_seen.apply(self.points),
            camera_from_board=self.camera_from_board @ board_from_seen.inverse(),
            alternatives=(RigidTransform.identity(),),
        )


def greatest_displacement(a: RigidTransform, b: RigidTransform, reach_mm: float) -> float:
    """Difference of two transforms, mm: translation plus rotation acting at `reach_mm`."""
    difference = a.inverse() @ b
    return float(np.linalg.norm(difference.translation) + difference.angle * reach_mm)


def board_symmetries(board: Board) -> tuple[RigidTransform, ...]:
    """Every `board_from_seen` under which a plain board looks the same to the detector.

    A plain board may be numbered from its other end, unless the colour of its first square shows
    which end it is, or seen from its back.
    """
    width, height = board.size_mm
    found = [RigidTransform.identity()]
    if (board.columns + board.rows) % 2 == 0:
        found.append(RigidTransform(np.diag([-1.0, -1.0, 1.0]), np.array([width, height, 0.0])))
    if board.faces == 2:
        turned_over = RigidTransform(
            np.diag([-1.0, 1.0, -1.0]), np.array([width, 0.0, board.thickness_mm])
        )
        found += [turned_over @ symmetry for symmetry in found]
    return tuple(found)
