"""The stripes of one pair on its boards: what was decoded near each, carried onto it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from bodyscan.arrays import Array, Indices
from bodyscan.boards.view import BoardView
from bodyscan.calibration.board_form import BoardFace
from bodyscan.calibration.board_views import LocatedView
from bodyscan.calibration.boundary_points import (
    BoundaryPoints,
    Height,
    boundary_points,
    concatenate,
    select,
)
from bodyscan.errors import PairFailed
from bodyscan.geometry.camera import Camera
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.rig.board import Board
from bodyscan.stripes.stripe_code import StripeCode
from bodyscan.stripes.stripe_map import StripeMap

FEWEST_STRIPE_SHOTS = 2
RIM_SQUARES = 0.1
"""Of the outermost squares so much is left out: beside the print the board may be cut unevenly."""


@dataclass(frozen=True, eq=False)
class BoardBoundaries:
    """Stripe boundaries of one shot that lie near a board: index (N,), pixels (N, 2), sigma (N,); and
    those of the stripes that cross them, if there are such."""

    index: Indices
    pixels: Array
    sigma_px: Array
    crossing: BoardBoundaries | None = None


@dataclass(frozen=True, eq=False)
class StripedView:
    """A board that a pair saw, where it lies in the camera frame, and the stripes decoded on it.

    face: of a board that is known not to be flat, the face that was seen.
    """

    view: LocatedView
    board: Board
    boundaries: BoardBoundaries
    face: BoardFace | None = None

    @property
    def camera_from_face(self) -> RigidTransform:
        """Of the face that was seen: its corners lie at z = 0, or about it where it is not flat."""
        z_mm = self.face.z_mm if self.face else self.view.points[0, 2]
        return self.view.camera_from_board @ RigidTransform(np.eye(3), np.array([0.0, 0.0, z_mm]))


def boundaries_near(stripes: StripeMap, view: BoardView) -> BoardBoundaries:
    """The boundaries within the box around the view's corners: all that its board can hold."""
    low, high = view.pixels.min(axis=0), view.pixels.max(axis=0)
    reach = 0.5 * (high - low)
    pixels = stripes.boundary_pixels
    near = np.all((pixels >= low - reach) & (pixels <= high + reach), axis=1)
    return BoardBoundaries(
        stripes.boundary_index[near],
        pixels[near],
        stripes.boundary_sigma_px[near].astype(np.float64),
        boundaries_near(stripes.crossing, view) if stripes.crossing is not None else None,
    )


def boundaries_on_boards(
    name: str, camera: Camera, projector: StripeCode, shots: Sequence[StripedView]
) -> BoundaryPoints:
    """The boundaries of all shots on their boards, `board` counting the shots.

    Raises PairFailed if fewer than two boards carry stripes.
    """
    parts = [
        on_board(
            camera,
            projector,
            shot.board,
            shot.camera_from_face,
            shot.boundaries,
            number,
            shot.face.height if shot.face else None,
        )
        for number, shot in enumerate(shots)
    ]
    striped = sum(len(part.index) > 0 for part in parts)
    if striped < FEWEST_STRIPE_SHOTS:
        raise PairFailed(
            f"stripes were decoded on {striped} board poses, a light plane needs at least two",
            where=f"pair {name}",
            remedy="capture the stripe sequence on the board in three or more poses",
        )
    return concatenate(parts)


def on_board(
    camera: Camera,
    projector: StripeCode,
    board: Board,
    camera_from_face: RigidTransform,
    boundaries: BoardBoundaries,
    number: int,
    height: Height | None = None,
) -> BoundaryPoints:
    """Only what lies on the board's checkered area: stripes fall on the wall and floor too."""
    carried = boundary_points(
        camera,
        camera_from_face,
        boundaries.index,
        boundaries.pixels,
        boundaries.sigma_px,
        board=number,
        direction=projector.direction,
        height=height,
    )
    x, y, _ = camera_from_face.inverse().apply(carried.points).T
    rim = RIM_SQUARES * board.square_mm
    inside = (x > rim) & (x < board.columns * board.square_mm - rim)
    inside &= (y > rim) & (y < board.rows * board.square_mm - rim) & (carried.points[:, 2] > 0)
    return select(carried, inside)
