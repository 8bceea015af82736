"""A standing body of elliptic columns, on a grid: its trunk's girth is known from a formula."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.special import ellipe

from bodyscan.arrays import Array, Indices
from bodyscan.mesh.surface_nets import SIDE, Bricks, extract_surface, split_into_bricks

DEPTH_MM, WIDTH_MM = 110.0, 160.0
"""Half of the trunk's."""
SHOULDER = (0.0, 190.0, 1330.0)
FEET = ((0.0, 95.0, 35.0), (130.0, 110.0, 35.0))
Place = Sequence[float] | Array
Rod = tuple[Place, Place, float]
"""From, to, and radius, mm; on the left, and mirrored."""


def trunk_tape(scale: float = 1.0, stout: float = 1.0) -> float:
    """Perimeter of the trunk's ellipse."""
    return float(scale * stout * 4.0 * WIDTH_MM * ellipe(1.0 - (DEPTH_MM / WIDTH_MM) ** 2))


def hanging(angle_deg: float) -> list[Rod]:
    """An arm with its hand, held off by an angle."""
    turn = np.radians(angle_deg)
    down = np.array([0.0, np.sin(turn), -np.cos(turn)])
    elbow, wrist, tip = (np.array(SHOULDER) + reach * down for reach in (300.0, 520.0, 680.0))
    return [(SHOULDER, elbow, 45.0), (elbow, wrist, 38.0), (wrist, tip, 20.0)]


HAND_ON_HIP: list[Rod] = [
    (SHOULDER, (-40.0, 400.0, 1120.0), 45.0),
    ((-40.0, 400.0, 1120.0), (0.0, 185.0, 930.0), 35.0),
]


def standing_body(
    arms: Sequence[Rod], *, scale: float = 1.0, stout: float = 1.0, apart_mm: float = 95.0
) -> tuple[Array, Indices]:
    """Vertices and faces, body frame; stout: factor on the trunk's and the thighs' widths."""
    cell, low = 7.0, np.array([-250.0, -700.0, -30.0])
    count = np.ceil(np.array([500.0, 1400.0, 1800.0]) / cell / SIDE).astype(int)
    axes = [start + cell * np.arange(n * SIDE) for start, n in zip(low, count, strict=True)]
    x, y, z = np.meshgrid(*axes, indexing="ij", sparse=True)
    radius = np.sqrt((x / (DEPTH_MM * stout)) ** 2 + (y / (WIDTH_MM * stout)) ** 2)
    trunk = np.maximum((radius - 1.0) * DEPTH_MM * stout, np.maximum(800.0 - z, z - 1380.0))
    legs: list[Rod] = [
        ((0.0, apart_mm, 60.0), (0.0, apart_mm, 820.0), 70.0 * stout),
        ((FEET[0][0], apart_mm, 35.0), (FEET[1][0], apart_mm, 35.0), 35.0),
    ]
    spine: Rod = ((0.0, 0.0, 1380.0), (0.0, 0.0, 1620.0), 70.0)
    inside = np.minimum(trunk, _rod((x, y, z), spine))
    for rod in [*legs, *arms, ((0.0, 100.0, 1340.0), SHOULDER, 60.0)]:
        inside = np.minimum(inside, _rod((x, np.abs(y), z), rod))
    bricks = Bricks.from_mask(np.ones(count, bool), low, cell)
    values = np.clip(inside, -2.0 * cell, 2.0 * cell).astype(np.float32)
    vertices, faces = extract_surface(bricks, split_into_bricks(values))
    return scale * vertices, faces


def _rod(place: tuple[Array, Array, Array], rod: Rod) -> Array:
    """Signed distance from a rod with round ends."""
    start, end = np.array(rod[0]), np.array(rod[1])
    along = end - start
    share = sum((p - s) * a for p, s, a in zip(place, start, along, strict=True)) / (along @ along)
    share = np.clip(share, 0.0, 1.0)
    squares = sum((p - s - share * a) ** 2 for p, s, a in zip(place, start, along, strict=True))
    return np.asarray(np.sqrt(squares) - rod[2])
