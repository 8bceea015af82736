"""What a ring of cameras sees of a board, as boards found in images: the real solve without images."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from ring import CHARUCO, ring_of_cameras, ring_rig, ring_views

from bodyscan.boards.board_layout import corner_points
from bodyscan.boards.view import BoardView
from bodyscan.captures.folder import Captures, ImageSequence
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.outcome import Outcome
from bodyscan.rig.rig import Rig


@dataclass(frozen=True)
class SeenBoards:
    """A rig of cameras alone, the boards found in its pictures, and where its cameras stand."""

    rig: Rig
    views: tuple[BoardView, ...]
    placings: dict[str, RigidTransform]

    def captures(self, views: Iterable[BoardView]) -> Captures:
        """Captures whose lit images would show these views."""
        own = list(views)
        keys = sorted({(view.shot, view.pair) for view in own})
        sequences = tuple(
            ImageSequence(pair, shot, Path(shot, pair, "lit.png"), None, (), ())
            for shot, pair in keys
        )
        return Captures(self.rig, (Path(),), tuple(sorted({s for s, _ in keys})), sequences)

    def found(self, views: Iterable[BoardView]) -> Outcome[list[BoardView]]:
        return Outcome(list(views))


def seen_boards(
    poles: int = 2,
    heights: tuple[float, ...] = (700.0, 1200.0),
    *,
    shots: int = 12,
    seed: int = 0,
    noise_px: float = 0.03,
) -> SeenBoards:
    """A few cameras around a ChArUco board of two faces: each sees it in most of the shots."""
    placings, cameras = ring_of_cameras(poles, heights)
    located, _ = ring_views(placings, cameras, shots=shots, seed=seed, noise_px=noise_px)
    number = {tuple(point): k for k, point in enumerate(corner_points(CHARUCO).tolist())}
    views = tuple(
        BoardView(
            view.pair,
            view.shot,
            view.board,
            np.array([number[tuple(point)] for point in view.points.tolist()]),
            view.pixels,
        )
        for view in located
    )
    return SeenBoards(ring_rig(placings), views, placings)
