"""A board as one camera saw it: which of its corners lie at which pixels, and how it was printed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bodyscan.arrays import Array, Bytes, Indices
from bodyscan.boards.board_layout import compute_corner_grid, compute_corner_points
from bodyscan.errors import CaptureError
from bodyscan.rig.board import Board

ViewKey = tuple[str, str, str]
"""Key of a view: pair, shot and board."""


@dataclass(frozen=True)
class Appearance:
    """How a board with markers differs from its description."""

    inverted: bool = False  # white where the print as described is black
    mirrored: bool = False  # seen in a mirror, or through the glass it is printed on
    # Its markers follow OpenCV's other historic layout, not the one in the rig file.
    other_layout: bool = False

    def undo(self, image: Bytes) -> Bytes:
        """The image (H, W) with inversion and mirroring undone."""
        upright = 255 - image if self.inverted else image
        return np.ascontiguousarray(upright[:, ::-1]) if self.mirrored else upright

    def original_pixels(self, pixels: Array, width: int) -> Array:
        """Map pixels (..., 2) of the image from `undo` to the original, `width` px wide."""
        if not self.mirrored:
            return pixels
        return np.stack([width - 1.0 - pixels[..., 0], pixels[..., 1]], axis=-1)


AS_PRINTED = Appearance()


@dataclass(frozen=True, eq=False)
class BoardView:
    """The corners of a board that one camera observed in one shot."""

    pair: str
    shot: str
    board: str
    # (N,) int, index into `board_layout.compute_corner_points(board)` (front face first, then back).
    corner_ids: Indices
    pixels: Array  # (N, 2) float64, real image coordinates, px
    turnable: bool = False  # the detector may have numbered this board from its other end
    # How a board with markers was printed or seen, if not as described.
    appearance: Appearance = AS_PRINTED

    @property
    def key(self) -> ViewKey:
        return self.pair, self.shot, self.board


def number_corners(
    pixels: Array, board: Board, size: tuple[int, int], *, pair: str, shot: str, where: str
) -> BoardView | None:
    """Number the corners that another program found on a board; None if it found none.

    pixels: (N, 2) px of all corners row by row, NaN where one was not found. The board is seen from
        its front; rows may run from either side, and the end from which a plain board whose print
        looks the same turned is numbered stays open. A ChArUco board may be mirrored, or seen
        through the glass that it is printed on: its markers number it as it is.
    size: of the image, px.

    Raises CaptureError if corners are not as many as the board's, or one is outside the image.
    """
    columns = compute_corner_grid(board)[0]
    count = len(compute_corner_points(board))
    known = np.isfinite(pixels).all(axis=1)
    if not known.any():
        return None
    if len(pixels) != count:
        raise CaptureError(
            f"has {len(pixels)} corners, but board {board.name} has {count}",
            where=where,
            remedy=f"list all {columns} x {count // columns} for every image, row by row, those not "
            "found with level `-`",
        )
    if np.any((pixels[known] < -0.5) | (pixels[known] > np.array(size) - 0.5)):
        raise CaptureError(
            f"has corners outside of {size[0]} x {size[1]} px",
            where=where,
            remedy="give the corners of this camera, in pixels of its whole image",
        )
    grid = pixels.reshape(-1, columns, 2)
    along, across = np.diff(grid, axis=1)[:-1], np.diff(grid, axis=0)[:, :-1]
    from_right = np.nansum(along[..., 0] * across[..., 1] - along[..., 1] * across[..., 0]) < 0.0
    if from_right and board.kind != "charuco":
        grid = grid[:, ::-1]  # rows from the right
    pixels = grid.reshape(-1, 2)
    ids = np.flatnonzero(np.isfinite(pixels).all(axis=1))
    turnable = board.kind == "checkerboard"
    return BoardView(pair, shot, board.name, ids, np.ascontiguousarray(pixels[ids]), turnable)
