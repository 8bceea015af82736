"""Our PLY files: exact on reading back, readable by others, refused when damaged."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import open3d as o3d
import pytest
from small_bodies import ball, points

from bodyscan.errors import ResultError
from bodyscan.mesh.body import BodyCloud, BodyMesh, BreathAt
from bodyscan.mesh.ply import read_ply_cloud, read_ply_mesh, write_ply


def assert_same(one: BodyCloud | BodyMesh, other: BodyCloud | BodyMesh) -> None:
    for field in fields(one):
        mine, theirs = getattr(one, field.name), getattr(other, field.name)
        if mine is None:
            assert theirs is None
            continue
        assert mine.dtype == theirs.dtype, field.name
        assert mine.tobytes() == theirs.tobytes(), field.name


@pytest.mark.parametrize("regions", [False, True])
def test_bodies_are_read_back_to_the_last_bit(tmp_path: Path, regions: bool) -> None:
    mesh, cloud = ball(), points()
    if regions:
        rng = np.random.default_rng(1)
        mesh = replace(mesh, regions=rng.integers(0, 4, len(mesh.vertices)).astype(np.uint8))
        cloud = replace(cloud, regions=rng.integers(0, 4, len(cloud.points)).astype(np.uint8))
    write_ply(tmp_path / "mesh.ply", mesh)
    write_ply(tmp_path / "cloud.ply", cloud)
    assert_same(read_ply_mesh(tmp_path / "mesh.ply"), mesh)
    assert_same(read_ply_cloud(tmp_path / "cloud.ply"), cloud)


def test_the_displacement_to_mean_breath_is_kept(tmp_path: Path) -> None:
    mesh = ball()
    step, sigma = np.random.default_rng(1).random((2, len(mesh.vertices)), np.float32)
    write_ply(tmp_path / "mesh.ply", replace(mesh, breath=BreathAt(step, sigma)))
    breath = read_ply_mesh(tmp_path / "mesh.ply").breath
    assert breath is not None
    assert (breath.mm.tobytes(), breath.sigma_mm.tobytes()) == (step.tobytes(), sigma.tobytes())
    seen = o3d.io.read_triangle_mesh(str(tmp_path / "mesh.ply"))
    np.testing.assert_array_equal(np.asarray(seen.triangles), mesh.faces)


def test_an_unknown_region_is_refused(tmp_path: Path) -> None:
    cloud = replace(points(), regions=np.full(500, 9, np.uint8))
    write_ply(tmp_path / "cloud.ply", cloud)
    with pytest.raises(ResultError, match="unknown region, 9"):
        read_ply_cloud(tmp_path / "cloud.ply")


def test_an_empty_cloud_can_be_stored(tmp_path: Path) -> None:
    cloud = replace(points(), regions=np.zeros(500, np.uint8))
    cloud = BodyCloud(*(getattr(cloud, field.name)[:0] for field in fields(BodyCloud)))
    write_ply(tmp_path / "empty.ply", cloud)
    assert len(read_ply_cloud(tmp_path / "empty.ply").points) == 0


def test_open3d_reads_it(tmp_path: Path) -> None:
    mesh, cloud = ball(), points()
    write_ply(tmp_path / "mesh.ply", mesh)
    write_ply(tmp_path / "cloud.ply", cloud)
    seen = o3d.io.read_triangle_mesh(str(tmp_path / "mesh.ply"))
    np.testing.assert_allclose(np.asarray(seen.vertices), mesh.vertices, atol=1e-9)
    np.testing.assert_array_equal(np.asarray(seen.triangles), mesh.faces)
    np.testing.assert_allclose(np.asarray(seen.vertex_normals), mesh.normals, atol=1e-6)
    np.testing.assert_allclose(np.asarray(seen.vertex_colors) * 255.0, mesh.colours, atol=1e-6)
    dots = o3d.t.io.read_point_cloud(str(tmp_path / "cloud.ply"))
    np.testing.assert_array_equal(dots.point.positions.numpy(), cloud.points)
    np.testing.assert_array_equal(dots.point.sigma_mm.numpy()[:, 0], cloud.sigma_mm)
    np.testing.assert_array_equal(dots.point.pairs_seen.numpy()[:, 0], cloud.pairs_seen)


@pytest.mark.parametrize(
    "damage",
    [
        lambda data: data[:-1],
        lambda data: data[:40],
        lambda data: data + b"\0",
        lambda data: b"solid " + data,
        lambda data: data.replace(b"property float sigma_mm", b"property float quality", 1),
        lambda data: data.replace(b"element vertex 500", b"element vertex 499", 1),
    ],
)
def test_a_damaged_file_is_refused(tmp_path: Path, damage: Callable[[bytes], bytes]) -> None:
    path = tmp_path / "cloud.ply"
    write_ply(path, points())
    path.write_bytes(damage(path.read_bytes()))
    with pytest.raises(ResultError, match=r"cloud\.ply"):
        read_ply_cloud(path)


def test_a_mesh_is_no_cloud(tmp_path: Path) -> None:
    write_ply(tmp_path / "mesh.ply", ball())
    with pytest.raises(ResultError, match="not a cloud"):
        read_ply_cloud(tmp_path / "mesh.ply")
    write_ply(tmp_path / "cloud.ply", points())
    with pytest.raises(ResultError, match="not a mesh"):
        read_ply_mesh(tmp_path / "cloud.ply")
    with pytest.raises(ResultError, match="cannot be read"):
        read_ply_mesh(tmp_path / "nowhere.ply")


def test_a_face_without_its_vertex_is_refused(tmp_path: Path) -> None:
    mesh = ball()
    mesh.faces[7, 1] = len(mesh.vertices)
    write_ply(tmp_path / "mesh.ply", mesh)
    with pytest.raises(ResultError, match="face 7 names vertex 762, which is not there"):
        read_ply_mesh(tmp_path / "mesh.ply")
