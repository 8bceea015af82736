"""How high a head may end whose crown was measured in part."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from bodyscan.arrays import Array, Mask
from bodyscan.fusion.crown import Crown
from bodyscan.fusion.meshing import mesh
from bodyscan.mesh.body import BodyCloud
from bodyscan.settings import MeshSettings

RADIUS, TOP = 80.0, 1700.0
MISSING_MM, ASIDE_MM = 28.0, 25.0
"""Radius of what pairs at the height of a man's head see too flat, and how far from the top it lies."""


def head(seen: Callable[[Array], Mask], noise_mm: float = 0.1, tilt: float = 0.02) -> BodyCloud:
    """A ball, as a cloud of points 2 mm apart, where it was seen."""
    rng = np.random.default_rng(0)
    ways = rng.normal(size=(20_000, 3))
    ways /= np.linalg.norm(ways, axis=1, keepdims=True)
    points = np.array([0.0, 0.0, TOP - RADIUS]) + RADIUS * ways
    kept = seen(points)
    points, ways = points[kept], ways[kept]
    count = len(points)
    points = points + noise_mm * rng.normal(size=(count, 1)) * ways
    normals = ways + tilt * rng.normal(size=(count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return BodyCloud(
        points,
        normals.astype(np.float32),
        np.full(count, 0.1, np.float32),
        np.full((count, 3), 128, np.uint8),
        np.ones(count, np.uint8),
    )


def unknown_mm(cloud: BodyCloud) -> float:
    return Crown.of(cloud.points, cloud.normals).unknown_mm


def beside_a_hole(points: Array) -> Mask:
    """The hole's rim reaches the top."""
    low = points[:, 2] < TOP - RADIUS
    return np.asarray(low | (np.hypot(points[:, 0] - ASIDE_MM, points[:, 1]) > MISSING_MM))


def test_a_head_seen_all_round_ends_where_it_was_measured() -> None:
    assert unknown_mm(head(lambda points: np.ones(len(points), bool))) < 1.0


def test_a_hole_beside_the_top_leaves_little_open() -> None:
    assert unknown_mm(head(beside_a_hole)) < 2.0


@pytest.mark.parametrize(("cut_mm", "least_mm"), [(3.0, 4.0), (10.0, 15.0), (80.0, np.inf)])
def test_a_head_cut_off_or_with_hair_that_gave_no_data_may_go_on(
    cut_mm: float, least_mm: float
) -> None:
    assert unknown_mm(head(lambda points: points[:, 2] < TOP - cut_mm)) >= least_mm


def test_what_is_not_convex_holds_nothing() -> None:
    """A low level ledge beside a column that was cut off, such as a shoulder beside a neck."""
    rng = np.random.default_rng(1)
    ledge = np.column_stack([rng.uniform(-40.0, 40.0, (3000, 2)), np.full(3000, TOP - 50.0)])
    up = np.tile([0.0, 0.0, 1.0], (3000, 1))
    wall = head(lambda points: np.abs(points[:, 2] - TOP + RADIUS) < 20.0)
    raised = wall.points + [0.0, 0.0, 60.0]
    found = Crown.of(np.concatenate([ledge, raised]), np.concatenate([up, wall.normals]))
    assert found.unknown_mm > 40.0


def test_a_mesh_does_not_bulge_over_a_hole_in_the_crown() -> None:
    """Harmonic distances alone stood 3 mm above it, a stature's whole allowance."""
    found = mesh(head(beside_a_hole), MeshSettings())
    assert found.filled.any()
    assert abs(found.vertices[:, 2].max() - TOP) < 1.0
