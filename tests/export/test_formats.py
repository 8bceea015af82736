"""OBJ, STL and GLB as other programs read them, and the JSON beside each file."""

from __future__ import annotations

import json
import struct
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import open3d as o3d
import pytest
from small_bodies import ball, points

from bodyscan.errors import BadInput
from bodyscan.export.body_file import Provenance, write_body
from bodyscan.export.formats.glb import write_glb
from bodyscan.export.formats.obj import write_obj
from bodyscan.export.formats.stl import write_stl
from bodyscan.export.scan import export_scan
from bodyscan.fusion.storage import StoredScan
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.mesh.ply import read_ply_mesh
from bodyscan.version import __version__

MESH_FORMATS = ("ply", "obj", "stl", "glb")
ORIGIN = Provenance("S-0042", "3f2a")


def test_obj(tmp_path: Path) -> None:
    mesh = ball()
    write_obj(tmp_path / "body.obj", mesh)
    text = (tmp_path / "body.obj").read_text()
    assert "-0.0000 " not in text
    rows = [line.split() for line in text.splitlines()]
    vertices = np.array([row[1:] for row in rows if row[0] == "v"], float)
    normals = np.array([row[1:] for row in rows if row[0] == "vn"], float)
    faces = [row[1:] for row in rows if row[0] == "f"]
    # Four places: half a unit in the fourth.
    np.testing.assert_allclose(vertices[:, :3], mesh.vertices, atol=0.51e-4)
    np.testing.assert_allclose(vertices[:, 3:] * 255.0, mesh.colours, atol=0.02)
    np.testing.assert_allclose(normals, mesh.normals, atol=0.51e-4)
    corners = np.array([[int(corner.split("//")[0]) for corner in face] for face in faces])
    np.testing.assert_array_equal(corners - 1, mesh.faces)
    assert all(corner.split("//")[0] == corner.split("//")[1] for face in faces for corner in face)
    seen = o3d.io.read_triangle_mesh(str(tmp_path / "body.obj"))
    assert len(seen.vertices) == len(mesh.vertices)  # welded
    # Open3D's reader numbers vertices as faces name them.
    order = np.unique(mesh.faces.ravel(), return_index=True)[1].argsort()
    np.testing.assert_allclose(np.asarray(seen.vertices), mesh.vertices[order], atol=1e-4)
    colours = np.asarray(seen.vertex_colors) * 255.0
    np.testing.assert_allclose(colours, mesh.colours[order], atol=0.02)


def test_stl(tmp_path: Path) -> None:
    mesh = ball()
    write_stl(tmp_path / "body.stl", mesh)
    size = (tmp_path / "body.stl").stat().st_size
    assert size == 84 + 50 * len(mesh.faces)
    seen = o3d.io.read_triangle_mesh(str(tmp_path / "body.stl"))
    corners = np.asarray(seen.vertices)[np.asarray(seen.triangles)]
    np.testing.assert_allclose(corners, mesh.vertices[mesh.faces], atol=2e-5)  # float32
    seen.compute_triangle_normals()
    outward = corners.mean(axis=1) - mesh.vertices.mean(axis=0)
    assert (np.sum(np.asarray(seen.triangle_normals) * outward, axis=1) > 0).all()


def glb_parts(path: Path) -> tuple[dict[str, Any], bytes]:
    """The JSON and the binary part, by the standard's own words (glTF 2.0, 4.4)."""
    data = path.read_bytes()
    magic, version, length = struct.unpack_from("<4sII", data)
    assert (magic, version, length) == (b"glTF", 2, len(data))
    size, kind = struct.unpack_from("<I4s", data, 12)
    assert kind == b"JSON"
    assert size % 4 == 0
    document = json.loads(data[20 : 20 + size])
    binary_size, kind = struct.unpack_from("<I4s", data, 20 + size)
    assert kind == b"BIN\0"
    assert binary_size % 4 == 0
    binary = data[28 + size :]
    assert len(binary) == binary_size == document["buffers"][0]["byteLength"]
    return document, binary


def accessor(document: dict[str, Any], binary: bytes, number: int) -> np.ndarray:
    info = document["accessors"][number]
    view = document["bufferViews"][info["bufferView"]]
    assert view["byteOffset"] % 4 == 0
    kind = {5126: "<f4", 5123: "<u2", 5125: "<u4"}[info["componentType"]]
    width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[info["type"]]
    values = np.frombuffer(binary, kind, info["count"] * width, view["byteOffset"])
    assert view["byteLength"] == values.nbytes
    return values.reshape(-1, width)


def test_glb_mesh(tmp_path: Path) -> None:
    mesh = ball()
    write_glb(tmp_path / "body.glb", mesh)
    document, binary = glb_parts(tmp_path / "body.glb")
    (primitive,) = document["meshes"][0]["primitives"]
    assert primitive["mode"] == 4
    read = {k: accessor(document, binary, n) for k, n in primitive["attributes"].items()}
    x, y, z = mesh.vertices.T / 1000.0
    np.testing.assert_allclose(read["POSITION"], np.stack([y, z, x], axis=1), atol=1e-7)
    info = document["accessors"][primitive["attributes"]["POSITION"]]
    np.testing.assert_array_equal(info["min"], read["POSITION"].min(axis=0))
    np.testing.assert_array_equal(info["max"], read["POSITION"].max(axis=0))
    np.testing.assert_allclose(np.linalg.norm(read["NORMAL"], axis=1), 1.0, atol=1e-6)
    # Vertex colours are linear light; sRGB's middle grey 188 is half of white.
    order = np.argsort(mesh.colours[:, 0])
    half = np.searchsorted(read["COLOR_0"][order, 0], 32768)
    assert abs(int(mesh.colours[order[half], 0]) - 188) <= 2
    assert (read["COLOR_0"][:, 3] == 65535).all()
    np.testing.assert_array_equal(read["_FILLED"][:, 0] == 1.0, np.isnan(mesh.sigma_mm))
    indices = accessor(document, binary, primitive["indices"])
    np.testing.assert_array_equal(indices.reshape(-1, 3), mesh.faces)
    seen = o3d.io.read_triangle_mesh(str(tmp_path / "body.glb"))
    assert len(seen.triangles) == len(mesh.faces)
    # The same hand: outward faces stay outward.
    assert seen.get_volume() > 0


def test_glb_cloud(tmp_path: Path) -> None:
    cloud = points()
    write_glb(tmp_path / "cloud.glb", cloud)
    document, binary = glb_parts(tmp_path / "cloud.glb")
    (primitive,) = document["meshes"][0]["primitives"]
    assert primitive["mode"] == 0
    assert "indices" not in primitive
    position = accessor(document, binary, primitive["attributes"]["POSITION"])
    np.testing.assert_allclose(position[:, 1] * 1000.0, cloud.points[:, 2], atol=2e-4)


@pytest.mark.parametrize("suffix", [f".{name}" for name in MESH_FORMATS])
def test_the_json_beside_a_mesh_describes_it(tmp_path: Path, suffix: str) -> None:
    mesh = ball()
    write_body(tmp_path / f"body{suffix}", mesh, ORIGIN)
    info = json.loads((tmp_path / f"body{suffix}.json").read_text())
    expected = {
        "units": "m" if suffix == ".glb" else "mm",
        "kind": "mesh",
        "vertices": len(mesh.vertices),
        "faces": len(mesh.faces),
        "filled_faces": np.count_nonzero(mesh.filled),
        "subject": "S-0042",
        "calibration_id": "3f2a",
        "software": f"bodyscan {__version__}",
    }
    assert info == info | expected
    assert info["axes"]["y"] == ("up" if suffix == ".glb" else "left")
    assert sorted(p.name for p in tmp_path.iterdir()) == [f"body{suffix}", f"body{suffix}.json"]


@pytest.mark.parametrize("suffix", [".ply", ".glb"])
def test_the_json_beside_a_cloud_describes_it(tmp_path: Path, suffix: str) -> None:
    write_body(tmp_path / f"cloud{suffix}", points(), ORIGIN)
    info = json.loads((tmp_path / f"cloud{suffix}.json").read_text())
    assert (info["kind"], info["points"]) == ("cloud", 500)


def test_the_same_body_gives_the_same_bytes(tmp_path: Path) -> None:
    for folder in ("one", "other"):
        for name in MESH_FORMATS:
            write_body(tmp_path / folder / f"body.{name}", ball(), ORIGIN)
    for path in (tmp_path / "one").iterdir():
        assert path.read_bytes() == (tmp_path / "other" / path.name).read_bytes()


def test_a_scan_in_several_versions(tmp_path: Path) -> None:
    scan = StoredScan(points(), ball(), {"subject": None, "calibration_id": "3f2a"})
    written = export_scan(scan, tmp_path, ["ply", "STL"], ["full", "open"])
    names = ["body.ply", "body.stl", "body-open.ply", "body-open.stl"]
    assert [path.name for path in written] == names
    assert all(path.is_file() for path in written)
    info = json.loads((tmp_path / "body-open.ply.json").read_text())
    assert info["filled_faces"] == 0
    assert info["subject"] is None
    with pytest.raises(BadInput, match="no 'heavy' to export"):
        export_scan(scan, tmp_path, ["ply"], ["heavy"])


@pytest.mark.parametrize("suffix", MESH_FORMATS)
def test_with_y_up_a_file_says_so_and_the_body_keeps_its_hand(suffix: str, tmp_path: Path) -> None:
    path = tmp_path / f"body.{suffix}"
    write_body(path, ball(), replace(ORIGIN, up="y"))
    seen, info = o3d.io.read_triangle_mesh(str(path)), json.loads(Path(f"{path}.json").read_text())
    assert suffix == "glb" or b"y up, floor at y = 0" in path.read_bytes()[:200]
    back = np.array(info["rig_from_file"])[:3, :3]
    assert back @ seen.get_center() == pytest.approx(ball().vertices.mean(axis=0), abs=0.5)
    assert seen.merge_close_vertices(1e-6).get_volume() > 0.0  # an STL has no indices


def test_in_the_body_frame_the_body_faces_x_over_the_origin(tmp_path: Path) -> None:
    """A flat upright body, turned by 30 degrees and put aside: in its own frame it stands straight."""
    flat = ball()
    straight = flat.vertices * [1.0, 3.0, 1.0]
    rig_from_body = RigidTransform.from_rotation_vector(
        [0.0, 0.0, np.radians(30.0)], [200.0, -90.0, 0.0]
    )
    rotated = replace(flat, vertices=rig_from_body.apply(straight))
    facts = {
        "subject": "S-0042",
        "calibration_id": "3f2a",
        "verdict": {"grade": "usable", "reasons": ["left out: p1-1: is missing"]},
        "failed": {"p1-1": "is missing"},
        "alignment": {"motion_mm": {"p1-2": 1.25}},
    }
    scan = StoredScan(points(), rotated, facts)
    written = export_scan(scan, tmp_path, ["ply", "glb"], frame="body")
    exported = read_ply_mesh(written[0])
    width, depth = np.ptp(exported.vertices[:, 1]), np.ptp(exported.vertices[:, 0])
    assert width == pytest.approx(np.ptp(straight[:, 1]), rel=1e-3)
    assert depth == pytest.approx(np.ptp(straight[:, 0]), rel=1e-3)
    assert np.abs(exported.vertices.mean(axis=0)[:2]).max() < 1e-3 * width
    info = json.loads((tmp_path / "body.ply.json").read_text())
    assert info["frame"] == "body"
    back = np.array(info["rig_from_frame"])
    np.testing.assert_allclose(
        exported.vertices @ back[:3, :3].T + back[:3, 3], rotated.vertices, atol=1e-6
    )
    as_in_glb = exported.vertices[:, [1, 2, 0]] / 1000.0  # left, up, front, in metres
    back = np.array(json.loads((tmp_path / "body.glb.json").read_text())["rig_from_file"])
    np.testing.assert_allclose(
        as_in_glb @ back[:3, :3].T + back[:3, 3], rotated.vertices, atol=1e-6
    )
    assert info["verdict"]["grade"] == "usable"
    assert info["left_out"] == {"p1-1": "is missing"}
    assert info["sway_mm"] == {"p1-2": 1.25}
    assert info["coverage"] == pytest.approx(1.0 - info["filled_area_mm2"] / info["area_mm2"])
    with pytest.raises(BadInput, match="'room' to export"):
        export_scan(scan, tmp_path, ["ply"], frame="room")
