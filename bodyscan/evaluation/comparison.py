"""Compare a scan with another scan or a known surface, as they stand and fitted."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import open3d as o3d

from bodyscan.arrays import Array, Indices
from bodyscan.errors import BadInput
from bodyscan.evaluation.surface import Deviation, deviation, signed_distances
from bodyscan.fusion.scan_facts import FILE_NAME
from bodyscan.fusion.storage import load_scan
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.mesh.body import BodyMesh
from bodyscan.mesh.nearest_surface import build_centred_scene

SAMPLE = 30_000
REACHES_MM = (40.0, 10.0, 3.0)
"""Search radius, round after round."""
ROUNDS = 3
"""Of laying onto the faces, which starts within a tenth of a millimetre: the first nearly does it."""
LIKE_A_BODY = (0.2, 5.0)
"""Ratios of size outside this range mean another subject, or that not both are in mm."""


@dataclass(frozen=True, eq=False)
class Comparison:
    """Signed distances of a scan from another surface.

    name: of the other.
    is_scan: whether the other is a scan rather than a known surface.
    vertices: numbers of the mesh's measured vertices, (N,).
    signed_mm: their distances, positive outside the other surface, (N,).
    figures: statistics of the distances.
    fitted: whether the scan was first fitted to the other, by `other_from_scan`.
    """

    name: str
    is_scan: bool
    vertices: Indices
    signed_mm: Array
    figures: Deviation
    fitted: bool
    other_from_scan: RigidTransform


def compare_surfaces(mesh: BodyMesh, other: Path) -> list[Comparison]:
    """Compare the mesh's measured part with `other`, a scan's folder or a PLY in mm, rig frame.

    First as they stand, then with the scan fitted to the other as a whole. Raises ResultError or
    BadInput if `other` cannot be read, or cannot be the same subject.
    """
    vertices, faces = _surface(other)
    share = np.ptp(mesh.vertices, axis=0).max() / max(float(np.ptp(vertices, axis=0).max()), 1e-9)
    if not LIKE_A_BODY[0] < share < LIKE_A_BODY[1]:
        raise BadInput(
            f"is {1.0 / share:.3g} times as large as the scan",
            where=str(other),
            remedy="give a surface of the same subject, in millimetres",
        )
    measured = np.unique(mesh.faces[~mesh.filled])
    points = mesh.vertices[measured]
    laid = fit_to_surface(points, vertices, faces)
    return [
        Comparison(
            _name(other), _is_scan(other), measured, signed, deviation(signed), fitted, place
        )
        for place, fitted in ((RigidTransform.identity(), False), (laid, True))
        for signed in (signed_distances(place.apply(points), vertices, faces),)
    ]


def fit_to_surface(points: Array, vertices: Array, faces: Indices) -> RigidTransform:
    """`other_from_scan`: the rigid motion that brings points (N, 3) nearest to a mesh.

    Point to plane (Chen and Medioni 1992) with Tukey's weights, in Open3D; then onto the faces.
    """
    middle = vertices.mean(axis=0)
    target = o3d.geometry.TriangleMesh(
        o3d.utility.Vector3dVector(vertices - middle),
        o3d.utility.Vector3iVector(faces.astype(np.int32)),
    )
    target.compute_vertex_normals()
    known = o3d.geometry.PointCloud(target.vertices)
    known.normals = target.vertex_normals
    some = points[:: max(1, len(points) // SAMPLE)] - middle
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(some))
    icp = o3d.pipelines.registration
    motion = np.eye(4)
    for reach in REACHES_MM:
        loss = icp.TransformationEstimationPointToPlane(icp.TukeyLoss(0.5 * reach))
        motion = icp.registration_icp(cloud, known, reach, motion, loss).transformation
    rough = RigidTransform.from_matrix(motion)
    found = _laid_on_faces(rough, some, vertices - middle, faces)
    return (
        RigidTransform.from_translation(middle) @ found @ RigidTransform.from_translation(-middle)
    )


def _laid_on_faces(
    start: RigidTransform, points: Array, vertices: Array, faces: Indices
) -> RigidTransform:
    """`other_from_scan` that starts as `start`, improved by the nearest points of the faces.

    A corner's tangent plane lies outside a round surface. Of points all around the errors cancel;
    those of one pair would be drawn a few hundredths of a millimetre towards it.
    """
    scene, centre = build_centred_scene(vertices, faces)
    found = RigidTransform.from_translation(-centre) @ start
    for _ in range(ROUNDS):
        placed = found.apply(points)
        nearest = scene.compute_closest_points(o3d.core.Tensor(placed.astype(np.float32)))
        normals = nearest["primitive_normals"].numpy().astype(np.float64)
        off = np.sum((placed - nearest["points"].numpy()) * normals, axis=1)
        weight = np.maximum(1.0 - (off / (0.5 * REACHES_MM[-1])) ** 2, 0.0)  # Tukey's, its root
        jacobian = np.hstack([np.cross(placed, normals), normals]) * weight[:, None]
        found = found.retract(np.linalg.lstsq(jacobian, -weight * off, rcond=None)[0])
    return RigidTransform.from_translation(centre) @ found


def _is_scan(path: Path) -> bool:
    return path.is_dir() or path.name == FILE_NAME


def _name(path: Path) -> str:
    """`truth/subject.ply`, but `scan` for a scan's folder."""
    whole = path.resolve()
    if path.name == FILE_NAME:
        return whole.parent.name
    return whole.name if path.is_dir() else f"{whole.parent.name}/{whole.name}"


def _surface(path: Path) -> tuple[Array, Indices]:
    """Vertices (V, 3) mm and faces (F, 3)."""
    if _is_scan(path):
        mesh = load_scan(path if path.is_dir() else path.parent).mesh
        return mesh.vertices, mesh.faces
    read = o3d.io.read_triangle_mesh(str(path)) if path.is_file() else o3d.geometry.TriangleMesh()
    if not read.has_triangles():
        raise BadInput(
            "no surface can be read here",
            where=str(path),
            remedy="give a scan's folder, or a PLY with faces, in mm",
        )
    return np.asarray(read.vertices), np.asarray(read.triangles).astype(np.int64)
