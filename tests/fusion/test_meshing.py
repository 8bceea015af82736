"""The closed mesh of a body, with and without the knowledge of what cameras saw through."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import open3d as o3d
import pytest
from ray_cast_scan import Scan

from benchmarks.self_intersections import self_intersections
from bodyscan.errors import ScanFailed
from bodyscan.evaluation.surface import deviation, signed_distances
from bodyscan.fusion.meshing import mesh, poisson
from bodyscan.mesh.body import BodyCloud, BodyMesh
from bodyscan.mesh.topology import signed_volume, topology
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


def between_the_thighs() -> tuple[np.ndarray, np.ndarray]:
    """Rays from front to back in the gap below the crotch (at 743 mm): open in the truth."""
    z = np.linspace(640.0, 700.0, 13)
    return np.stack([np.full_like(z, 500.0), np.zeros_like(z), z], axis=1), np.array([-1.0, 0, 0])


def test_closed_manifold_one_piece_outward(scan: Scan, body: BodyMesh) -> None:
    found = topology(body.vertices, body.faces)
    assert found.closed
    assert found.manifold
    assert found.components == 1
    # Fingers are one and a half of these cells thick: two may touch, and make one handle.
    assert found.euler in (0, 2)
    true_volume = signed_volume(scan.truth.vertices, scan.truth.faces)
    # The truth has a mouth and eye sockets that nobody can see into: about half a per cent.
    assert found.volume_mm3 == pytest.approx(true_volume, rel=0.015)
    np.testing.assert_array_equal(np.unique(body.faces), np.arange(len(body.vertices)))
    # Poisson's surface meets itself nowhere; settling on the points may cross slivers at fingers,
    # as wide as two of these cells: 0.02 % of 140,000 edges.
    assert len(self_intersections(body.vertices, body.faces)) <= 28


def test_measured_vertices_lie_on_the_body(scan: Scan, body: BodyMesh) -> None:
    measured = np.unique(body.faces[~body.filled])
    assert np.isfinite(body.sigma_mm[measured]).all()
    found = deviation(
        signed_distances(body.vertices[measured], scan.truth.vertices, scan.truth.faces)
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
    off = np.abs(signed_distances(centres, scan.truth.vertices, scan.truth.faces))
    assert 0.01 < body.filled.mean() < 0.15
    # What is far from the truth is known to be made up, and the soles are nobody's to see.
    assert body.filled[off > 8.0].mean() > 0.95
    assert body.filled[centres[:, 2] < 1.0].all()
    assert np.isnan(body.sigma_mm).any()


def test_no_web_between_the_legs(scan: Scan, cloud: BodyCloud, body: BodyMesh) -> None:
    start, way = between_the_thighs()
    without = mesh(cloud, MeshSettings(depth=7))
    # Poisson alone closes the gap, which no camera sees from the front; the back pole sees
    # through it, and that knowledge opens it.
    assert crossings(without, start, way).max() >= 2
    assert crossings(body, start, way).max() == 0


def test_feet_stand_on_the_floor(cloud: BodyCloud, body: BodyMesh) -> None:
    """Nobody sees the soles; a surface that is only smooth bulges far into the floor."""
    some = slice(None, None, 4)
    smooth, _ = poisson(cloud.points[some], cloud.normals[some].astype(float), 8)
    assert smooth[:, 2].min() < -10.0
    assert body.vertices[:, 2].min() > -4.0  # a cell of the octree is 7 mm


def test_the_same_cloud_gives_the_same_bytes(scan: Scan, cloud: BodyCloud) -> None:
    some = BodyCloud(*(getattr(cloud, name)[::4] for name in BodyCloud.__dataclass_fields__))
    one, other = (
        mesh(
            some,
            MeshSettings(depth=6),
            scan.range_images[:6],
            scan.rig_from_camera,
            workers=workers,
        )
        for workers in (1, 2)
    )
    for name in BodyMesh.__dataclass_fields__:
        assert getattr(one, name).tobytes() == getattr(other, name).tobytes()


def test_a_body_clear_of_the_floor_needs_no_hints(cloud: BodyCloud) -> None:
    lifted = replace(cloud, points=cloud.points + np.array([0.0, 0.0, 200.0]))
    found = mesh(lifted, MeshSettings(depth=6))
    assert topology(found.vertices, found.faces).manifold
    assert found.vertices[:, 2].min() > 100.0


def test_a_handful_of_points_is_an_error(cloud: BodyCloud) -> None:
    few = BodyCloud(*(getattr(cloud, name)[:50] for name in BodyCloud.__dataclass_fields__))
    with pytest.raises(ScanFailed, match="too small"):
        mesh(few, MeshSettings())
