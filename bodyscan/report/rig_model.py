"""A calibrated rig as a rotatable model: cameras, boards, scan volume."""

from __future__ import annotations

import numpy as np

from bodyscan.arrays import Array, Bytes
from bodyscan.registration.rig_calibration import RigCalibration
from bodyscan.report.calibration_charts import line_styles
from bodyscan.report.model import Strokes, pack


def rig_model(calibration: RigCalibration) -> dict[str, object]:
    """Build the model for the viewer: cameras' fields of view, boards' outlines, volume and axes."""
    grey, dark = np.array([190, 197, 207], np.uint8), np.array([120, 130, 145], np.uint8)
    colours, _ = line_styles(calibration)
    parts: list[tuple[Array, Bytes]] = []
    for name, pose in calibration.rig_from_camera.items():
        camera = calibration.pairs[name].camera
        right, bottom = camera.width - 0.5, camera.height - 0.5
        corners = np.array([[-0.5, -0.5], [right, -0.5], [right, bottom], [-0.5, bottom]])
        far = pose.apply(220.0 * np.nan_to_num(camera.rays(corners)))
        sides = np.stack([np.broadcast_to(pose.translation, far.shape), far], axis=1)
        parts.append((np.concatenate([sides, _close(far)]), _rgb(colours[name])))
    for (_, board_name), rig_from_board in calibration.rig_from_board.items():
        board = calibration.rig.board(board_name)
        x, y = board.size_mm
        outline = np.array([[0.0, 0, 0], [x, 0, 0], [x, y, 0], [0, y, 0]])
        parts.append((_close(rig_from_board.apply(outline)), grey))
    volume = calibration.rig.volume
    turn = 2.0 * np.pi * np.arange(48) / 48
    circle = volume.radius_mm * np.stack([np.cos(turn), np.sin(turn), np.zeros(48)], axis=1)
    for height in (volume.bottom_mm, volume.top_mm):
        parts.append((_close(circle + [0.0, 0.0, height]), dark))
    upright = circle[::6, None] + np.array([[0.0, 0, volume.bottom_mm], [0.0, 0, volume.top_mm]])
    parts.append((upright, dark))
    for axis, colour in zip(np.eye(3), ((200, 40, 40), (30, 140, 60), (40, 80, 200)), strict=True):
        parts.append((300.0 * np.stack([np.zeros(3), axis])[None], np.array(colour, np.uint8)))
    ends = np.concatenate([part for part, _ in parts])
    tint = np.repeat([colour for _, colour in parts], [len(part) for part, _ in parts], axis=0)
    labels = [(name, t.translation) for name, t in calibration.rig_from_camera.items()]
    labels += [("x", np.array([340.0, 0.0, 0.0])), ("y", np.array([0.0, 340.0, 0.0]))]
    strokes = Strokes(ends, tint.astype(np.uint8))
    return pack(None, strokes=strokes, labels=labels, view_deg=(20.0, 22.0))


def _close(corners: Array) -> Array:
    """Sides (N, 2, 3) of a polygon (N, 3)."""
    return np.stack([corners, np.roll(corners, -1, axis=0)], axis=1)


def _rgb(colour: str) -> Bytes:
    return np.array([int(colour[k : k + 2], 16) for k in (1, 3, 5)], np.uint8)
