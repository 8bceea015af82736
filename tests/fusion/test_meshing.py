"""The closed mesh of a body, with and without the knowledge of what cameras saw through."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import open3d as o3d
import pytest
from meshed import mesh
from ray_cast_scan import Scan, Truth
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from benchmarks.self_intersections import self_intersections
from bodyscan.errors import ScanFailed
from bodyscan.evaluation.surface import compute_signed_distances, summarize_deviation
from bodyscan.fusion.signed_distances import REACH_CELLS, find_near_bricks
from bodyscan.mesh.body import HAIR, SKIN, UNSURE, BodyCloud, BodyMesh
from bodyscan.mesh.surface_nets import SIDE
from bodyscan.mesh.topology import compute_signed_volume, compute_topology
from bodyscan.progress import map_threads
from bodyscan.settings import MeshSettings


def crossings(body: BodyMesh, start: np.ndarray, way: np.ndarray) -> np.ndarray:
    """How often each ray (N, 3) from start along way meets the mesh."""
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(
        o3d.core.Tensor(body.vertices.astype(np.float32)),
        o3d.core.Tensor(body.faces.astype(np.uint32)),
    )
    rays = np.concatenate([start, np.broadcast_to(way, start.shape)], axis=1)
    return scene.count_intersections(o3d.core.Tensor(rays.astype(np.float32))).numpy()


def test_bricks_are_wanted_that_hold_a_node_within_reach_or_next_to_one() -> None:
    rng = np.random.default_rng(0)
    origin, cell_mm, shape = np.array([-40.0, 10.0, 5.0]), 2.5, (5, 4, 6)
    places = rng.uniform(REACH_CELLS + 2.0, SIDE * np.array(shape) - REACH_CELLS - 2.0, (12, 3))
    # A brick is as far from a point as its nearest node is, along each axis by itself.
    first = SIDE * np.moveaxis(np.indices(shape), 0, -1)[..., None, :]
    inside = np.clip(places, first, first + SIDE - 1)
    far = np.abs(inside - places).max(axis=-1)
    found = find_near_bricks(origin + cell_mm * places, origin, cell_mm, shape)
    assert found[(far < REACH_CELLS + 2.0).any(axis=-1)].all()
    assert not found[(far > REACH_CELLS + 3.0).all(axis=-1)].any()
    assert 0.1 < found.mean() < 0.9


def test_closed_manifold_one_piece_outward(scan: Scan, body: BodyMesh) -> None:
    found = compute_topology(body.vertices, body.faces)
    assert found.closed
    assert found.manifold
    assert found.components == 1
    # Fingers are two of these cells thick, and less than one apart: they may touch, which makes a
    # handle or two a hand, and nothing else may.
    assert found.euler in (-4, -2, 0, 2)
    assert handles_between(body, 900.0, 1330.0) == 0  # armpits: arms hang from shoulders alone
    true_volume = compute_signed_volume(scan.truth.vertices, scan.truth.faces)
    # The truth has a mouth and eye sockets that nobody can see into: about half a per cent.
    assert found.volume_mm3 == pytest.approx(true_volume, rel=0.015)
    np.testing.assert_array_equal(np.unique(body.faces), np.arange(len(body.vertices)))
    # A net meets itself nowhere; settling on the points may cross slivers at fingers, as wide as two
    # of these cells: 0.02 % of 140,000 edges.
    assert len(self_intersections(body.vertices, body.faces)) <= 28


def handles_between(body: BodyMesh, low_mm: float, high_mm: float) -> int:
    """Of the part of the mesh between two heights, less the rims that cutting leaves: 0 if trunk and
    arms are plain tubes there."""
    z = body.vertices[body.faces][:, :, 2]
    part = body.faces[((z > low_mm) & (z < high_mm)).all(axis=1)]
    found = compute_topology(body.vertices, part)
    edges = np.sort(np.concatenate([part[:, [0, 1]], part[:, [1, 2]], part[:, [2, 0]]]), axis=1)
    once = np.unique(edges, axis=0, return_counts=True)
    rim = once[0][once[1] == 1]
    ends, number = np.unique(rim, return_inverse=True)
    pairs = number.reshape(-1, 2).T
    graph = coo_array((np.ones(len(rim)), pairs), (ends.size, ends.size))
    rims = connected_components(graph, directed=False)[0]
    return int(2 * found.components - rims - found.euler) // 2


def test_measured_vertices_lie_on_the_body(scan: Scan, body: BodyMesh) -> None:
    measured = np.unique(body.faces[~body.filled])
    assert np.isfinite(body.sigma_mm[measured]).all()
    found = summarize_deviation(
        compute_signed_distances(body.vertices[measured], scan.truth.vertices, scan.truth.faces)
    )
    # Cells of 7 mm at depth 8: fingers, toes and ears suffer, the rest does not.
    assert abs(found.bias_mm) < 0.1
    assert found.median_mm < 0.1
    assert found.p95_mm < 1.0


def test_normals_and_colours_belong_to_the_vertices(body: BodyMesh, cloud: BodyCloud) -> None:
    a, b, c = (body.vertices[body.faces[:, k]] for k in range(3))
    face_normals = np.cross(b - a, c - a)
    along = np.sum(face_normals[:, None] * body.normals[body.faces], axis=-1)
    assert np.mean(along > 0) > 0.999
    assert abs(float(np.mean(body.colours)) - float(np.mean(cloud.colours))) < 20.0


def test_made_up_faces_are_marked(scan: Scan, body: BodyMesh) -> None:
    centres = body.vertices[body.faces].mean(axis=1)
    off = np.abs(compute_signed_distances(centres, scan.truth.vertices, scan.truth.faces))
    assert 0.01 < body.filled.mean() < 0.15
    # What is far from the truth is known to be made up, and the soles are nobody's to see.
    assert body.filled[off > 8.0].mean() > 0.95
    assert body.filled[centres[:, 2] < 1.0].all()
    assert np.isnan(body.sigma_mm).any()


def test_no_web_between_the_legs(cloud: BodyCloud, body: BodyMesh) -> None:
    """Rays from front to back meet nothing in the gap below the crotch (at 743 mm)."""
    z = np.linspace(640.0, 700.0, 13)
    start = np.stack([np.full_like(z, 500.0), np.zeros_like(z), z], axis=1)
    way = np.array([-1.0, 0.0, 0.0])
    without = mesh(cloud, MeshSettings(depth=7))
    # Filling alone closes the gap, which no camera sees from the front; the back pole sees
    # through it, and that knowledge opens it.
    assert crossings(without, start, way).max() >= 2
    assert crossings(body, start, way).max() == 0


def test_feet_stand_on_the_floor(scan: Scan, body: BodyMesh) -> None:
    """Nobody sees the soles; a surface that is only smooth bulges into the floor, or arches over it."""
    assert body.vertices[:, 2].min() > -4.0  # a cell is 7 mm
    centres = body.vertices[body.faces].mean(axis=1)
    a, b, c = (body.vertices[body.faces[:, k]] for k in range(3))
    below = np.cross(b - a, c - a)
    soles = body.filled & (below[:, 2] < 0.0) & (centres[:, 2] < 30.0)
    flat = -0.5 * below[soles & (np.abs(centres[:, 2]) < 4.0), 2].sum()
    # The truth's soles, toes and heels rounded off, are 6 mm or less from the floor on 190 cm2.
    assert flat > 0.6 * sole_area(scan.truth)


def sole_area(truth: Truth) -> float:
    """mm2 of a body that look down, no more than 6 mm from the floor."""
    a, b, c = (truth.vertices[truth.faces[:, k]] for k in range(3))
    down = np.cross(b - a, c - a)[:, 2]
    near = (a + b + c)[:, 2] < 18.0
    return float(-0.5 * down[near & (down < 0.0)].sum())


def test_the_same_cloud_gives_the_same_bytes(
    scan: Scan, cloud: BodyCloud, monkeypatch: pytest.MonkeyPatch
) -> None:
    high = np.where(cloud.points[:, 2] > 1000.0, HAIR, SKIN).astype(np.uint8)
    some = replace(cloud, regions=high).subsample(4)
    coarse = MeshSettings(depth=6)
    one = mesh(some, coarse, scan.range_images[:6], scan.rig_from_camera)
    monkeypatch.setattr(map_threads, "__kwdefaults__", {"workers": 1})
    other = mesh(some, coarse, scan.range_images[:6], scan.rig_from_camera)
    for name in BodyMesh.__dataclass_fields__:
        first, second = getattr(one, name), getattr(other, name)
        if first is None:  # what only a person who breathed has
            assert second is None
        else:
            assert first.tobytes() == second.tobytes()
    filled, height = np.isnan(one.sigma_mm), one.vertices[:, 2]
    assert one.regions is not None
    assert set(one.regions[filled]) == {UNSURE}
    # A vertex takes after the nearest point, which is within the reach.
    assert set(one.regions[~filled & (height > 1004.0)]) == {HAIR}
    assert set(one.regions[~filled & (height < 996.0)]) == {SKIN}


def test_a_body_clear_of_the_floor_needs_no_hints(cloud: BodyCloud) -> None:
    lifted = replace(cloud, points=cloud.points + np.array([0.0, 0.0, 200.0]))
    found = mesh(lifted, MeshSettings(depth=6))
    assert compute_topology(found.vertices, found.faces).manifold
    assert found.vertices[:, 2].min() > 100.0


def test_a_handful_of_points_is_an_error(cloud: BodyCloud) -> None:
    few = cloud.subsample(1000)
    with pytest.raises(ScanFailed, match="too small"):
        mesh(few, MeshSettings())
