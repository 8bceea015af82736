"""A closed mesh from a body cloud: screened Poisson, then what it filled is marked."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import open3d as o3d
from scipy.spatial import cKDTree

from bodyscan.arrays import Array, Indices, Mask
from bodyscan.errors import ScanFailed
from bodyscan.fusion.carving import poisson_hints
from bodyscan.fusion.support import fit_to_points, support
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.mesh.body import BodyCloud, BodyMesh
from bodyscan.mesh.repair import largest_piece
from bodyscan.mesh.topology import (
    topology,
    vertex_normals,
)
from bodyscan.progress import THREADS
from bodyscan.reconstruction.range_image import RangeImage
from bodyscan.settings import MeshSettings

FEWEST_POINTS = 1000
ROUGH_POINTS = 100_000


def mesh(
    cloud: BodyCloud,
    settings: MeshSettings,
    range_images: Sequence[RangeImage] = (),
    rig_from_camera: dict[str, RigidTransform] | None = None,
    *,
    workers: int = THREADS,
) -> BodyMesh:
    """One closed manifold surface around a cloud, faces outward.

    range_images: as measured, background and all (not cleaned); with them, gaps that cameras saw
    through are not webbed over. A vertex farther than `settings.reach_mm` from every point was
    measured by nobody. Raises ScanFailed if no closed surface comes out.
    """
    if len(cloud.points) < FEWEST_POINTS:
        raise ScanFailed(
            f"a cloud of {len(cloud.points)} points is too small for a mesh",
            remedy="Look at the range images; is the subject inside the scan volume?",
        )
    # Balancing would cost more than the few queries gain.
    tree = cKDTree(cloud.points, balanced_tree=False, compact_nodes=False)
    points, normals = cloud.points, cloud.normals.astype(np.float64)
    some = slice(None, None, max(1, len(points) // ROUGH_POINTS))
    rough = largest_piece(*poisson(points[some], normals[some], settings.depth - 1, linear=True))
    made_up = _filled_faces(*rough, tree, 2.0 * settings.reach_mm)
    extra = poisson_hints(
        *rough, made_up, tree, range_images, rig_from_camera or {}, workers=workers
    )
    points, normals = np.concatenate([points, extra[0]]), np.concatenate([normals, extra[1]])
    vertices, faces = largest_piece(*poisson(points, normals, settings.depth, linear=True))
    found = topology(vertices, faces)
    if not found.manifold:
        raise ScanFailed(f"no closed surface came out of the cloud ({found})")
    return attach_attributes(vertices, faces, cloud, tree, settings.reach_mm)


def poisson(
    points: Array, normals: Array, depth: int, *, linear: bool = False
) -> tuple[Array, Indices]:
    """Vertices and faces of Open3D's screened Poisson surface (Kazhdan and Hoppe 2013).

    linear: vertices are interpolated linearly along the octree's edges, which takes a tenth less
    time and is a few hundredths of a millimetre less exact.
    """
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
    cloud.normals = o3d.utility.Vector3dVector(normals)
    # More threads would add up in another order each time: other bytes for the same input.
    surface, _ = o3d.geometry.TriangleMesh.create_from_point_cloud_poisson(
        cloud, depth=depth, linear_fit=linear, n_threads=1
    )
    return np.asarray(surface.vertices), np.asarray(surface.triangles).astype(np.int64)


def attach_attributes(
    vertices: Array, faces: Indices, cloud: BodyCloud, tree: cKDTree, reach_mm: float
) -> BodyMesh:
    """Brought onto the points, with normals, the points' colours and sigmas, and what was filled.

    Poisson's surface is smoother than the points are exact; vertices move along their normals to
    where the points around say, less the farther these are.
    """
    normals = vertex_normals(vertices, faces)
    around = support(vertices, normals, cloud, tree, reach_mm)
    vertices = fit_to_points(vertices, faces, normals, around)
    sigma_mm = np.where(around.measured, around.sigma_mm, np.float32(np.nan))
    return BodyMesh(
        vertices,
        faces,
        vertex_normals(vertices, faces),
        cloud.colours[around.nearest],
        sigma_mm,
        np.any(np.isnan(sigma_mm)[faces], axis=1),
    )


def _filled_faces(vertices: Array, faces: Indices, tree: cKDTree, reach_mm: float) -> Mask:
    """(F,) faces with a corner that no point lies near."""
    distance = np.asarray(tree.query(vertices, distance_upper_bound=reach_mm, workers=THREADS)[0])
    return np.any(np.isinf(distance)[faces], axis=1)
