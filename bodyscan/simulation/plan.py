"""Where the board is held, shot by shot, and which pairs capture it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import ArrayLike

from bodyscan.arrays import Array, Indices, Mask
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.rig.board import Board
from bodyscan.rig.rig import Rig
from bodyscan.simulation.layout import TruePair


@dataclass(frozen=True, eq=False)
class BoardShot:
    """One board pose, and the pairs that take the whole stripe sequence, or only the lit image."""

    name: str
    board: str
    rig_from_board: RigidTransform
    stripes: tuple[str, ...]
    lit: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class Sight:
    """What one pair sees of boards in N poses."""

    angle_deg: Array  # (N,) between the normal of the face it sees and the direction to the camera
    back: Mask  # (N,) bool
    inside: Array  # (N,) share of the board in the image
    cells: Mask  # (N, cells) bool, image cells it covers, near and far ones separate
    lean: Indices  # (N,) direction in which the board is tilted, 0..7


def count_default_shots(pairs: int) -> int:
    """Count 40 board shots for twelve pairs, at least 8."""
    return max(8, round(40 * pairs / 12))


def plan_boards(
    rig: Rig, pairs: Mapping[str, TruePair], shots: int, rng: np.random.Generator
) -> list[BoardShot]:
    """Plan the floor shot if the rig file names one, then `shots` poses.

    Poses are drawn in front of pairs chosen in turn; of many, those are taken that add most: image
    area not yet covered near and far, new tilts, links between pairs that share no board yet.
    """
    board = rig.boards[0]
    plan = [_plan_floor_shot(rig, pairs)] if rig.rig_frame.shot else []
    taken = {rig.rig_frame.shot}
    names = (name for i in range(10_000) if (name := f"b{i + 1:02d}") not in taken)
    poses = _draw_candidates(board, list(pairs.values()), rng)
    sights = {name: look(pair, poses, board) for name, pair in pairs.items()}
    striped = {
        name: _mask_visible(board, sight, True) & pairs[name].has_stripes
        for name, sight in sights.items()
    }
    visible = {name: _mask_visible(board, sight, False) for name, sight in sights.items()}
    for pose in _choose_poses(*_weigh_merits(sights, striped, visible), shots):
        stripes = tuple(name for name in pairs if striped[name][pose])
        lit = tuple(name for name in pairs if visible[name][pose] and name not in stripes)
        plan.append(BoardShot(next(names), board.name, poses[pose], stripes, lit))
    return plan


def look(pair: TruePair, poses: Sequence[RigidTransform], board: Board) -> Sight:
    """Compute what a pair sees of the board in each pose (rig_from_board)."""
    width, height, _ = _compute_board_extent(board)
    x, y = np.meshgrid(np.linspace(0.0, width, 15), np.linspace(0.0, height, 13))
    points = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)
    turns = np.stack([pose.rotation for pose in poses])
    shifts = np.stack([pose.translation for pose in poses])
    camera_from_rig = pair.rig_from_camera.inverse()
    in_camera = camera_from_rig.apply(points @ turns.transpose(0, 2, 1) + shifts[:, None])
    middle = in_camera.mean(axis=1)
    normal = camera_from_rig.rotate(turns[:, :, 2])
    cosine = np.einsum("ij,ij->i", normal, middle) / np.linalg.norm(middle, axis=1)
    depth = np.maximum(in_camera[..., 2], 1.0)
    camera = pair.camera
    pixel = camera.image(np.concatenate([in_camera[..., :2], depth[..., None]], axis=-1))
    within = (in_camera[..., 2] > 0.2 * pair.reach_mm) & np.all(
        (pixel > 4.0) & (pixel < np.array([camera.width, camera.height]) - 5.0), axis=-1
    )
    facing = normal * np.sign(cosine)[:, None]
    lean = np.arctan2(facing[:, 1], facing[:, 0])
    return Sight(
        np.degrees(np.arccos(np.clip(np.abs(cosine), 0.0, 1.0))),
        cosine < 0,
        within.mean(axis=1),
        _cover_cells(
            pixel, within, middle[:, 2] > 0.93 * pair.reach_mm, camera.width, camera.height
        ),
        np.floor((lean + np.pi) / (2.0 * np.pi) * 8.0).astype(np.int64) % 8,
    )


def _cover_cells(pixel: Array, within: Mask, far: Mask, width: int, height: int) -> Mask:
    rows, columns = 6, 8  # image cells that boards should cover
    row = np.clip(pixel[..., 1] * rows / height, 0, rows - 1).astype(int)
    column = np.clip(pixel[..., 0] * columns / width, 0, columns - 1).astype(int)
    cell = (far[:, None] * rows + row) * columns + column
    covered = np.zeros((len(pixel), 2 * rows * columns), bool)
    pose, point = np.nonzero(within)
    covered[pose, cell[pose, point]] = True
    return covered


def _mask_visible(board: Board, sight: Sight, stripes: bool) -> Mask:
    """Mask poses (N,) in which a pair takes stripes (or at least the lit image).

    A plain board is found only if it is seen whole; a board's back only if it is printed.
    """
    whole = board.kind == "checkerboard"
    share = 1.0 if whole else (0.5 if stripes else 0.25)
    max_angle_deg = 50.0 if stripes else 70.0
    printed = ~sight.back if board.faces == 1 else np.ones_like(sight.back)
    return (sight.inside >= share) & (sight.angle_deg <= max_angle_deg) & printed


def _plan_floor_shot(rig: Rig, pairs: Mapping[str, TruePair]) -> BoardShot:
    frame, board = rig.rig_frame, rig.frame_board
    assert board is not None
    x, y = np.array(frame.x_axis, float), np.array(frame.y_axis, float)
    x, y = x / np.linalg.norm(x), y / np.linalg.norm(y)
    pose = RigidTransform(np.stack([x, y, np.cross(x, y)], axis=1), np.array(frame.origin_mm))
    lit = []
    for name, pair in pairs.items():
        sight = look(pair, [pose], board)
        visible = sight.inside[0] >= 0.25 and (board.faces == 2 or not sight.back[0])
        if visible and sight.angle_deg[0] <= 78.0:
            lit.append(name)
    return BoardShot(str(frame.shot), board.name, pose, (), tuple(lit))


def _draw_candidates(
    board: Board, pairs: Sequence[TruePair], rng: np.random.Generator
) -> list[RigidTransform]:
    """Draw poses near the middle of what pairs look at, facing them or turned between two poles."""
    poses: list[RigidTransform] = []
    count = -(-3000 // len(pairs))
    for pair in pairs:
        camera, reach = pair.camera, pair.reach_mm
        pixels = rng.uniform(0.05, 0.95, (count, 2)) * [camera.width, camera.height]
        middles = camera.directions(pixels) * reach * rng.uniform(0.73, 1.12, (count, 1))
        middles[:, 0] = np.clip(middles[:, 0], -0.22 * reach, 0.22 * reach)
        poses += [
            pair.rig_from_camera @ _draw_pose(board, middle, len(pairs) > 1, rng)
            for middle in middles
        ]
    return [_lift_above_floor(pose, board) for pose in poses]


def _lift_above_floor(rig_from_board: RigidTransform, board: Board) -> RigidTransform:
    """Raise a pose if necessary so that the board just clears the floor."""
    margin = np.array([[-1.0, -1.0, 0.0], [1.0, 1.0, 0.0]]) * board.margin_mm
    low, high = margin + [[0.0, 0.0, 0.0], [1.0, 1.0, 0.0]] * _compute_board_extent(board)
    x, y = np.meshgrid([low[0], high[0]], [low[1], high[1]])
    corners = np.stack([x.ravel(), y.ravel(), np.zeros(4)], axis=1)
    short = 5.0 + board.thickness_mm - rig_from_board.apply(corners)[:, 2].min()
    lift = np.array([0.0, 0.0, max(short, 0.0)])
    return RigidTransform(rig_from_board.rotation, rig_from_board.translation + lift)


def _compute_board_extent(board: Board) -> Array:
    """Compute width and height of the checkered area, and 0, (3,) mm."""
    return np.array([board.columns, board.rows, 0.0]) * board.square_mm


def _draw_pose(
    board: Board, middle: Array, turn_away: bool, rng: np.random.Generator
) -> RigidTransform:
    """Draw a pose of a board with its middle there, facing and rotation at random.

    turn_away: two poses in five face away from the camera, towards other poles.
    """
    tilt, azimuth = np.radians(rng.uniform(0.0, 35.0)), rng.uniform(0.0, 2.0 * np.pi)
    yaw = 0.0
    if turn_away and rng.random() < 0.4:
        yaw, tilt = np.radians(rng.choice([-60.0, -30.0, 30.0, 60.0])), 0.4 * tilt
    roll = rng.choice([0.0, 0.5 * np.pi]) + rng.normal(0.0, 0.15)
    over = np.pi if board.faces == 2 and rng.random() < 0.35 else 0.0
    lean = _convert_rotation(tilt * np.array([np.cos(azimuth), np.sin(azimuth), 0.0]))
    turn = (
        _convert_rotation([0, yaw, 0])
        @ lean
        @ _convert_rotation([0, 0, roll])
        @ _convert_rotation([0, over, 0])
    )
    return RigidTransform(turn, middle - turn @ _compute_board_extent(board) / 2.0)


def _convert_rotation(vector: ArrayLike) -> Array:
    return RigidTransform.from_rotation_vector(vector, np.zeros(3)).rotation


def _choose_poses(offered: Mask, worth: Array, needed: Array, shots: int) -> list[int]:
    """Choose greedily the poses that add most to what is not yet covered and linked.

    offered: (poses, merits), by which pose.
    worth: (merits,) of each time a merit is gained, up to `needed` times; it fades quickly from there.
    """
    free = np.ones(len(offered), bool)
    counts, weights = np.zeros(len(worth)), offered.astype(np.float32)
    chosen: list[int] = []
    for _ in range(min(shots, len(free))):
        spare = np.maximum(counts - needed + 1.0, 0.0)
        gain = weights @ (worth * 0.35**spare).astype(np.float32)
        best = int(np.argmax(np.where(free, gain, -1.0)))
        free[best] = False
        counts += weights[best]
        chosen.append(best)
    return chosen


def _weigh_merits(
    sights: Mapping[str, Sight], striped: Mapping[str, Mask], visible: Mapping[str, Mask]
) -> tuple[Mask, Array, Array]:
    """Every cell of every image three times, near and far; tilts to all sides; six boards per pair;
    two pairs on one face of a board, or on both, three times.

    striped, visible: (poses,) in which each pair takes stripes, or at least the lit image.
    """
    parts: list[tuple[Mask, float, float]] = []
    for name, sight in sights.items():
        split = sight.cells & striped[name][:, None]
        near, far = np.split(split, 2, axis=1)
        tilted = visible[name] & (sight.angle_deg > 15)
        leans = (sight.lean[:, None] == np.arange(8)) & tilted[:, None]
        parts += [(near | far, 3.0, 3.0), (split, 0.7, 1.0), (leans, 3.0, 1.0)]
        parts += [(striped[name][:, None], 5.0, 6.0)]
    for first, second in combinations(sights, 2):
        both = visible[first] & visible[second]
        same = sights[first].back == sights[second].back
        parts += [((both & same)[:, None], 3.0, 3.0), ((both & ~same)[:, None], 2.0, 3.0)]
    sizes = [part.shape[1] for part, _, _ in parts]
    return (
        np.concatenate([part for part, _, _ in parts], axis=1),
        np.repeat([worth for _, worth, _ in parts], sizes),
        np.repeat([needed for _, _, needed in parts], sizes),
    )
