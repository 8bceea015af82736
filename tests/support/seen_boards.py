"""What a few cameras see of a board, as if found in images: the real solve without images."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from ring import CHARUCO, looking_at, ring_rig

from bodyscan.boards.board_layout import compute_corner_points, count_corners_per_face
from bodyscan.boards.view import BoardView
from bodyscan.captures.folder import Captures, ImageSequence
from bodyscan.geometry.camera import Camera
from bodyscan.geometry.lenses.opencv import Radial
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.rig.rig import Rig
from bodyscan.workflows.find_boards import FoundBoards

CAMERA = Camera(1510.0, 1512.0, -0.5, 645.0, 508.0, Radial(-0.1, 0.05), 1280, 1024)
NOISE_PX = 0.03


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

    def found(self, views: Iterable[BoardView]) -> FoundBoards:
        return FoundBoards(list(views))


def seen_boards(cameras: int = 4, *, shots: int = 10) -> SeenBoards:
    """Cameras side by side on an arc, a board before them: every camera sees it in every shot."""
    rng = np.random.default_rng(0)
    placings, views = {}, []
    for k in range(cameras):
        angle = np.radians(12.0 * (k - 0.5 * (cameras - 1)))
        position = [1300.0 * np.cos(angle), 1300.0 * np.sin(angle), 1000.0 + 150.0 * (k % 2)]
        placings[f"c{k + 1}"] = looking_at(position, [0.0, 0.0, 1000.0])
    corners = compute_corner_points(CHARUCO)[: count_corners_per_face(CHARUCO)]
    to_middle = RigidTransform(np.eye(3), -corners.mean(axis=0))
    upright = np.array([[0.0, 0.0, -1.0], [1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    for number in range(shots):
        tilt = RigidTransform.from_rotation_vector(rng.normal(0.0, 0.35, 3), np.zeros(3))
        place = np.array([0.0, 0.0, 1050.0]) + rng.uniform(-120.0, 120.0, 3)
        rig_from_board = RigidTransform(upright @ tilt.rotation, place) @ to_middle
        for name, placing in placings.items():
            pixels = CAMERA.project((placing.inverse() @ rig_from_board).apply(corners))
            pixels += rng.normal(0.0, NOISE_PX, pixels.shape)
            seen = np.flatnonzero(np.all((pixels > 5.0) & (pixels < [1275.0, 1019.0]), axis=1))
            views.append(BoardView(name, f"s{number:02d}", CHARUCO.name, seen, pixels[seen]))
    return SeenBoards(ring_rig(placings, fixed="c1"), tuple(views), placings)
