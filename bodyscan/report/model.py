"""Meshes and lines packed compactly for the report's viewer (viewer.js): integers, base64."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bodyscan.arrays import Array, Bytes
from bodyscan.mesh.body import BodyCloud, BodyMesh
from bodyscan.mesh.body_frame import find_body_frame

Legend = dict[str, Any]


@dataclass(frozen=True, eq=False)
class Layer:
    """One way to colour a mesh: colours (V, 3) red, green, blue, and what they mean."""

    name: str
    colours: Bytes
    legend: Legend | None = None
    unlit: bool = False


@dataclass(frozen=True, eq=False)
class Strokes:
    """Straight lines: ends (L, 2, 3) mm, colours (L, 3) red, green, blue."""

    ends: Array
    colours: Bytes


def pack(
    shape: BodyMesh | BodyCloud | None,
    layers: Sequence[Layer] = (),
    *,
    strokes: Strokes | None = None,
    labels: Sequence[tuple[str, Array]] = (),
    view_deg: tuple[float, float] | None = None,
) -> dict[str, Any]:
    """Pack a model for `viewer.js`: a mesh, or points that are drawn as squares.

    view_deg: where the viewer stands at first: azimuth from x towards y, and elevation. None: before
        a body, a little to its left.

    A coordinate is `low + step * integer`, in steps of 1/65,535 of the longest side. Raises
    ValueError for a mesh of more than 65,536 vertices.
    """
    vertices: Array | None = None
    if shape is not None:
        vertices = shape.points if isinstance(shape, BodyCloud) else shape.vertices
    if vertices is not None and len(vertices) > 65_536:
        raise ValueError(f"{len(vertices)} vertices; 16-bit indices address 65,536")
    if view_deg is None:
        x, y, _ = (np.eye(3) if vertices is None else find_body_frame(vertices).view_axes)[:, 0]
        view_deg = (25.0 + float(np.degrees(np.arctan2(y, x))), 6.0)
    coordinates = [vertices] if vertices is not None else []
    coordinates += [strokes.ends.reshape(-1, 3)] if strokes is not None else []
    everything = np.concatenate(coordinates)
    low, high = everything.min(axis=0), everything.max(axis=0)
    step = float((high - low).max()) / 65_535 or 1.0

    def whole(points: Array) -> str:
        return encode(np.rint((points - low) / step).astype("<u2"))

    packed: dict[str, Any] = {
        "low": low.tolist(),
        "step": step,
        "layers": [{"name": "", "colours": "", "legend": None, "unlit": False}],
        "lines": None,
        "faces": None,
        "labels": [[text, *map(float, np.round(at, 1))] for text, at in labels],
        "view": {
            "azimuth": float(np.radians(view_deg[0])),
            "elevation": float(np.radians(view_deg[1])),
            "target": (0.5 * (low + high)).tolist(),
            "size": float(np.linalg.norm(high - low)),
        },
    }
    if shape is not None and vertices is not None:
        normals = np.clip(np.rint(127 * np.nan_to_num(shape.normals)), -127, 127)
        packed |= {"positions": whole(vertices), "normals": encode(normals.astype(np.int8))}
    if isinstance(shape, BodyMesh):
        packed["faces"] = encode(shape.faces.astype("<u2"))
    if layers:
        packed["layers"] = [asdict(layer) | {"colours": encode(layer.colours)} for layer in layers]
    if strokes is not None:
        packed["lines"] = {
            "positions": whole(strokes.ends.reshape(-1, 3)),
            "colours": encode(np.repeat(strokes.colours, 2, axis=0)),
        }
    return packed


def pack_cloud(cloud: BodyCloud) -> dict[str, Any]:
    """Pack a coarse cloud, of 25,000 points at most, as photographed."""
    few = cloud.subsample(-(-len(cloud.points) // 25_000))
    return pack(few, [Layer("photo", few.colours)])


def encode(array: NDArray[Any]) -> str:
    return base64.b64encode(np.ascontiguousarray(array).tobytes()).decode("ascii")


def format_css(colour: Sequence[int] | Bytes) -> str:
    return "#{:02x}{:02x}{:02x}".format(*(int(part) for part in colour))
