"""Bodies of random shape and pose from MakeHuman's data, and what cameras on poles would see of them.

Posed with all of MakeHuman's bones. Those "outside" have surface that the template's shapes cannot
make: bumps of 3.5 mm RMS over 70 mm and of 1 mm over 25 mm, one side fuller than the other, folds of
the belly, and hair on every other of them. Synthetic: people differ by more than this.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import anny
import numpy as np
import open3d as o3d
import torch
from make_template import sample_population, to_body, vertex_normals
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from bodyscan.body_model.registered import RegisteredBody
from bodyscan.body_model.template import load_template
from bodyscan.mesh.body import BodyMesh
from bodyscan.rig.rig import load_rig

Array = NDArray[np.float64]
TEMPLATE = load_template()
RIG = Path(__file__).parents[2] / "rigs" / "three-pole-12.yaml"
FIELD = (0.42, 0.34)
"""Tangents of half the fields of view, across and upwards, as the simulator's devices have."""


@dataclass(frozen=True, eq=False)
class RandomBody:
    """A true body.

    landmarks: (V, 3) mm, the template's vertices on it. vertices, faces: its smooth surface, finer.
    outside: whether it has surface that the template's shapes cannot make.
    """

    seed: int
    outside: bool
    landmarks: Array
    vertices: Array
    faces: NDArray[np.int64]


def draw_pose(bones: list[str], rng: np.random.Generator) -> Array:
    """Rotation vectors (B, 3): arms 5 to 40 degrees off the trunk, everything else a few degrees."""
    turns = np.zeros((len(bones), 3))

    def turn(
        bone: str, deviation: float, mean: tuple[float, float, float] = (0.0, 0.0, 0.0)
    ) -> None:
        degrees = np.add(mean, rng.normal(0.0, deviation, 3))
        turns[bones.index(bone)] = np.radians(degrees)

    for side, s in (("L", 1.0), ("R", -1.0)):
        turn(f"upperarm01.{side}", 5.0, (-s * rng.uniform(-5.0, 28.0), 0.0, 0.0))
        turn(f"lowerarm01.{side}", 6.0, (0.0, rng.uniform(-10.0, 35.0), 0.0))
        turn(f"upperleg01.{side}", 4.0, (-s * rng.uniform(0.0, 7.0), 0.0, 0.0))
        turn(f"clavicle.{side}", 4.0)
        turn(f"lowerleg01.{side}", 3.0)
        turn(f"wrist.{side}", 8.0)
    for bone in ("spine04", "spine02", "neck01", "head"):
        turn(bone, 4.0)
    return turns


def pose(model: anny.Anny, vertices: Array, heads: Array, turns: Array) -> Array:
    """Linear blend skinning with all bones."""
    local = Rotation.from_rotvec(turns).as_matrix()
    rotations, joints = np.empty_like(local), np.empty_like(heads)
    for bone, parent in enumerate(model.bone_parents):
        if parent < 0:
            rotations[bone], joints[bone] = local[bone], heads[bone]
        else:
            rotations[bone] = rotations[parent] @ local[bone]
            joints[bone] = joints[parent] + rotations[parent] @ (heads[bone] - heads[parent])
    weights, index = model.vertex_bone_weights.numpy(), model.vertex_bone_indices.numpy()
    weights = weights / weights.sum(axis=1, keepdims=True)
    offsets = joints - np.einsum("jab,jb->ja", rotations, heads)
    turned = np.einsum("vkab,vb->vka", rotations[index], vertices)
    return np.einsum("vk,vka->va", weights, turned + offsets[index])


def add_outside(vertices: Array, rng: np.random.Generator, hair: bool) -> Array:
    """Displace a body by what the template's shapes cannot make."""
    normals = vertex_normals(vertices, TEMPLATE.faces)
    for reach, height in ((70.0, 3.5), (25.0, 1.0)):
        centres = vertices[rng.integers(0, len(vertices), 120)]
        near = np.exp(-np.sum((vertices[:, None] - centres) ** 2, axis=2) / (2.0 * reach**2))
        bumps = near @ rng.normal(size=len(centres))
        vertices = vertices + (height * bumps / bumps.std())[:, None] * normals
    place = {name: vertices[at] for name, at in TEMPLATE.landmarks.items()}
    scale = place["vertex"][2] / 1700.0
    fuller = rng.normal(0.0, 2.0 * scale) * np.tanh((vertices[:, 1] - place["crotch"][1]) / 60.0)
    trunk = TEMPLATE.parts == TEMPLATE.part_names.index("trunk")
    belly = np.exp(-(((vertices[:, 2] - place["omphalion"][2]) / (90.0 * scale)) ** 2)) * trunk
    folds = rng.uniform(0.0, 4.0) * np.sin(2.0 * np.pi * vertices[:, 2] / (45.0 * scale)) * belly
    moved = fuller + folds * (normals[:, 0] > 0.0)
    if hair:
        head = TEMPLATE.parts == TEMPLATE.part_names.index("head")
        above = vertices[:, 2] - place["glabella"][2] - 25.0 * scale
        behind = place["glabella"][0] - 60.0 * scale - vertices[:, 0]
        covered = np.clip(np.maximum(above, behind) / 15.0, 0.0, 1.0) * head
        moved = moved + rng.uniform(5.0, 20.0) * covered
    return vertices + moved[:, None] * normals


def make_bodies(seeds: Sequence[int]) -> Iterator[RandomBody]:
    """Bodies by seed; those of odd seeds are outside the template's shapes."""
    torch.set_default_dtype(torch.float64)
    model = anny.Anny(local_changes="all", phenotypes="all")
    population = sample_population(model)
    basis, head_basis = to_body(model.blendshapes), to_body(model.bone_heads_blendshapes)
    rest, heads = to_body(model.template_vertices), to_body(model.template_bone_heads)
    kept = np.flatnonzero(np.isin(np.arange(len(rest)), model.faces.numpy()))[: len(TEMPLATE.parts)]
    for seed in seeds:
        rng = np.random.default_rng(seed)
        one, other = population[rng.integers(0, len(population), 2)]
        body = 0.5 * (one + other)
        shaped = rest + np.tensordot(body, basis, 1)
        joints = heads + np.tensordot(body, head_basis, 1)
        vertices = pose(model, shaped, joints, draw_pose(list(model.bone_labels), rng))[kept]
        outside = seed % 2 == 1
        vertices = add_outside(vertices, rng, hair=seed % 4 == 1) if outside else vertices
        vertices -= np.append(vertices[:, :2].mean(axis=0), vertices[:, 2].min())
        mesh = o3d.geometry.TriangleMesh(
            o3d.utility.Vector3dVector(vertices), o3d.utility.Vector3iVector(TEMPLATE.faces)
        ).subdivide_loop(2)
        fine, faces = np.asarray(mesh.vertices), np.asarray(mesh.triangles).astype(np.int64)
        yield RandomBody(seed, outside, fine[: len(vertices)], fine, faces)


def scan_body(body: RandomBody) -> BodyMesh:
    """The mesh of a scan: other vertices, 0.3 mm of noise over 20 mm, filled where three-pole-12 sees
    nothing."""
    rng = np.random.default_rng(body.seed + 10_000)
    mesh = o3d.geometry.TriangleMesh(
        o3d.utility.Vector3dVector(body.vertices), o3d.utility.Vector3iVector(body.faces)
    ).simplify_quadric_decimation(120_000)
    vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.triangles).astype(np.int64)
    normals = vertex_normals(vertices, faces)
    centres = vertices[rng.integers(0, len(vertices), 3000)]
    tree = o3d.core.nns.NearestNeighborSearch(o3d.core.Tensor(centres))
    tree.knn_index()
    found, _ = tree.knn_search(o3d.core.Tensor(vertices), 6)
    noise = rng.normal(0.0, 0.3, len(centres))[found.numpy()].mean(axis=1) * np.sqrt(6.0)
    seen = _find_seen(vertices, faces, normals)
    vertices = vertices + (noise * seen)[:, None] * normals
    return BodyMesh(
        vertices,
        faces,
        normals.astype(np.float32),
        np.full((len(vertices), 3), 128, np.uint8),
        np.where(seen, np.float32(0.3), np.float32(np.nan)),
        ~seen[faces].all(axis=1),
    )


def _find_seen(vertices: Array, faces: NDArray[np.int64], normals: Array) -> NDArray[np.bool_]:
    """Which vertices a camera and the projector beside it both see, less than 75 degrees off."""
    scene = o3d.t.geometry.RaycastingScene()
    corners = o3d.core.Tensor(faces.astype(np.uint32))
    scene.add_triangles(o3d.core.Tensor(vertices.astype(np.float32)), corners)
    seen = np.zeros(len(vertices), bool)
    for pair in load_rig(RIG).pairs:
        both = np.ones(len(vertices), bool)
        for device in (pair.nominal, pair.projector_nominal):
            to = np.array(device.position_mm) - vertices
            distance = np.linalg.norm(to, axis=1)
            forward = np.subtract(device.look_at_mm, device.position_mm)
            forward /= np.linalg.norm(forward)
            across = np.cross(forward, [0.0, 0.0, 1.0])
            across /= np.linalg.norm(across)
            depth = -to @ forward
            both &= np.abs(to @ across) < FIELD[0] * depth
            both &= np.abs(to @ np.cross(across, forward)) < FIELD[1] * depth
            both &= np.einsum("vi,vi->v", to, normals) > 0.26 * distance
            start = np.flatnonzero(both)
            rays = np.hstack([vertices + 1.0 * normals, to / distance[:, None]])[start]
            hit = scene.cast_rays(o3d.core.Tensor(rays.astype(np.float32)))["t_hit"].numpy()
            both[start] = np.isinf(hit)
        seen |= both
    return seen


def lay_truth(body: RandomBody, found: RegisteredBody) -> RegisteredBody:
    """The true body with the template exactly on it, in the body frame that a scan of it was given."""
    normals = vertex_normals(body.vertices, body.faces).astype(np.float32)
    count = len(body.vertices)
    colours, sigma = np.full((count, 3), 128, np.uint8), np.full(count, np.float32(1e-3))
    filled = np.zeros(len(body.faces), bool)
    mesh = BodyMesh(body.vertices, body.faces, normals, colours, sigma, filled)
    vertices = found.rig_from_body.inverse().apply(body.landmarks)
    fitted = replace(found.fitted, vertices=vertices, distance_mm=np.zeros(len(vertices)))
    return RegisteredBody(mesh, found.rig_from_body, fitted, np.zeros(count))
