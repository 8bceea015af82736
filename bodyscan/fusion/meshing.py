"""A closed mesh from a cloud: signed distances on a grid, their zero set, filled faces marked."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from bodyscan.arrays import Array, Floats, Indices
from bodyscan.errors import ScanFailed
from bodyscan.fusion.hole_filling import fill_distances
from bodyscan.fusion.signed_distances import (
    find_crossed_bricks,
    find_near_bricks,
    interpolate_distances,
    splat_planes,
)
from bodyscan.fusion.support import fit_to_points, measure_support
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.mesh.body import BodyCloud, BodyMesh, select_regions
from bodyscan.mesh.repair import extract_largest_piece
from bodyscan.mesh.surface_nets import SIDE, Bricks, extract_surface
from bodyscan.mesh.topology import check_manifold, compute_topology, compute_vertex_normals
from bodyscan.reconstruction.range_image import RangeImage
from bodyscan.settings import MeshSettings


def make_closed_surface(
    cloud: BodyCloud,
    settings: MeshSettings,
    range_images: Sequence[RangeImage] = (),
    rig_from_camera: dict[str, RigidTransform] | None = None,
) -> tuple[Array, Indices]:
    """One closed manifold surface around a cloud, with faces outward: vertices (V, 3) mm, only as
    exact as the grid, and faces (F, 3). `require_closed` checks that it is one.

    range_images: as measured, background included; gaps that they see through are not webbed over.

    Raises ScanFailed if no surface comes out.
    """
    if len(cloud.points) < 1000:
        raise ScanFailed(
            f"a cloud of {len(cloud.points)} points is too small for a mesh",
            remedy="Look at the range images; is the subject inside the scan volume?",
        )
    cell_mm, poses = settings.cell_mm, rig_from_camera or {}
    bricks, distances = compute_distances(cloud, cell_mm, range_images, poses)
    vertices, faces = extract_surface(bricks, distances)
    if not len(faces):
        raise ScanFailed("no surface could be extracted: the points are inconsistent")
    some = cloud.points[:: -(-len(cloud.points) // 20_000)]
    return extract_largest_piece(vertices, faces, some)


def require_closed(vertices: Array, faces: Indices) -> None:
    """Raise ScanFailed unless a surface is a closed manifold."""
    if not check_manifold(faces, len(vertices))[1]:
        found = compute_topology(vertices, faces)
        raise ScanFailed(f"no closed surface came out of the cloud ({found})")


def compute_distances(
    cloud: BodyCloud,
    cell_mm: float,
    range_images: Sequence[RangeImage],
    rig_from_camera: dict[str, RigidTransform],
) -> tuple[Bricks, Floats]:
    """Compute signed distances (mm) of a closed surface at the nodes of a sparse grid around it:
    from the cloud where it is near, from `hole_filling` elsewhere, blended in between."""
    coarse = fill_distances(cloud, cell_mm, range_images, rig_from_camera)
    extent = coarse.cell_mm * np.array(coarse.values.shape)
    shape = tuple(np.ceil(extent / cell_mm / SIDE).astype(int))
    occupied = find_near_bricks(cloud.points, coarse.origin, cell_mm, shape)
    occupied |= find_crossed_bricks(coarse, cell_mm, shape)
    bricks = Bricks.from_mask(occupied, coarse.origin, cell_mm)
    measured, weight = splat_planes(cloud, bricks)
    filled, blend = interpolate_distances(coarse, bricks), np.float32(0.1)
    return bricks, (weight * measured + blend * filled) / (weight + blend)


def attach_attributes(
    vertices: Array, faces: Indices, cloud: BodyCloud, reach_mm: float
) -> BodyMesh:
    """Fit the mesh to the points, along its normals, and attach normals, the points' attributes
    and what was filled: vertices farther than `reach_mm` from every point were not measured."""
    normals = compute_vertex_normals(vertices, faces)
    around = measure_support(vertices, normals, cloud, reach_mm)
    vertices = fit_to_points(vertices, faces, normals, around)
    sigma_mm = np.where(around.measured, around.sigma_mm, np.float32(np.nan))
    return BodyMesh(
        vertices,
        faces,
        compute_vertex_normals(vertices, faces),
        cloud.colours[around.nearest],
        sigma_mm,
        np.any(np.isnan(sigma_mm)[faces], axis=1),
        regions=select_regions(cloud.regions, np.where(around.measured, around.nearest, -1)),
    )
