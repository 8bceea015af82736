"""A registered body as other programs read it: skin, skeleton, parts, landmarks."""

from __future__ import annotations

import json
import re
import runpy
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from made_registered import TEMPLATE, hide, make_body, register_exactly
from scipy.spatial.transform import Rotation

from bodyscan.arrays import Array
from bodyscan.body_model.skinned import SkinnedBody, make_skinned
from bodyscan.export.body_file import Provenance, write_body
from bodyscan.export.texture import make_texture
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.measurement.landmarks import find_landmarks

FRAME = RigidTransform.from_rotation_vector([0.0, 0.0, 0.7], [30.0, -50.0, 0.0])
TYPES = {5121: "<u1", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
SIZES = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}


@pytest.fixture(scope="module")
def body() -> SkinnedBody:
    registered = register_exactly(*make_body(3))
    hidden = TEMPLATE.parts == TEMPLATE.part_names.index("left hand")
    registered = hide(registered, hidden)
    found = find_landmarks(registered).values()
    landmarks = [(one.name, np.array(one.position_mm), one.sigma_mm, one.found) for one in found]
    return make_skinned(registered, landmarks, FRAME)


def read_glb(path: Path) -> tuple[dict[str, Any], list[Array]]:
    """The JSON part, and every accessor's numbers."""
    data = path.read_bytes()
    size = int.from_bytes(data[12:16], "little")
    content = json.loads(data[20 : 20 + size])
    arrays = []
    for accessor in content["accessors"]:
        start = 28 + size + content["bufferViews"][accessor["bufferView"]]["byteOffset"]
        columns = SIZES[accessor["type"]]
        kind, count = TYPES[accessor["componentType"]], columns * accessor["count"]
        arrays.append(np.frombuffer(data, kind, count, start).reshape(-1, columns))
    return content, arrays


def world_matrices(nodes: list[dict[str, Any]]) -> Array:
    """World transform (N, 4, 4) of every node."""
    world = np.tile(np.eye(4), (len(nodes), 1, 1))
    for number, node in enumerate(nodes):
        local = np.eye(4)
        local[:3, 3] = node.get("translation", [0.0, 0.0, 0.0])
        local[:3, :3] = Rotation.from_quat(node.get("rotation", [0.0, 0.0, 0.0, 1.0])).as_matrix()
        world[number] = world[number] @ local
        for child in node.get("children", ()):  # parents come first
            world[child] = world[number]
    return world


def test_skinning_a_glb_gives_the_person_as_they_stood(body: SkinnedBody, tmp_path: Path) -> None:
    write_body(tmp_path / "body.glb", body, Provenance("s-17", "0" * 64))
    content, arrays = read_glb(tmp_path / "body.glb")
    [primitive] = content["meshes"][0]["primitives"]
    values = {name: arrays[number] for name, number in primitive["attributes"].items()}
    [skin] = content["skins"]
    world = world_matrices(content["nodes"])
    inverse = arrays[skin["inverseBindMatrices"]].reshape(-1, 4, 4).transpose(0, 2, 1)
    matrices = world[skin["joints"]] @ inverse
    rest = np.column_stack([values["POSITION"], np.ones(len(values["POSITION"]))])
    each = np.einsum("vkab,vb->vka", matrices[values["JOINTS_0"]], rest)
    posed = np.einsum("vk,vka->va", values["WEIGHTS_0"], each)[:, :3]
    assert 1000.0 * posed[:, [2, 0, 1]] == pytest.approx(body.mesh.vertices, abs=1e-2)
    assert np.linalg.norm(1000.0 * rest[:, [2, 0, 1]] - body.mesh.vertices, axis=1).max() > 100.0
    placed = {node["name"]: world[number] for number, node in enumerate(content["nodes"])}
    assert len(body.landmarks) == 63
    for landmark in body.landmarks:
        at = 1000.0 * placed[landmark.name][[2, 0, 1], 3]
        assert at == pytest.approx(landmark.position, abs=1e-2)
    assert (values["_FILLED"][:, 0] == 1.0).sum() == np.isnan(body.mesh.sigma_mm).sum() > 100
    names = content["meshes"][0]["extras"]["parts"]
    assert [names[int(part)] for part in values["_PART"][::500, 0]] == [
        TEMPLATE.part_names[part] for part in TEMPLATE.parts[::500]
    ]
    for sampler in content["animations"][0]["samplers"]:
        first, middle, last = arrays[sampler["output"]]
        assert np.array_equal(first, last)
        assert middle.tolist() == [0.0, 0.0, 0.0, 1.0]


def test_an_obj_has_groups_by_part_and_landmarks(body: SkinnedBody, tmp_path: Path) -> None:
    write_body(tmp_path / "body.obj", body, Provenance(None, "0" * 64))
    sizes: dict[str, int] = {}
    group = ""
    for line in (tmp_path / "body.obj").read_text().splitlines():
        group = line[2:] if line.startswith("g ") else group
        sizes[group] = sizes.get(group, 0) + line.startswith(("f ", "p "))
    parts = {name.replace(" ", "_"): k for k, name in enumerate(TEMPLATE.part_names)}
    for name, part in parts.items():
        assert sizes[name] == (body.face_parts == part).sum() > 50
    assert all(sizes[one.name.replace(" ", "_")] == 1 for one in body.landmarks)


def test_the_example_averages_people_in_one_pose(tmp_path: Path) -> None:
    for seed in (1, 2):
        skinned = make_skinned(register_exactly(*make_body(seed)), [], FRAME)
        write_body(tmp_path / str(seed) / "body-registered.glb", skinned, Provenance(None, ""))
    example = runpy.run_path(str(Path(__file__).parents[2] / "examples" / "mean_body.py"))
    example["main"](tmp_path, tmp_path / "mean.npz")
    bodies = [make_body(seed, bumps_mm=0.0)[1] for seed in (1, 2)]
    mean = TEMPLATE.vertices + np.tensordot(0.5 * sum(bodies), TEMPLATE.shapes, axes=1)
    found = np.load(tmp_path / "mean.npz")["mean"][:, [2, 0, 1]]
    # Bumps of 3 mm RMS are not in the shapes.
    assert np.sqrt(np.mean(np.sum((found - mean) ** 2, axis=1))) < 4.0


def test_a_registered_body_with_a_texture(body: SkinnedBody, tmp_path: Path) -> None:
    """Its atlas is the template's; split vertices keep their weights, and faces their groups."""
    pytest.importorskip("xatlas")
    mesh = body.mesh
    source = mesh.vertices, mesh.faces, mesh.vertices, mesh.colours
    texture = make_texture(*source, 256, rest=TEMPLATE.vertices)
    np.testing.assert_array_equal(texture.vertex[texture.faces], TEMPLATE.faces)
    found = []
    for name, shown in (("plain", None), ("textured", texture)):
        write_body(tmp_path / f"{name}.glb", body, Provenance(None, "3f2a"), shown)
        write_body(tmp_path / f"{name}.obj", body, Provenance(None, "3f2a"), shown)
        content, arrays = read_glb(tmp_path / f"{name}.glb")
        (primitive,) = content["meshes"][0]["primitives"]
        found.append({key: arrays[at] for key, at in primitive["attributes"].items()})
    plain, textured = found
    np.testing.assert_array_equal(textured.pop("TEXCOORD_0"), texture.uv)
    assert textured.keys() == plain.keys() - {"COLOR_0"}
    for key, values in textured.items():
        np.testing.assert_array_equal(values, plain[key][texture.vertex])
    lines, others = (
        (tmp_path / f"{n}.obj").read_text().splitlines() for n in ("plain", "textured")
    )
    faces = [re.sub(r"/\d+/", "//", line) for line in others if line[0] in "gf"]
    assert faces == [line for line in lines if line[0] in "gf"]
    places = np.array([re.findall(r"/(\d+)/", line) for line in others if line[0] == "f"], int) - 1
    assert set(map(tuple, places.tolist())) == set(map(tuple, texture.faces.tolist()))
