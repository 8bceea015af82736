"""A texture as other programs show it, and what it must not show."""

from __future__ import annotations

import base64
import json
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import open3d as o3d
import pytest
from browser import browser_page, find_browser
from required import missing
from small_bodies import ball

from bodyscan.arrays import Array, Bytes
from bodyscan.errors import BadInput
from bodyscan.export.body_file import Provenance, write_body
from bodyscan.export.scan import export_scan
from bodyscan.export.texture import Texture, make_texture
from bodyscan.fusion.storage import StoredScan
from bodyscan.jobs.forgetting import find_subject
from bodyscan.mesh.body import BodyCloud, BodyMesh

pytest.importorskip("xatlas")
trimesh = pytest.importorskip("trimesh")

SIZE = 512
TOLERANCE = 14.0
"""Levels. Colours change by 2.5 a mm at most, points lie 3 mm apart, pixels 1.2 mm; colours in linear
light would be off by up to 60."""


def paint(positions: Array) -> Array:
    """Smooth colours (N, 3) from 60 to 220 over a ball of 240 mm."""
    return 140.0 + 80.0 * np.sin(positions / [40.0, 50.0, 60.0])


def sprinkle(mesh: BodyMesh) -> tuple[Array, Bytes]:
    """Points on a ball and their colours."""
    ways = np.random.default_rng(0).normal(size=(20_000, 3))
    points = mesh.vertices.mean(axis=0) + 120.0 * ways / np.linalg.norm(ways, axis=1)[:, None]
    return points, np.rint(paint(points)).astype(np.uint8)


@pytest.fixture(scope="module")
def texture() -> Texture:
    mesh = ball()
    return make_texture(mesh.vertices, mesh.faces, *sprinkle(mesh), SIZE, rest=mesh.vertices)


def sample(image: Any, uv: Any) -> Array:
    """Colours (N, 3) of an image at places (N, 2) in it, from the top left."""
    at = (uv * image.shape[:2][::-1] - 0.5).astype(np.float32)
    found = cv2.remap(image, at[None], None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(found[0, :, :3], float)


def test_every_face_keeps_its_vertices_and_no_seam_shows(texture: Texture) -> None:
    np.testing.assert_array_equal(texture.vertex[texture.faces], ball().faces)
    assert len(texture.vertex) > len(ball().vertices)  # there are seams
    expected = paint(ball().vertices[texture.vertex])
    assert np.abs(sample(texture.image, texture.uv) - expected).max() < TOLERANCE
    middles = ball().vertices[ball().faces].mean(axis=1)
    found = sample(texture.image, texture.uv[texture.faces].mean(axis=1))
    assert np.abs(found - paint(middles)).max() < TOLERANCE


@pytest.mark.parametrize("suffix", ["glb", "obj"])
def test_programs_show_the_same_colours(texture: Texture, suffix: str, tmp_path: Path) -> None:
    path = tmp_path / f"body.{suffix}"
    write_body(path, ball(), Provenance("S-0042", "3f2a"), texture)
    seen: Any = trimesh.load(path, force="mesh", process=False)
    material, uv = seen.visual.material, seen.visual.uv * [1.0, -1.0] + [0.0, 1.0]
    image = np.asarray(material.image if suffix == "obj" else material.baseColorTexture)
    assert len(seen.faces) == len(texture.faces)
    found = sample(image, uv)
    assert np.abs(found - paint(in_rig(np.asarray(seen.vertices), suffix))).max() < TOLERANCE
    other = o3d.io.read_triangle_mesh(str(path))
    corners = np.asarray(other.vertices)[np.asarray(other.triangles).ravel()]
    image = np.asarray(other.textures[np.asarray(other.triangle_material_ids)[0]])
    found = sample(image, np.asarray(other.triangle_uvs))
    assert np.abs(found - paint(in_rig(corners, suffix))).max() < TOLERANCE


def in_rig(positions: Array, suffix: str) -> Array:
    """Positions (N, 3) as a file has them, in the rig frame, mm."""
    return positions if suffix == "obj" else 1000.0 * positions[:, [2, 0, 1]]


def test_a_browser_shows_the_image_inside_a_glb(texture: Texture, tmp_path: Path) -> None:
    executable = find_browser() or missing("no chromium here (apt-get install chromium)")
    write_body(tmp_path / "body.glb", ball(), Provenance(None, "3f2a"), texture)
    data = base64.b64encode((tmp_path / "body.glb").read_bytes()).decode()
    script = f"""(async () => {{
        const bytes = Uint8Array.from(atob("{data}"), (letter) => letter.charCodeAt(0));
        const size = new DataView(bytes.buffer).getUint32(12, true);
        const content = JSON.parse(new TextDecoder().decode(bytes.subarray(20, 20 + size)));
        const view = content.bufferViews[content.images[0].bufferView];
        const png = bytes.slice(28 + size + view.byteOffset).slice(0, view.byteLength);
        const image = await createImageBitmap(new Blob([png], {{type: content.images[0].mimeType}}));
        const canvas = new OffscreenCanvas(image.width, image.height).getContext("2d");
        canvas.drawImage(image, 0, 0);
        return [...canvas.getImageData(0, 200, image.width, 1).data];
    }})()"""
    with browser_page(executable, tmp_path / "profile") as page:
        answer = page.call(
            "Runtime.evaluate", expression=script, awaitPromise=True, returnByValue=True
        )
    row = np.array(answer["result"]["value"], np.uint8).reshape(-1, 4)[:, :3]
    np.testing.assert_array_equal(row, texture.image[200])


@pytest.mark.parametrize("frame", ["rig", "body"])
def test_a_scan_with_a_texture(frame: str, tmp_path: Path) -> None:
    points, colours = sprinkle(ball())
    flat = np.zeros(len(points), np.float32)
    normals = np.zeros_like(points, np.float32)
    cloud = BodyCloud(points, normals, flat, colours, flat.astype(np.uint8))
    scan = StoredScan(cloud, ball(), {"subject": "S-0042", "calibration_id": "3f2a"})
    chosen = ["stl", "obj", "glb"]
    written = export_scan(scan, tmp_path, chosen, ["textured"], texture_px=SIZE, frame=frame)
    assert [path.name for path in written] == ["body-textured.obj", "body-textured.glb"]
    info = json.loads((tmp_path / "body-textured.obj.json").read_text())
    assert (info["texture_px"], info["subject"], info["frame"]) == (SIZE, "S-0042", frame)
    names = {path.name for path in tmp_path.iterdir()}
    assert set(info["companions"]) == {"body-textured.mtl", "body-textured.png"} <= names
    assert find_subject("S-0042", tmp_path).unnamed == {}
    back = np.array(info["rig_from_file"])
    seen: Any = trimesh.load(written[0], process=False)
    places = np.asarray(seen.vertices) @ back[:3, :3].T + back[:3, 3]
    image = cv2.imread(str(tmp_path / "body-textured.png"))[..., ::-1]
    found = sample(image, seen.visual.uv * [1.0, -1.0] + [0.0, 1.0])
    assert np.abs(found - paint(places)).max() < TOLERANCE
    with pytest.raises(BadInput, match="stl holds no texture"):
        export_scan(scan, tmp_path, ["stl"], ["textured"])


def test_without_the_library_it_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "xatlas", None)
    with pytest.raises(BadInput, match=r"bodyscan\[texture\]"):
        make_texture(
            np.zeros((3, 3)), np.zeros((0, 3), int), *sprinkle(ball()), SIZE, rest=np.eye(3)
        )
