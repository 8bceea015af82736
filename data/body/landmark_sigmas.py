"""Measure how well landmarks are found on bodies of random shape and pose: writes sigmas.json.

    PYTHONPATH=. /tmp/anny/bin/python data/body/landmark_sigmas.py

The bodies are posed with all of MakeHuman's bones; every other one has surface that the template's
shapes cannot make: bumps of 3.5 mm RMS over 70 mm and of 1 mm over 25 mm. Armpits, crotch, soles and
crown are not seen, and points have 0.3 mm of noise. Synthetic: people differ by more than bumps.
"""

from __future__ import annotations

import json
from pathlib import Path

import anny
import numpy as np
import torch
from make_template import sample_population, to_body, vertex_normals
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from bodyscan.body_model.fitting import Surface, fit_body
from bodyscan.body_model.template import load_template

Array = NDArray[np.float64]
TEMPLATE = load_template()
BODIES = 20


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


def add_bumps(vertices: Array, rng: np.random.Generator) -> Array:
    normals = vertex_normals(vertices, TEMPLATE.faces)
    for reach, height in ((70.0, 3.5), (25.0, 1.0)):
        centres = vertices[rng.integers(0, len(vertices), 120)]
        near = np.exp(-np.sum((vertices[:, None] - centres) ** 2, axis=2) / (2.0 * reach**2))
        bumps = near @ rng.normal(size=len(centres))
        vertices = vertices + (height * bumps / bumps.std())[:, None] * normals
    return vertices


def scan(vertices: Array, rng: np.random.Generator) -> Surface:
    """Noisy points of what cameras on poles see of a body."""
    a, b, c = (vertices[TEMPLATE.faces[:, k]] for k in range(3))
    across = np.cross(b - a, c - a)
    area = np.linalg.norm(across, axis=1) * ~TEMPLATE.hidden[TEMPLATE.faces].any(axis=1)
    face = rng.choice(len(area), 80_000, p=area / area.sum())
    u, v = rng.random((2, len(face), 1))
    u, v = np.where(u + v > 1.0, 1.0 - u, u), np.where(u + v > 1.0, 1.0 - v, v)
    points = a[face] + u * (b - a)[face] + v * (c - a)[face]
    normals = across[face] / np.linalg.norm(across[face], axis=1, keepdims=True)
    top = points[:, 2].max()
    seen = ~((normals[:, 2] < -0.6) & (points[:, 2] < 40.0))
    seen &= ~((normals[:, 2] > 0.85) & (points[:, 2] > top - 60.0))
    for name in ("left axilla", "right axilla", "crotch"):
        at = vertices[TEMPLATE.landmarks[name]]
        seen &= np.linalg.norm(points - at, axis=1) > 30.0
    points += normals * rng.normal(0.0, 0.3, (len(points), 1))
    return Surface(points[seen], normals[seen])


def main() -> None:
    torch.set_default_dtype(torch.float64)
    model = anny.Anny(local_changes="all", phenotypes="all")
    population = sample_population(model)
    basis, head_basis = to_body(model.blendshapes), to_body(model.bone_heads_blendshapes)
    rest, heads = to_body(model.template_vertices), to_body(model.template_bone_heads)
    kept = np.flatnonzero(np.isin(np.arange(len(rest)), model.faces.numpy()))[: len(TEMPLATE.parts)]
    at = list(TEMPLATE.landmarks.values())
    errors = []
    for seed in range(BODIES):
        rng = np.random.default_rng(seed)
        one, other = population[rng.integers(0, len(population), 2)]
        body = 0.5 * (one + other)
        shaped = rest + np.tensordot(body, basis, 1)
        joints = heads + np.tensordot(body, head_basis, 1)
        vertices = pose(model, shaped, joints, draw_pose(list(model.bone_labels), rng))[kept]
        vertices = add_bumps(vertices, rng) if seed % 2 else vertices
        vertices -= np.append(vertices[:, :2].mean(axis=0), vertices[:, 2].min())
        fitted = fit_body(TEMPLATE, scan(vertices, rng))
        errors.append(fitted.vertices[at] - vertices[at])
        distance = np.linalg.norm(errors[-1], axis=1)
        print(
            f"{seed}: median {np.median(distance):.1f}, 95 % {np.quantile(distance, 0.95):.1f} mm"
        )
    # Both sides together; a hand that found no fit in one body of twenty is no deviation.
    sides: dict[str, list[Array]] = {}
    for k, name in enumerate(TEMPLATE.landmarks):
        both = name.removeprefix("left ").removeprefix("right ")
        sides.setdefault(both, []).append(np.abs([error[k] for error in errors]).ravel())
    spread = {both: np.quantile(np.concatenate(some), 0.95) / 1.96 for both, some in sides.items()}
    sigmas = {
        name: round(float(spread[name.removeprefix("left ").removeprefix("right ")]), 1)
        for name in sorted(TEMPLATE.landmarks)
    }
    Path(__file__).with_name("sigmas.json").write_text(json.dumps(sigmas, indent=1) + "\n")
    distance = np.linalg.norm(errors, axis=2)
    print(f"all: median {np.median(distance):.1f}, 95 % {np.quantile(distance, 0.95):.1f} mm")


if __name__ == "__main__":
    main()
