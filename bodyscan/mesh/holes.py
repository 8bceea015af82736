"""Filled patches of a body mesh: how large they are, and where."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bodyscan.arrays import Array
from bodyscan.mesh.body import BodyMesh
from bodyscan.mesh.topology import face_areas, face_components, face_normals

WAYS = {
    "front": (1.0, 0.0, 0.0),
    "back": (-1.0, 0.0, 0.0),
    "left": (0.0, 1.0, 0.0),
    "right": (0.0, -1.0, 0.0),
    "up": (0.0, 0.0, 1.0),
    "down": (0.0, 0.0, -1.0),
}


@dataclass(frozen=True, eq=False)
class Hole:
    """area_mm2: of the faces that fill it. middle: (3,) mm,
    rig frame. faces: the direction it faces."""

    area_mm2: float
    middle: Array
    faces: str


def holes(mesh: BodyMesh) -> list[Hole]:
    """All filled patches, the largest first."""
    filled = mesh.faces[mesh.filled]
    if not len(filled):
        return []
    patch = np.unique(face_components(filled, len(mesh.vertices)), return_inverse=True)[1].ravel()
    count = int(patch.max()) + 1
    area = face_areas(mesh.vertices, filled)
    corners, normal = mesh.vertices[filled], face_normals(mesh.vertices, filled)
    total = np.bincount(patch, area, count)
    middle = _sums(patch, corners.mean(axis=1) * area[:, None], count) / total[:, None]
    facing = np.argmax(_sums(patch, normal, count) @ np.array(list(WAYS.values())).T, axis=1)
    ways = list(WAYS)
    return [
        Hole(float(total[k]), middle[k], ways[facing[k]]) for k in np.argsort(-total, kind="stable")
    ]


def _sums(group: NDArray[np.intp], values: Array, count: int) -> Array:
    """Sums (count, 3) of values (N, 3) by group."""
    return np.stack([np.bincount(group, values[:, k], count) for k in range(3)], axis=1)
