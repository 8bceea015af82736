"""A board as one camera saw it: which of its corners lie where in the image."""

from __future__ import annotations

from dataclasses import dataclass

from bodyscan.arrays import Array, Indices
from bodyscan.boards.appearance import AS_PRINTED, Appearance

ViewKey = tuple[str, str, str]
"""Key of a view: pair, shot and board."""


@dataclass(frozen=True, eq=False)
class BoardView:
    """A board as one camera saw it in one shot.

    corner_ids: (N,) int, index into `board_layout.corner_points(board)` (front face first, then
        back).
    pixels: (N, 2) float64, real image coordinates, px.
    turnable: the detector may have numbered this board from its other end.
    appearance: how a board with markers was printed or seen, if not as described.
    """

    pair: str
    shot: str
    board: str
    corner_ids: Indices
    pixels: Array
    turnable: bool = False
    appearance: Appearance = AS_PRINTED

    @property
    def key(self) -> ViewKey:
        return self.pair, self.shot, self.board
