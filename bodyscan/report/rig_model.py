"""A calibrated rig as a rotatable model: cameras, the covariance of their positions, boards, volume."""

from __future__ import annotations

import numpy as np

from bodyscan.arrays import Array, Bytes
from bodyscan.geometry.uncertainty import point_covariance
from bodyscan.registration.rig_calibration import RigCalibration
from bodyscan.report.calibration_charts import line_styles
from bodyscan.report.charts import round_down
from bodyscan.report.model import Layer, Shape, Strokes, pack


def rig_model(calibration: RigCalibration) -> tuple[dict[str, object], float]:
    """Build the model for the viewer; also return by what factor one-sigma ellipsoids are enlarged."""
    covariances = {
        name: point_covariance(calibration.covariance.marginal(name), pose.translation)
        for name, pose in calibration.rig_from_camera.items()
    }
    longest = max(float(np.sqrt(np.linalg.eigvalsh(one)[-1])) for one in covariances.values())
    # The largest is drawn with a half axis of 140 mm; the pose of a single pair has no error.
    times = round_down(140.0 / max(longest, 1e-3), 2)
    shapes = {
        name: _ellipsoid(pose.translation, times**2 * covariances[name])
        for name, pose in calibration.rig_from_camera.items()
    }
    colours, _ = line_styles(calibration)
    shape, tint = _join(shapes, {name: _rgb(colours[name]) for name in shapes})
    labels = [(name, t.translation) for name, t in calibration.rig_from_camera.items()]
    labels += [("x", np.array([340.0, 0.0, 0.0])), ("y", np.array([0.0, 340.0, 0.0]))]
    layer, strokes = Layer("ellipsoids", tint), _strokes(calibration)
    return pack(shape, [layer], strokes=strokes, labels=labels, view_deg=(20.0, 22.0)), times


def _ellipsoid(middle: Array, covariance: Array) -> Shape:
    """A one-sigma ellipsoid: the unit sphere mapped by the covariance's square root."""
    rings, sectors = 16, 24
    down = np.linspace(0.0, np.pi, rings + 1)[:, None]
    round_ = 2.0 * np.pi * np.arange(sectors) / sectors
    sphere = np.stack(
        np.broadcast_arrays(
            np.sin(down) * np.cos(round_), np.sin(down) * np.sin(round_), np.cos(down)
        ),
        axis=-1,
    ).reshape(-1, 3)
    values, vectors = np.linalg.eigh(covariance)
    axes = np.sqrt(np.maximum(values, 1e-9))
    normals = (sphere / axes) @ vectors.T
    row, column = np.meshgrid(np.arange(rings), np.arange(sectors), indexing="ij")
    after = (column + 1) % sectors
    a, b = row * sectors + column, row * sectors + after
    faces = np.stack([a, a + sectors, b, b, a + sectors, b + sectors], axis=-1).reshape(-1, 3)
    return Shape(
        middle + (sphere * axes) @ vectors.T,
        faces,
        normals / np.linalg.norm(normals, axis=1, keepdims=True),
    )


def _join(shapes: dict[str, Shape], tints: dict[str, Bytes]) -> tuple[Shape, Bytes]:
    counts = [len(shape.vertices) for shape in shapes.values()]
    starts = np.cumsum([0, *counts[:-1]])
    every = list(shapes.values())
    shape = Shape(
        np.concatenate([one.vertices for one in every]),
        np.concatenate([one.faces + start for one, start in zip(every, starts, strict=True)]),
        np.concatenate([one.normals for one in every]),
    )
    return shape, np.repeat([tints[name] for name in shapes], counts, axis=0).astype(np.uint8)


def _strokes(calibration: RigCalibration) -> Strokes:
    """Cameras' fields of view, boards' outlines, the scan volume, and the rig's axes."""
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
    return Strokes(ends, tint.astype(np.uint8))


def _close(corners: Array) -> Array:
    """Sides (N, 2, 3) of a polygon (N, 3)."""
    return np.stack([corners, np.roll(corners, -1, axis=0)], axis=1)


def _rgb(colour: str) -> Bytes:
    return np.array([int(colour[k : k + 2], 16) for k in (1, 3, 5)], np.uint8)
