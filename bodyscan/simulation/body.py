"""The subject: a mesh with skin, hair and clothes."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import open3d as o3d

from bodyscan.arrays import Array, Mask
from bodyscan.files.atomic import atomic_replacement
from bodyscan.mesh.surface_file import read_surface
from bodyscan.simulation.scene import Surface
from bodyscan.simulation.settings import Person, Skin

MATT = Skin()  # all over, and lets no light in


def load_subject(
    path: Path, person: Person, rng: np.random.Generator, covered_by: Skin = MATT
) -> Surface:
    """Load a subject's PLY (metres, z up, facing -y) as a smooth surface, rig frame, mm.

    The mesh is read by `read_surface`, subdivided by Loop's rule, turned to face +x and centred over
    the rig's origin. The surface returned is itself the truth.
    covered_by: skin, hair and cloth.

    Raises BadInput for what is no surface, or in another unit or axis.
    """
    points, faces = read_surface(path, "metres").value
    mesh = o3d.geometry.TriangleMesh(
        o3d.utility.Vector3dVector(points), o3d.utility.Vector3iVector(faces.astype(np.int32))
    )
    # It warns of each unsound edge, of which `read_surface` tells.
    with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
        mesh = mesh.subdivide_loop(person.subdivisions)
    mesh.compute_vertex_normals()
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    vertices = np.asarray(mesh.vertices) @ turn.T * (1000.0 * person.size)
    middle = 0.5 * (vertices.min(axis=0) + vertices.max(axis=0))
    vertices -= [middle[0], middle[1], vertices[:, 2].min()]
    bare = Surface(
        vertices,
        np.asarray(mesh.triangles).astype(np.int64),
        albedo=person.skin
        * (1.0 + person.skin_variation * sum_waves(vertices, 60.0, 400.0, rng) / 4.0),
        normals=np.asarray(mesh.vertex_normals) @ turn.T,
    )
    return dress(bare, covered_by, rng)


def save_truth(surface: Surface, path: Path) -> None:
    """Write a binary PLY, mm, rig frame, with vertex normals."""
    mesh = o3d.geometry.TriangleMesh(
        o3d.utility.Vector3dVector(surface.vertices),
        o3d.utility.Vector3iVector(surface.triangles.astype(np.int32)),
    )
    if surface.normals is not None:
        mesh.vertex_normals = o3d.utility.Vector3dVector(surface.normals)
    with atomic_replacement(path) as temporary:
        o3d.io.write_triangle_mesh(str(temporary), mesh, write_ascii=False)


def dress(bare: Surface, skin: Skin, rng: np.random.Generator) -> Surface:
    """Cover a surface as `skin` says. Hair is rough: its surface is the truth as well."""
    vertices, albedo = bare.vertices.copy(), np.array(bare.albedo, float)
    if skin.mottling > 0:
        albedo *= 1.0 + skin.mottling * sum_waves(vertices, 8.0, 40.0, rng) / 2.0
    for centre in rng.integers(len(vertices), size=skin.moles):
        away = np.linalg.norm(vertices - vertices[centre], axis=1)
        albedo[away < rng.uniform(1.5, 5.0)] *= 0.45  # vertices are 3 mm apart
    lets_in = np.ones(len(vertices))
    if skin.shorts > 0:
        cloth = mask_shorts(vertices)
        albedo[cloth], lets_in[cloth] = skin.shorts, 0.0
    if skin.hair > 0 and bare.normals is not None:
        hair = mask_hair(vertices)
        albedo[hair], lets_in[hair] = skin.hair, 0.0
        rough = skin.hair_mm * np.abs(rng.standard_normal((int(hair.sum()), 1)))
        vertices[hair] += rough * bare.normals[hair]
    has_effect = skin.spread_mm > 0 or skin.gloss > 0
    return replace(bare, vertices=vertices, albedo=albedo, skin=lets_in if has_effect else None)


def sum_waves(
    vertices: Array, shortest_mm: float, longest_mm: float, rng: np.random.Generator
) -> Array:
    """Sum eight waves in random directions at vertices (N, 3): (N,), standard deviation 2."""
    waves = np.zeros(len(vertices))
    for length in np.geomspace(shortest_mm, longest_mm, 8):
        direction = rng.standard_normal(3)
        phase = vertices @ (direction / np.linalg.norm(direction)) * (2.0 * np.pi / length)
        waves += np.cos(phase + rng.uniform(0.0, 2.0 * np.pi))
    return waves


def mask_hair(vertices: Array) -> Mask:
    """Find vertices (N,) on the scalp: above a line that rises from the nape to the forehead."""
    height = float(vertices[:, 2].max())
    head = vertices[:, 2] > 0.885 * height  # the nape
    middle = 0.5 * (vertices[head, 0].min() + vertices[head, 0].max())
    line = 0.945 * height + 0.5 * (vertices[:, 0] - middle)
    return head & (vertices[:, 2] > line)


def mask_shorts(vertices: Array) -> Mask:
    """Find vertices (N,) from above the knees to the waist; hands hang farther out."""
    z, y = vertices[:, 2] / vertices[:, 2].max(), vertices[:, 1] / vertices[:, 2].max()
    return (z > 0.41) & (z < 0.565) & (np.abs(y) < 0.15)
