"""glTF 2.0 in one binary file (GLB): metres, y up, front towards +z, as its standard says."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bodyscan.arrays import Bytes, Indices
from bodyscan.export.formats import BodyFormat
from bodyscan.files.atomic import atomic_replacement
from bodyscan.mesh.body import BodyCloud, BodyMesh


def write_glb(path: Path, body: BodyCloud | BodyMesh) -> None:
    """Write a mesh or a cloud. A mesh's vertices carry `_FILLED`, 1 where nothing was measured; all
    carry `_REGION`, an index into `REGION_NAMES`, if it is known."""
    points = body.points if isinstance(body, BodyCloud) else body.vertices
    attributes = {
        "POSITION": _y_up(points) / 1000.0,
        "NORMAL": _y_up(body.normals),
        "COLOR_0": _linear(body.colours),
    }
    if body.regions is not None:
        attributes["_REGION"] = body.regions
    indices = None
    if isinstance(body, BodyMesh):
        attributes["_FILLED"] = np.isnan(body.sigma_mm)
        indices = body.faces
    document, chunks = _document(attributes, indices)
    text = json.dumps(document, separators=(",", ":")).encode("ascii")
    text += b" " * (-len(text) % 4)
    size = sum(map(len, chunks))
    with atomic_replacement(Path(path)) as temporary, temporary.open("wb") as stream:
        stream.write(struct.pack("<4sII", b"glTF", 2, 12 + 8 + len(text) + 8 + size))
        stream.write(struct.pack("<I4s", len(text), b"JSON") + text)
        stream.write(struct.pack("<I4s", size, b"BIN\0"))
        for chunk in chunks:
            stream.write(chunk)


def _y_up(vectors: NDArray[np.floating]) -> NDArray[np.floating]:
    """Rotate vectors (N, 3) from the rig frame (x front, y left, z up) to glTF's (left, up, front)."""
    return vectors[:, [1, 2, 0]]


def _linear(colours: Bytes) -> NDArray[np.uint16]:
    """Convert sRGB bytes (N, 3) to linear shorts (N, 4) with alpha, glTF's vertex colours."""
    encoded = np.arange(256) / 255.0
    linear = np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)
    table = np.rint(65535.0 * linear).astype(np.uint16)
    return np.concatenate([table[colours], np.full((len(colours), 1), 65535, np.uint16)], axis=1)


def _document(
    attributes: dict[str, NDArray[Any]], indices: Indices | None
) -> tuple[dict[str, Any], list[bytes]]:
    """Build the JSON part and the chunks of the binary part (each a multiple of four bytes)."""
    accessors: list[dict[str, Any]] = []
    views: list[dict[str, Any]] = []
    chunks: list[bytes] = []

    def add(values: NDArray[Any], kind: str, *, is_index: bool = False, **extra: Any) -> int:
        data = values.tobytes()
        views.append({
            "buffer": 0,
            "byteOffset": sum(map(len, chunks)),
            "byteLength": len(data),
            "target": 34963 if is_index else 34962,  # ELEMENT_ARRAY_BUFFER, ARRAY_BUFFER
        })  # fmt: skip
        accessors.append({
            "bufferView": len(views) - 1,
            # FLOAT, UNSIGNED_SHORT, UNSIGNED_INT
            "componentType": {"f4": 5126, "u2": 5123, "u4": 5125}[values.dtype.str[1:]],
            "count": len(values) if kind != "SCALAR" else values.size,
            "type": kind,
            **extra,
        })  # fmt: skip
        chunks.append(data)
        return len(accessors) - 1

    numbers = {}
    for name, values in attributes.items():
        if name == "COLOR_0":
            numbers[name] = add(values.astype("<u2"), "VEC4", normalized=True)
            continue
        floats = values.astype("<f4")
        ends = {}
        if name == "POSITION":
            ends = {"min": floats.min(axis=0).tolist(), "max": floats.max(axis=0).tolist()}
        numbers[name] = add(floats, "SCALAR" if floats.ndim == 1 else "VEC3", **ends)
    primitive: dict[str, Any] = {"attributes": numbers, "material": 0, "mode": 0}  # POINTS
    if indices is not None:
        primitive["mode"] = 4  # TRIANGLES
        primitive["indices"] = add(indices.astype("<u4").ravel(), "SCALAR", is_index=True)
    surface = {"metallicFactor": 0.0, "roughnessFactor": 0.9}
    document = {
        "asset": {"version": "2.0", "generator": "bodyscan"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "name": "body"}],
        "meshes": [{"primitives": [primitive], "name": "body"}],
        "materials": [{"name": "body", "pbrMetallicRoughness": surface}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": sum(map(len, chunks))}],
    }
    return document, chunks


FORMAT = BodyFormat(
    write_glb,
    holds=frozenset({"mesh", "cloud", "colours", "normals", "filled", "regions"}),
    unit="m",
    axes=("left", "up", "front"),
)
