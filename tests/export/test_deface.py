"""Necks are found, and a defaced export has no face; below the neck it is unchanged, bit for bit."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import open3d as o3d
import pytest
from made_bodies import arrays, mesh_of, together
from small_bodies import points

from bodyscan.errors import FailedWork
from bodyscan.export.defacing import Neck, deface, find_neck
from bodyscan.export.scan import export_scan
from bodyscan.fusion.storage import StoredScan
from bodyscan.mesh.body import BodyCloud, BodyMesh
from bodyscan.mesh.ply import read_ply_mesh
from bodyscan.mesh.topology import compute_topology

SUBJECT = Path(__file__).parents[2] / "data" / "subjects" / "woman_average.ply"


@pytest.fixture(scope="module")
def body() -> BodyMesh:
    """The free subject in the rig frame, 1633 mm tall; soles and a patch of the face not measured."""
    vertices, faces = arrays(o3d.io.read_triangle_mesh(str(SUBJECT)))
    vertices = vertices * 1000.0 @ np.array([[0, 1, 0], [-1, 0, 0], [0, 0, 1.0]])
    rng = np.random.default_rng(3)
    sigma_mm = rng.uniform(0.01, 0.1, len(vertices)).astype(np.float32)
    sigma_mm[(vertices[:, 2] < 10.0) | (np.abs(vertices[:, 2] - 1550.0) < 15.0)] = np.nan
    return mesh_of(vertices, faces, colours=rng.integers(0, 256, vertices.shape), sigma_mm=sigma_mm)


@pytest.fixture(scope="module")
def neck(body: BodyMesh) -> Neck:
    return find_neck(body.vertices, body.faces)


def records(mesh: BodyMesh) -> list[bytes]:
    """Every vertex with all that it carries, as bytes."""
    parts = (mesh.vertices, mesh.normals, mesh.colours, mesh.sigma_mm)
    return [b"".join(part[k].tobytes() for part in parts) for k in range(len(mesh.vertices))]


def below(mesh: BodyMesh, height: float) -> list[tuple[bytes, bytes, bytes]]:
    """Records of the three corners of every face that lies below a height, in order."""
    every = records(mesh)
    faces = mesh.faces[(mesh.vertices[mesh.faces][..., 2] <= height).all(axis=1)]
    return [tuple(every[corner] for corner in face) for face in faces]


def test_the_neck_is_between_chin_and_shoulders(body: BodyMesh, neck: Neck) -> None:
    """Looked up on the subject: the chin's underside is near 1420 mm, the shoulders near 1350."""
    assert 1370.0 < neck.height_mm < 1425.0
    assert np.linalg.norm(neck.axis - np.median(body.vertices[:, :2], axis=0)) < 60.0


def test_below_the_neck_every_bit_stays_and_above_nothing_does(body: BodyMesh, neck: Neck) -> None:
    shared = deface(body, neck)
    kept = below(body, neck.height_mm)
    assert below(shared, neck.height_mm)[: len(kept)] == kept
    above = shared.vertices[:, 2] > neck.height_mm
    assert not set(np.array(records(shared), object)[above]) & set(records(body))
    assert np.all(shared.colours[above] == 150)
    assert np.all(np.isnan(shared.sigma_mm[above]))
    shape = compute_topology(shared.vertices, shared.faces)
    assert shape.closed
    assert shape.manifold
    assert shape.components == 1
    assert shape.volume_mm3 > 0


def test_two_faces_give_one_head(body: BodyMesh, neck: Neck) -> None:
    """Whoever the subject is, the head is the same: nothing of the face is left in it."""
    other = body.vertices.copy()
    face = (other[:, 2] > 1430.0) & (other[:, 0] > 60.0) & (np.abs(other[:, 1]) < 60.0)
    other[face, 0] += 15.0 * np.sin(other[face, 2] / 20.0)
    assert np.abs(other - body.vertices).max() > 10.0
    changed = BodyMesh(other, body.faces, body.normals, body.colours, body.sigma_mm, body.filled)
    np.testing.assert_array_equal(deface(changed, neck).vertices, deface(body, neck).vertices)


def test_the_head_is_smooth_and_faces_outwards(body: BodyMesh, neck: Neck) -> None:
    shared = deface(body, neck)
    corners = shared.vertices[shared.faces]
    head = (corners[..., 2] > neck.height_mm + 20.0).all(axis=1)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])[head]
    middles = corners[head].mean(axis=1)
    outwards = middles - [*middles[:, :2].mean(axis=0), neck.height_mm + 100.0]
    assert np.all(np.einsum("fc,fc->f", normals, outwards) > 0)
    # Nor does the head begin as the rim of the cut, which zigzags from face to face: the lowest ring
    # turns little from step to step, as a round line of so many does.
    low = neck.height_mm - 30.0
    added = shared.vertices[np.isnan(shared.sigma_mm) & (shared.vertices[:, 2] > low)]
    ring = added[: len(added) // 40]  # of 40 rings
    step = np.roll(ring, -1, axis=0) - ring
    turn = np.linalg.norm(step - np.roll(step, 1, axis=0), axis=1)
    # 46 points: 2 pi / 46 of a step, 0.14; along the rim's zigzag nearly all of it.
    assert turn.mean() < 0.25 * np.linalg.norm(step, axis=1).mean()


def test_raised_hands_stay(body: BodyMesh, neck: Neck) -> None:
    """A pillar beside the head, a separate piece above the neck, keeps every bit."""
    pillar = o3d.geometry.TriangleMesh.create_box(40.0, 40.0, 900.0).translate([0.0, 250.0, 900.0])
    vertices, faces = together((body.vertices, body.faces), arrays(pillar))
    size, more = len(vertices) - len(body.vertices), len(faces) - len(body.faces)
    both = BodyMesh(
        vertices,
        faces,
        np.concatenate([body.normals, np.ones((size, 3), np.float32)]),
        np.concatenate([body.colours, np.full((size, 3), 7, np.uint8)]),
        np.concatenate([body.sigma_mm, np.full(size, 0.5, np.float32)]),
        np.concatenate([body.filled, np.zeros(more, bool)]),
    )
    found = find_neck(both.vertices, both.faces)
    assert found.height_mm == neck.height_mm
    assert set(records(both)[-size:]) <= set(records(deface(both, found)))


def test_an_open_mesh_ends_at_the_neck(body: BodyMesh, neck: Neck) -> None:
    shared = deface(body.measured_part(), neck)
    assert shared.vertices[:, 2].max() <= neck.height_mm
    assert below(shared, neck.height_mm) == below(body.measured_part(), neck.height_mm)


def test_arms_overhead_are_refused_and_not_taken_for_a_neck(body: BodyMesh) -> None:
    """Two cylinders of a forearm's girth over the head: their narrowest is no neck."""
    parts = [(body.vertices, body.faces)]
    for y in (-60.0, 60.0):
        arm = o3d.geometry.TriangleMesh.create_cylinder(35.0, 700.0, 30, 60)
        shape, faces = arrays(arm.translate([0.0, y, 1900.0]))
        shape[:, 0] *= 1.0 + 0.3 * np.abs(shape[:, 2] - 1950.0) / 350.0
        parts.append((shape, faces))
    with pytest.raises(FailedWork, match="no neck"):
        find_neck(*together(*parts))


def test_no_neck_no_export(body: BodyMesh) -> None:
    with pytest.raises(FailedWork, match="no neck"):
        find_neck(*arrays(o3d.geometry.TriangleMesh.create_sphere(500.0, 40)))
    with pytest.raises(FailedWork, match="no neck"):
        find_neck(*arrays(o3d.geometry.TriangleMesh.create_tetrahedron(900.0)))
    with pytest.raises(FailedWork, match="nothing above the neck"):
        deface(body, Neck(3000.0, np.zeros(2)))


def test_exported_files_state_that_they_are_defaced(body: BodyMesh, tmp_path: Path) -> None:
    verdict = {"grade": "usable", "reasons": ["scans/mallow/s01 moved"]}
    facts = {"subject": "mallow", "when": "2026-11-21T10:00:00", "verdict": verdict}
    scan = StoredScan(points(), body, facts | {"calibration_id": "c", "failed": {"a": "mallow/a"}})
    export_scan(scan, tmp_path, ["ply"], ["full", "light", "open"], deface=True)
    for name in ("body", "body-light", "body-open"):
        text = (tmp_path / f"{name}.ply.json").read_text()
        assert json.loads(text)["defaced"] is True
        assert json.loads(text)["verdict"] == {"grade": "usable"}
        assert "mallow" not in text, "shared, it would say who and when"
        assert "2026" not in text
        mesh = read_ply_mesh(tmp_path / f"{name}.ply")
        assert not set(map(bytes, mesh.vertices[mesh.vertices[:, 2] > 1430.0])) & set(
            map(bytes, body.vertices)
        )


def test_a_texture_shows_no_face_either(body: BodyMesh, neck: Neck, tmp_path: Path) -> None:
    pytest.importorskip("xatlas")
    red = np.where(body.vertices[:, 2:] > neck.height_mm, [255, 0, 0], [0, 90, 90]).astype(np.uint8)
    cloud = BodyCloud(body.vertices, body.normals, body.sigma_mm, red, red[:, 0])
    scan = StoredScan(cloud, replace(body, colours=red), {"calibration_id": "c"})
    export_scan(scan, tmp_path, ["obj"], ["textured"], texture_px=512, deface=True)
    image = cv2.imread(str(tmp_path / "body-textured.png"))[..., ::-1].astype(int)
    assert (image[..., 0] <= image[..., 1].clip(min=150)).all()
    assert (image == 150).all(axis=-1).any()  # the plain head
