"""glTF 2.0 in one binary file (GLB): metres, y up, front towards +z, as its standard says."""

from __future__ import annotations

import json
import struct
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from bodyscan.arrays import Array, Bytes, Indices
from bodyscan.body_model.skinned import SkinnedBody
from bodyscan.export.formats import BodyFormat
from bodyscan.export.texture import Texture
from bodyscan.files.atomic import atomic_replacement
from bodyscan.mesh.body import BodyCloud, BodyMesh
from bodyscan.mesh.topology import compute_vertex_normals


@dataclass(eq=False)
class _Buffer:
    """The binary part of a file as it grows: chunks of a multiple of four bytes, views, accessors."""

    chunks: list[bytes] = field(default_factory=list)
    views: list[dict[str, Any]] = field(default_factory=list)
    accessors: list[dict[str, Any]] = field(default_factory=list)

    def add(
        self, values: NDArray[Any], kind: str, *, target: int | None = 34962, **extra: Any
    ) -> int:
        """Add an accessor of that kind (SCALAR, VEC3, ...); returns its number.

        target: 34962 for vertices, 34963 for indices, None for what a graphics card does not hold.
        """
        view = self.add_view(values.tobytes(), **({} if target is None else {"target": target}))
        self.accessors.append({
            "bufferView": view,
            # FLOAT, UNSIGNED_BYTE, UNSIGNED_SHORT, UNSIGNED_INT
            "componentType": {"f4": 5126, "u1": 5121, "u2": 5123, "u4": 5125}[values.dtype.str[1:]],
            "count": len(values) if kind != "SCALAR" else values.size,
            "type": kind,
            **extra,
        })  # fmt: skip
        return len(self.accessors) - 1

    def add_view(self, data: bytes, **extra: Any) -> int:
        """Add bytes; returns the number of their view."""
        size = sum(map(len, self.chunks))
        self.views.append({"buffer": 0, "byteOffset": size, "byteLength": len(data), **extra})
        self.chunks.append(data + b"\0" * (-len(data) % 4))
        return len(self.views) - 1

    def write(self, path: Path, content: dict[str, Any]) -> None:
        """Write the file; content: scenes, nodes and meshes of the JSON part."""
        size = sum(map(len, self.chunks))
        document = content | {
            "asset": {"version": "2.0", "generator": "bodyscan"},
            "scene": 0,
            "accessors": self.accessors,
            "bufferViews": self.views,
            "buffers": [{"byteLength": size}],
        }
        text = json.dumps(document, separators=(",", ":")).encode("ascii")
        text += b" " * (-len(text) % 4)
        with atomic_replacement(Path(path)) as temporary, temporary.open("wb") as stream:
            stream.write(struct.pack("<4sII", b"glTF", 2, 12 + 8 + len(text) + 8 + size))
            stream.write(struct.pack("<I4s", len(text), b"JSON") + text)
            stream.write(struct.pack("<I4s", size, b"BIN\0"))
            for chunk in self.chunks:
                stream.write(chunk)


def write_glb(path: Path, body: BodyCloud | BodyMesh, texture: Texture | None = None) -> None:
    """Write a mesh or a cloud. A mesh's vertices carry `_FILLED`, 1 where nothing was measured; all
    carry `_REGION`, an index into `REGION_NAMES`, if it is known.

    texture: instead of vertex colours, which would multiply it.
    """
    points = body.points if isinstance(body, BodyCloud) else body.vertices
    attributes = {
        "POSITION": _turn_y_up(points) / 1000.0,
        "NORMAL": _turn_y_up(body.normals),
        "COLOR_0": _linearize_colours(body.colours),
    }
    if body.regions is not None:
        attributes["_REGION"] = body.regions
    indices = None
    if isinstance(body, BodyMesh):
        attributes["_FILLED"] = np.isnan(body.sigma_mm)
        indices = body.faces
    buffer = _Buffer()
    primitive = _add_primitive(buffer, attributes, indices, texture)
    meshes = [{"primitives": [primitive], "name": "body"}]
    nodes = [{"mesh": 0, "name": "body"}]
    content = {"scenes": [{"nodes": [0]}], "nodes": nodes, "meshes": meshes}
    buffer.write(path, content | _add_materials(buffer, texture))


def write_skinned_glb(path: Path, body: SkinnedBody, texture: Texture | None = None) -> None:
    """Write a registered body with its skeleton: the mesh in the rest pose, bones as the person stood,
    landmarks as nodes of the bones that carry them, and a clip to the rest pose and back.

    Vertices also carry `_PART`, an index into the mesh's `extras.parts`.
    """
    count = len(body.joint_names)
    four = np.argsort(-body.weights, axis=1, kind="stable")[:, :4]
    weights = np.take_along_axis(body.weights, four, axis=1).astype("<f4")
    buffer = _Buffer()
    attributes = {
        "POSITION": _turn_y_up(body.rest_vertices) / 1000.0,
        "NORMAL": _turn_y_up(compute_vertex_normals(body.rest_vertices, body.mesh.faces)),
        "COLOR_0": _linearize_colours(body.mesh.colours),
        "_FILLED": np.isnan(body.mesh.sigma_mm),
        "_PART": body.parts,
    }
    primitive = _add_primitive(buffer, attributes, body.mesh.faces, texture)
    at = slice(None) if texture is None else texture.vertex
    joints = np.where(weights > 0.0, four, 0).astype("u1")
    primitive["attributes"] |= {
        "JOINTS_0": buffer.add(joints[at], "VEC4"),
        "WEIGHTS_0": buffer.add(weights[at], "VEC4"),
    }
    inverse = np.tile(np.eye(4, dtype="<f4"), (count, 1, 1))
    inverse[:, 3, :3] = -_turn_y_up(body.rest_joints) / 1000.0  # matrices are stored by columns
    skin = {
        "joints": list(range(1, count + 1)),
        "inverseBindMatrices": buffer.add(inverse, "MAT4", target=None),
        "skeleton": 1,
    }
    mesh = {"primitives": [primitive], "name": "body", "extras": {"parts": list(body.part_names)}}
    nodes = [{"mesh": 0, "skin": 0, "name": "body"}, *_list_bones(body)]
    for landmark in body.landmarks:
        nodes[1 + landmark.joint].setdefault("children", []).append(len(nodes))
        place = _turn_y_up(landmark.offset[None])[0] / 1000.0
        extras = {"landmark": landmark.name, "sigma_mm": landmark.sigma_mm, "found": landmark.found}
        nodes.append({"name": landmark.name, "translation": place.tolist(), "extras": extras})
    buffer.write(path, {
        "scenes": [{"nodes": [0, 1]}],
        "nodes": nodes,
        "meshes": [mesh],
        "skins": [skin],
        "animations": [_make_clip(buffer, body)],
    } | _add_materials(buffer, texture))  # fmt: skip


def _list_bones(body: SkinnedBody) -> list[dict[str, Any]]:
    """A node for each joint: its place and rotation in its parent's frame, as the person stood."""
    bones: list[dict[str, Any]] = []
    for joint, parent in enumerate(body.parents):
        place = body.root if parent < 0 else body.rest_joints[joint] - body.rest_joints[parent]
        bones.append({
            "name": body.joint_names[joint],
            "translation": (_turn_y_up(place[None])[0] / 1000.0).tolist(),
            "rotation": _compute_quaternions(body.rotations[joint : joint + 1])[0].tolist(),
        })  # fmt: skip
        if parent >= 0:
            bones[parent].setdefault("children", []).append(joint + 1)
    return bones


def _make_clip(buffer: _Buffer, body: SkinnedBody) -> dict[str, Any]:
    """A clip of four seconds: every joint but the root turns to the rest pose and back."""
    times = np.array([0.0, 2.0, 4.0], "<f4")
    when = buffer.add(times, "SCALAR", target=None, min=[0.0], max=[4.0])
    samplers: list[dict[str, Any]] = []
    channels: list[dict[str, Any]] = []
    for joint in range(1, len(body.joint_names)):
        stood = body.rotations[joint]
        values = _compute_quaternions(np.stack([stood, np.zeros(3), stood])).astype("<f4")
        output = buffer.add(values, "VEC4", target=None)
        channels.append({
            "sampler": len(samplers), "target": {"node": joint + 1, "path": "rotation"},
        })  # fmt: skip
        samplers.append({"input": when, "output": output, "interpolation": "LINEAR"})
    return {"name": "rest pose", "samplers": samplers, "channels": channels}


def _compute_quaternions(rotations: Array) -> Array:
    """Quaternions (N, 4), x y z w, in glTF's axes, of rotation vectors (N, 3)."""
    return np.asarray(Rotation.from_rotvec(_turn_y_up(rotations)).as_quat())


def _turn_y_up(vectors: NDArray[np.floating]) -> NDArray[np.floating]:
    """Rotate vectors (N, 3) from the rig frame (x front, y left, z up) to glTF's (left, up, front)."""
    return vectors[:, [1, 2, 0]]


def _linearize_colours(colours: Bytes) -> NDArray[np.uint16]:
    """Convert sRGB bytes (N, 3) to linear shorts (N, 4) with alpha, glTF's vertex colours."""
    encoded = np.arange(256) / 255.0
    linear = np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)
    table = np.rint(65535.0 * linear).astype(np.uint16)
    return np.concatenate([table[colours], np.full((len(colours), 1), 65535, np.uint16)], axis=1)


def _add_materials(buffer: _Buffer, texture: Texture | None) -> dict[str, Any]:
    """The material of all primitives, and the image that it shows if there is one."""
    surface: dict[str, Any] = {"metallicFactor": 0.0, "roughnessFactor": 0.9}
    content: dict[str, Any] = {"materials": [{"name": "body", "pbrMetallicRoughness": surface}]}
    if texture is None:
        return content
    surface["baseColorTexture"] = {"index": 0}
    linear, mipmaps, clamp = 9729, 9987, 33071
    sampler = {"magFilter": linear, "minFilter": mipmaps, "wrapS": clamp, "wrapT": clamp}
    return content | {
        "textures": [{"sampler": 0, "source": 0}],
        "samplers": [sampler],
        "images": [{"bufferView": buffer.add_view(texture.png), "mimeType": "image/png"}],
    }


def _add_primitive(
    buffer: _Buffer,
    attributes: dict[str, NDArray[Any]],
    indices: Indices | None,
    texture: Texture | None,
) -> dict[str, Any]:
    """Add attributes, and triangles if there are any; returns the primitive that has them."""
    if texture is not None:
        attributes = {name: values[texture.vertex] for name, values in attributes.items()}
        del attributes["COLOR_0"]
        attributes["TEXCOORD_0"], indices = texture.uv, texture.faces
    numbers = {}
    for name, values in attributes.items():
        if name == "COLOR_0":
            numbers[name] = buffer.add(values.astype("<u2"), "VEC4", normalized=True)
            continue
        floats = values.astype("<f4")
        ends = {}
        if name == "POSITION":
            ends = {"min": floats.min(axis=0).tolist(), "max": floats.max(axis=0).tolist()}
        kind = "SCALAR" if floats.ndim == 1 else f"VEC{floats.shape[1]}"
        numbers[name] = buffer.add(floats, kind, **ends)
    primitive: dict[str, Any] = {"attributes": numbers, "material": 0, "mode": 0}  # POINTS
    if indices is not None:
        primitive["mode"] = 4  # TRIANGLES
        corners = indices.astype("<u4").ravel()
        primitive["indices"] = buffer.add(corners, "SCALAR", target=34963)
    return primitive


FORMAT = BodyFormat(
    write_glb,
    write_skinned=write_skinned_glb,
    holds=frozenset({"mesh", "cloud", "colours", "normals", "filled", "regions", "texture"}),
    unit="m",
    axes=("left", "up", "front"),
)
