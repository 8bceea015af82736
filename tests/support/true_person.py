"""How far a scan's cloud lies from the true person of BODYSCAN_PEOPLE (its README describes the files).

Reads the truth with numpy and scipy alone; nothing of bodyscan takes part. Lengths are mm, and points
are in the world frame of the truth unless said otherwise.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
HAIR = 2  # in `region`
GATE_MM = 10.0  # farther points are no error of the surface, but something else


@dataclass(frozen=True, eq=False)
class TruePerson:
    """vertices (V, 3) mm in the middle of the scan, faces (F, 3), and which vertices (V,) have hair."""

    vertices: Array
    faces: Indices
    hair: NDArray[np.bool_]


def load_person(folder: Path) -> TruePerson:
    """Read `truth/` of a person: the mesh at mean breath, moved to the middle of the scan."""
    meshes = np.load(folder / "truth" / "meshes.npz")
    motion = np.load(folder / "truth" / "motion.npz")
    faces = meshes["base_faces"].astype(np.int64)
    for _ in range(int(meshes["rounds"])):
        faces = subdivide(faces)
    still = meshes["neutral"].astype(float) + meshes["middle_um"] / 1000.0
    vertices = still @ motion["middle_R"].T + motion["middle_t"]
    return TruePerson(vertices, faces, meshes["region"] == HAIR)


def subdivide(faces: Indices) -> Indices:
    """Faces (4 F, 3) of one Loop subdivision: old vertices first, then one an edge, edges sorted."""
    ends = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    _, edge = np.unique(np.sort(ends, axis=1), axis=0, return_inverse=True)
    (a, b, c), (ab, bc, ca) = faces.T, faces.max() + 1 + edge.reshape(3, -1)
    corners = [(a, ab, ca), (b, bc, ab), (c, ca, bc), (ab, bc, ca)]
    return np.concatenate([np.stack(corner, axis=1) for corner in corners])


def bare_rms_mm(points: Array, person: TruePerson) -> float:
    """RMS distance of points (N, 3), rig frame, from the true surface where it has no hair.

    A person who sways has no one pose: the cloud is fitted rigidly to the truth first.
    """
    corners = person.vertices[person.faces]
    face_normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals = np.zeros_like(person.vertices)
    for corner in person.faces.T:
        np.add.at(normals, corner, face_normals)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    tree = cKDTree(person.vertices)
    for gate_mm in np.maximum(30.0 * 0.7 ** np.arange(30), 1.0):
        points = points + _step(points, person.vertices, normals, tree, gate_mm)
    distance, nearest = _distances(points, person, corners, face_normals, tree)
    kept = (distance < GATE_MM) & ~person.hair[nearest]
    assert kept.mean() > 0.5
    return float(np.sqrt(np.mean(distance[kept] ** 2)))


def _step(points: Array, vertices: Array, normals: Array, tree: cKDTree, gate_mm: float) -> Array:
    """Displacements (N, 3) of one rigid step, point to plane, with Tukey's weights."""
    nearest = np.asarray(tree.query(points)[1])
    normal = normals[nearest]
    offset = np.einsum("ij,ij->i", points - vertices[nearest], normal)
    near = np.abs(offset) < gate_mm
    weight = 1.0 - (offset[near] / gate_mm) ** 2
    middle = points[near].mean(axis=0)
    jacobian = np.hstack([np.cross(points[near] - middle, normal[near]), normal[near]])
    twist = np.linalg.lstsq(jacobian * weight[:, None], -offset[near] * weight, rcond=None)[0]
    turned = Rotation.from_rotvec(twist[:3]).apply(points - middle)
    return np.asarray(turned + middle + twist[3:] - points)


def _distances(
    points: Array, person: TruePerson, corners: Array, face_normals: Array, tree: cKDTree
) -> tuple[Array, Indices]:
    """Distance (N,) of each point from the faces around its two nearest vertices, and the nearest."""
    order = np.argsort(person.faces.ravel(), kind="stable")
    faces_at, count = order // 3, np.bincount(person.faces.ravel(), minlength=len(person.vertices))
    first = np.concatenate([[0], np.cumsum(count)])
    nearest = np.asarray(tree.query(points, k=2)[1])
    square = np.full(len(points), np.inf)
    for vertex in nearest.T:
        for k in range(int(count.max())):
            has = np.flatnonzero(count[vertex] > k)
            face = faces_at[first[vertex[has]] + k]
            closest = _closest_on_faces(points[has], corners[face], face_normals[face])
            square[has] = np.minimum(square[has], np.sum((points[has] - closest) ** 2, axis=1))
    return np.sqrt(square), nearest[:, 0]


def _closest_on_faces(points: Array, corners: Array, normals: Array) -> Array:
    """The point (N, 3) of each triangle (N, 3, 3) that is closest to each point (N, 3)."""
    unit = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    height = np.einsum("ij,ij->i", points - corners[:, 0], unit)
    foot = points - height[:, None] * unit
    inside, best, on_edge = np.ones(len(points), bool), np.full(len(points), np.inf), foot.copy()
    for k in range(3):
        start, side = corners[:, k], corners[:, (k + 1) % 3] - corners[:, k]
        inside &= np.einsum("ij,ij->i", np.cross(side, foot - start), normals) >= 0.0
        length = np.maximum(np.einsum("ij,ij->i", side, side), 1e-12)
        share = np.clip(np.einsum("ij,ij->i", points - start, side) / length, 0.0, 1.0)
        candidate = start + share[:, None] * side
        square = np.sum((points - candidate) ** 2, axis=1)
        closer = square < best
        best[closer], on_edge[closer] = square[closer], candidate[closer]
    return np.where(inside[:, None], foot, on_edge)
