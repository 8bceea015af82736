"""One pair by itself, as the chapter does it (3.3): its camera, then a plane for each stripe."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bodyscan.boards.board import corner_points, corners_per_face
from bodyscan.boards.view import BoardView
from bodyscan.calibration.boundary_points import BoundaryPoints
from bodyscan.calibration.camera import PlanarView
from bodyscan.calibration.light_choice import HeldOutModel
from bodyscan.calibration.light_planes import boundary_points, join
from bodyscan.errors import PairFailed
from bodyscan.geometry.camera import Camera
from bodyscan.geometry.light_planes import LightSheets
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.rig.board import Board
from bodyscan.stripes.projector_spec import ProjectorSpec
from bodyscan.stripes.stripe_map import StripeMap

Array = NDArray[np.float64]

FEWEST_CORNERS = 8
FEWEST_STRIPE_SHOTS = 2
RIM_SQUARES = 0.1


@dataclass(frozen=True)
class PairQuality:
    """Figures of one pair: corners' RMS (px) over `poses` board poses; distances of boundary points
    to their sheets, RMS (mm), over `stripe_shots` boards; boundaries with a sheet, of those thrown.

    held_out: every model of the light tried on boards it was not fitted to, simplest first.
    refinement: of a pair by itself, whether camera, boards and light were refined together and why;
    flatness_mm: RMS of held-out boards about their own planes, before and after.
    boards_mm: mean and RMS over the boards of how far the stripes measure them from where the
    corners of all cameras put them.
    """

    corners_rms_px: float
    poses: int
    planes_rms_mm: float | None = None
    stripe_shots: int = 0
    stripes_calibrated: int = 0
    stripes_projected: int = 0
    held_out: tuple[HeldOutModel, ...] = ()
    refinement: str = ""
    flatness_mm: tuple[float, float] | None = None
    boards_mm: tuple[float, float] | None = None

    @property
    def light_model(self) -> str | None:
        """The model of the light that held-out boards chose."""
        return next((tried.model for tried in self.held_out if tried.chosen), None)


@dataclass(frozen=True, eq=False)
class PairCalibration:
    """A calibrated pair, camera frame.

    camera_covariance: (P, P) of the camera's parameters.
    light: None for a camera without projector.
    """

    name: str
    camera: Camera
    camera_covariance: Array
    light: LightSheets | None
    quality: PairQuality


@dataclass(frozen=True, eq=False)
class BoardBoundaries:
    """Stripe boundaries of one shot that lie near a board: index (N,), pixels (N, 2), sigma (N,)."""

    index: NDArray[np.int64]
    pixels: Array
    sigma_px: Array


def planar_view(view: BoardView, board: Board) -> PlanarView:
    """A board view with its corners' places in the board frame."""
    return PlanarView(view.shot, corner_points(board)[view.corner_ids], view.pixels)


def usable(view: BoardView, board: Board) -> bool:
    """Enough corners, not all along one line of the board."""
    grid = view.corner_ids % corners_per_face(board)
    columns, rows = grid % (board.columns - 1), grid // (board.columns - 1)
    return len(grid) >= FEWEST_CORNERS and len(set(columns)) >= 3 and len(set(rows)) >= 3


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
    )


def boundaries_on_boards(
    name: str,
    camera: Camera,
    projector: ProjectorSpec,
    shots: Iterable[tuple[Board, RigidTransform, float, BoardBoundaries]],
) -> BoundaryPoints:
    """Boundaries carried onto boards: (board, camera_from_board, face's z, boundaries) of each shot.

    Raises PairFailed if fewer than two boards carry stripes.
    """
    parts = [
        on_board(camera, projector, board, pose, face_z, boundaries, number)
        for number, (board, pose, face_z, boundaries) in enumerate(shots)
    ]
    striped = sum(len(part.index) > 0 for part in parts)
    if striped < FEWEST_STRIPE_SHOTS:
        raise PairFailed(
            f"stripes were decoded on {striped} board poses, a light plane needs at least two",
            where=f"pair {name}",
            remedy="capture the stripe sequence on the board in three or more poses",
        )
    return join(parts)


def on_board(
    camera: Camera,
    projector: ProjectorSpec,
    board: Board,
    camera_from_board: RigidTransform,
    face_z: float,
    boundaries: BoardBoundaries,
    number: int,
) -> BoundaryPoints:
    """Only what lies on the board's checkered area: stripes fall on the wall and floor too."""
    camera_from_face = camera_from_board @ RigidTransform(np.eye(3), np.array([0.0, 0.0, face_z]))
    carried = boundary_points(
        camera,
        camera_from_face,
        boundaries.index,
        boundaries.pixels,
        boundaries.sigma_px,
        board=number,
        direction=projector.direction,
    )
    x, y, _ = camera_from_face.inverse().apply(carried.points).T
    rim = RIM_SQUARES * board.square_mm
    inside = (x > rim) & (x < board.columns * board.square_mm - rim)
    inside &= (y > rim) & (y < board.rows * board.square_mm - rim) & (carried.points[:, 2] > 0)
    return BoundaryPoints(
        carried.index[inside],
        carried.board[inside],
        carried.points[inside],
        carried.per_pixel[inside],
        carried.sigma_px[inside],
    )
