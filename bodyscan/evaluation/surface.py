"""Distances of points from a known surface, and comparison of a scan with another surface."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from bodyscan.arrays import Array, Indices, Mask
from bodyscan.files.messages import translate_failure
from bodyscan.fusion.storage import FILE_NAME, load_scan
from bodyscan.geometry.robust import rms
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.mesh.body import BodyMesh
from bodyscan.mesh.surface_file import read_surface
from bodyscan.mesh.topology import compute_face_normals, find_twins
from bodyscan.outcome import Outcome


@dataclass(frozen=True)
class Deviation:
    """Statistics of signed distances (outside is positive), mm."""

    count: int
    bias_mm: float
    median_mm: float  # of the absolute distances
    rms_mm: float
    p95_mm: float  # of the absolute distances
    worst_mm: float


def compute_signed_distances(points: Array, vertices: Array, faces: Indices) -> Array:
    """Distances (N,) mm of points (N, 3) from a closed triangle mesh, positive outside it.

    The sign is that of the angle-weighted pseudo-normal at the nearest spot (Baerentzen, Aanaes 2005).
    """
    scene, centre = _build_centred_scene(vertices, faces)
    centred = (points - centre).astype(np.float32)
    nearest = scene.compute_closest_points(centred)
    offset = centred.astype(np.float64) - nearest["points"].numpy()
    distance = np.linalg.norm(offset, axis=-1)
    face = nearest["primitive_ids"].numpy().astype(np.int64)
    u, v = nearest["primitive_uvs"].numpy().astype(np.float64).T
    normals = _compute_pseudo_normals(vertices, faces, face, np.stack([1.0 - u - v, u, v], axis=-1))
    return np.where(np.einsum("nc,nc->n", offset, normals) >= 0, distance, -distance)


def _compute_pseudo_normals(
    vertices: Array, faces: Indices, face: Indices, barycentric: Array
) -> Array:
    """(N, 3): normals, of any length, at spots on faces: the face's, or its edge's or corner's."""
    corners = vertices[faces]
    sides = np.roll(corners, -1, axis=1) - corners  # side k runs from corner k to the next
    cross = compute_face_normals(vertices, faces)
    unit = cross / np.maximum(np.linalg.norm(cross, axis=-1, keepdims=True), 1e-300)
    normals = unit[face]
    low = barycentric < 1e-5  # in float32
    on_side = low[:, [2, 0, 1]]  # side k lies opposite corner k + 2
    spot, side = np.nonzero(on_side & (low.sum(axis=1, keepdims=True) == 1))
    twin = find_twins(faces, len(vertices))[face[spot], side]
    normals[spot] += unit[np.where(twin < 0, face[spot], twin // 3)]
    spot = np.flatnonzero(low.sum(axis=1) >= 2)
    corner = faces[face[spot], np.argmax(barycentric[spot], axis=1)]
    # Of a corner: the sum of the normals around it, weighted by the faces' angles there.
    along = sides / np.maximum(np.linalg.norm(sides, axis=-1, keepdims=True), 1e-300)
    cosine = -np.einsum("fkc,fkc->fk", along, np.roll(along, 1, axis=1))
    weighted = np.arccos(cosine.clip(-1.0, 1.0))[..., None] * unit[:, None]
    for axis, values in enumerate(weighted.reshape(-1, 3).T):
        normals[spot, axis] = np.bincount(faces.ravel(), values, len(vertices))[corner]
    return normals


def summarize_deviation(signed_mm: Array) -> Deviation:
    """Bias, median, RMS, 95th percentile and worst of signed distances (N,)."""
    size, bias, rms_mm = np.abs(signed_mm), float(np.mean(signed_mm)), rms(signed_mm)
    median, p95, worst = float(np.median(size)), float(np.percentile(size, 95)), float(size.max())
    return Deviation(len(signed_mm), bias, median, rms_mm, p95, worst)


def normalize_errors(signed_mm: Array, sigma_mm: NDArray[np.floating[Any]]) -> tuple[float, float]:
    """Robust sigma of errors over their sigmas (1 if these are right), and the share beyond
    three (0.003 if Gaussian)."""
    over = np.abs(signed_mm / sigma_mm)
    return float(np.median(over) / 0.6745), float(np.mean(over > 3.0))


def find_covered_spots(
    points: Array, spots: Array, normals: Array, within_mm: float = 1.0, spacing_mm: float = 2.0
) -> Mask:
    """Which spots (N, 3) of a surface with normals (N, 3) are covered by points (M, 3), (N,).

    A spot is covered if a point lies within `within_mm` along the surface's normal and, sideways,
    within `spacing_mm`, since even a perfect cloud has gaps between its points.
    """
    distance, index = cKDTree(points).query(spots, k=4, distance_upper_bound=spacing_mm + within_mm)
    found = np.isfinite(distance)
    offset = points[np.where(found, index, 0)] - spots[:, None]
    along = np.einsum("nkc,nc->nk", offset, normals)
    sideways = np.sqrt(np.maximum(np.sum(offset**2, axis=-1) - along**2, 0.0))
    close = found & (np.abs(along) < within_mm) & (sideways < spacing_mm)
    return np.asarray(close.any(axis=1))


def sample_surface(
    vertices: Array, faces: Indices, count: int, seed: int = 0
) -> tuple[Array, Array]:
    """Random points (N, 3) on a mesh, uniform in area, and the normals (N, 3) of their faces."""
    rng = np.random.default_rng(seed)
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    cross = compute_face_normals(vertices, faces)
    area = np.linalg.norm(cross, axis=-1)
    chosen = rng.choice(len(faces), count, p=area / area.sum())
    root, t = np.sqrt(rng.random((count, 1))), rng.random((count, 1))
    points = (1 - root) * a[chosen] + root * (1 - t) * b[chosen] + root * t * c[chosen]
    return points, cross[chosen] / area[chosen, None]


@dataclass(frozen=True, eq=False)
class Comparison:
    """Signed distances of a scan from another surface.

    name: of the other.
    is_scan: whether the other is a scan rather than a known surface.
    vertices: numbers of the mesh's measured vertices, (N,).
    signed_mm: their distances, positive outside the other surface, (N,).
    figures: statistics of the distances.
    fitted: whether the scan was first fitted to the other, by `other_from_scan`.
    notes: what the other was taken as, and whether it can be compared.
    """

    name: str
    is_scan: bool
    vertices: Indices
    signed_mm: Array
    figures: Deviation
    fitted: bool
    other_from_scan: RigidTransform
    notes: tuple[str, ...] = ()


def compare_surfaces(mesh: BodyMesh, other: Path | BodyMesh) -> list[Comparison]:
    """Compare the mesh's measured part with `other`: a mesh, a scan's folder, a PLY in mm.

    First as they stand, then with the scan fitted to the other as a whole. Raises ResultError or
    BadInput if `other` cannot be read, or cannot be the same subject.
    """
    name, is_scan, read = _read_other(other, np.ptp(mesh.vertices, axis=0))
    vertices, faces = read.value
    measured = np.unique(mesh.faces[~mesh.filled])
    points = mesh.vertices[measured]

    def lay(pose: RigidTransform, *, fitted: bool = True) -> Comparison:
        signed = compute_signed_distances(pose.apply(points), vertices, faces)
        return Comparison(
            name, is_scan, measured, signed, summarize_deviation(signed), fitted, pose
        )

    standing = lay(RigidTransform.identity(), fitted=False)
    moved, notes = lay(fit_to_surface(points, vertices, faces)), read.notes
    if moved.figures.median_mm > 20.0:  # beyond which the fit gives no weight to begin with
        middle = sample_surface(vertices, faces, 10_000)[0].mean(axis=0)
        step = RigidTransform.from_translation(middle - points.mean(axis=0))
        again = lay(fit_to_surface(step.apply(points), vertices, faces) @ step)
        moved = min(moved, again, key=lambda one: one.figures.median_mm)
    if moved.figures.median_mm > 20.0:
        notes += (
            f"{name}: even fitted, half of the scan lies {moved.figures.median_mm:,.0f} mm or more "
            "from it: it is of another person or pose, faces another way, or another axis is up",
        )
    return [replace(standing, notes=notes), replace(moved, notes=notes)]


def fit_to_surface(points: Array, vertices: Array, faces: Indices) -> RigidTransform:
    """Fit points (N, 3) to a mesh by a rigid motion, `other_from_scan`.

    Point to plane (Chen and Medioni 1992) with Tukey's weights, onto the nearest points of the faces:
    a corner's tangent plane lies outside a round surface.
    """
    scene, centre = _build_centred_scene(vertices, faces)
    some = points[:: max(1, len(points) // 10_000)]
    found = RigidTransform.from_translation(-centre)
    for reach in [40.0] * 10 + [10.0] * 4 + [3.0] * 4:  # mm
        moved = found.apply(some)
        nearest = scene.compute_closest_points(moved.astype(np.float32))
        normals = nearest["primitive_normals"].numpy().astype(np.float64)
        residual = np.sum((moved - nearest["points"].numpy()) * normals, axis=1)
        weight = np.maximum(1.0 - (residual / (0.5 * reach)) ** 2, 0.0)  # the root of Tukey's
        jacobian = np.hstack([np.cross(moved, normals), normals]) * weight[:, None]
        found = found.retract(np.linalg.lstsq(jacobian, -weight * residual, rcond=None)[0])
    return RigidTransform.from_translation(centre) @ found


def _read_other(
    other: Path | BodyMesh, sides_mm: Array
) -> tuple[str, bool, Outcome[tuple[Array, Indices]]]:
    """Read what a scan of sides (3,) is compared with: its name (`truth/subject.ply`, a scan's folder),
    whether it is a scan, its vertices (V, 3) mm and faces (F, 3). Raises BadInput for a surface whose
    longest side is not 0.2 to 5 times the scan's."""
    if isinstance(other, BodyMesh):
        return "the other", True, Outcome((other.vertices, other.faces))
    folder = other.parent if other.name == FILE_NAME else other
    whole = folder.resolve()
    if folder.is_dir():
        mesh = load_scan(folder).mesh
        return whole.name, True, Outcome((mesh.vertices, mesh.faces))
    size_mm = float(sides_mm.max())
    sizes_mm = (0.2 * size_mm, size_mm, 5.0 * size_mm)
    read = read_surface(other, "millimetres", sizes_mm, int(sides_mm.argmax()))
    return f"{whole.parent.name}/{whole.name}", False, read


def _build_centred_scene(vertices: Array, faces: Indices) -> tuple[Any, Array]:
    """Build a scene of vertices (V, 3) less their mean, as it is float32; also return the mean (3,)."""
    try:
        import open3d as o3d  # not for those who only read a report
    except ImportError as error:
        raise translate_failure(error) or error from error
    centre = vertices.mean(axis=0)
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles((vertices - centre).astype(np.float32), faces.astype(np.uint32))
    return scene, centre
