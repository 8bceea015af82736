"""A parametric body: mean shape, shape basis, skeleton, skinning weights, parts and landmarks.

The data are MakeHuman's (CC0), reduced by `data/body/make_template.py`; `data/body/README.md` says how.
Shapes are the principal components of a population of both sexes, from small children to old age, each
scaled to one standard deviation, so that their coefficients are unit normal.

Frame of the template: mm, z up, x forward, y to the left, the floor at z = 0 for the mean shape.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from importlib import resources
from io import BytesIO

import numpy as np
from scipy.spatial.transform import Rotation

from bodyscan.arrays import Array, Bytes, Indices, Mask


@dataclass(frozen=True, eq=False)
class BodyTemplate:
    """A body with V vertices, F faces, K shapes and J joints, mm."""

    vertices: Array  # (V, 3), the mean shape in the rest pose
    faces: Indices  # (F, 3), outward
    shapes: Array  # (K, V, 3) float32, displacements of one standard deviation
    joints: Array  # (J, 3), the first is the root
    joint_shapes: Array  # (K, J, 3), their displacements
    parents: Indices  # (J,), -1 for the root; parents come before their children
    joint_names: tuple[str, ...]
    weights: Array  # (V, J), how much of each joint's motion a vertex follows; rows sum to 1
    parts: Bytes  # (V,) uint8, index into part_names
    part_names: tuple[str, ...]
    landmarks: Mapping[str, int]  # vertex of each landmark, by name
    # (L,), of each landmark's position along an axis: the 95 % quantile of the error, over 1.96, on
    # 18 simulated bodies half of which have surface that the shapes cannot make.
    landmark_sigma_mm: Array
    hidden: Mask  # (V,) bool, inside the mouth and the nostrils, which no camera sees

    @property
    def descendants(self) -> Array:
        """(J, J) bool: [j, k] whether joint k moves with joint j (itself included)."""
        moves = np.eye(len(self.parents), dtype=bool)
        for joint, parent in enumerate(self.parents):
            if parent >= 0:
                moves[:, joint] |= moves[:, parent]
        return moves


@dataclass(frozen=True, eq=False)
class BodyShapeAndPose:
    """Parameters of a template's body."""

    shape: Array  # (K,), in standard deviations
    # (J, 3), rotation vectors of the joints relative to their parents, rest axes, rad.
    rotations: Array
    root: Array  # (3,), position of the first joint, mm, body frame

    def add_step(self, step: Array) -> BodyShapeAndPose:
        """Add a step (3 + 3 J + K,): of the root, right increments of the rotations, the shape."""
        turns = step[3 : 3 + self.rotations.size].reshape(-1, 3)
        rotated = Rotation.from_rotvec(self.rotations) * Rotation.from_rotvec(turns)
        shape = self.shape + step[3 + self.rotations.size :]
        return BodyShapeAndPose(shape, rotated.as_rotvec(), self.root + step[:3])


@dataclass(frozen=True, eq=False)
class PosedBody:
    """A template's body in a pose."""

    vertices: Array  # (V, 3), mm
    rotations: Array  # (J, 3, 3) of the posed bones, body frame
    joints: Array  # (J, 3) mm


def drop_side(name: str) -> str:
    """The name of a joint or landmark without the side that it begins with."""
    return name.removeprefix("left ").removeprefix("right ")


def pose_body(template: BodyTemplate, body: BodyShapeAndPose) -> PosedBody:
    """Shape and pose a template by linear blend skinning."""
    shaped = template.vertices + np.tensordot(body.shape, template.shapes, axes=1)
    rest = template.joints + np.tensordot(body.shape, template.joint_shapes, axes=1)
    local = Rotation.from_rotvec(body.rotations).as_matrix()
    rotated, placed = np.empty_like(local), np.empty_like(rest)
    for joint, parent in enumerate(template.parents):
        if parent < 0:
            rotated[joint], placed[joint] = local[joint], body.root
        else:
            rotated[joint] = rotated[parent] @ local[joint]
            placed[joint] = placed[parent] + rotated[parent] @ (rest[joint] - rest[parent])
    offsets = placed - np.einsum("jab,jb->ja", rotated, rest)
    blended = np.einsum("vj,jab->vab", template.weights, rotated)
    return PosedBody(
        np.einsum("vab,vb->va", blended, shaped) + template.weights @ offsets, rotated, placed
    )


@cache
def load_template() -> BodyTemplate:
    """Read the template that the package brings."""
    data = np.load(
        BytesIO(resources.files("bodyscan.body_model").joinpath("template.npz").read_bytes())
    )
    shapes = data["shapes"].astype(np.float32) * data["shape_scales"][:, None, None]
    return BodyTemplate(
        data["vertices"],
        data["faces"].astype(np.int64),
        shapes,
        data["joints"],
        data["joint_shapes"],
        data["parents"],
        tuple(data["joint_names"].tolist()),
        data["weights"] / data["weights"].sum(axis=1, keepdims=True),
        data["parts"],
        tuple(data["part_names"].tolist()),
        dict(zip(data["landmark_names"].tolist(), data["landmark_vertices"].tolist(), strict=True)),
        data["landmark_sigma_mm"],
        data["hidden"],
    )
