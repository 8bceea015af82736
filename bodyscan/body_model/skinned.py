"""A registered body with its skeleton, for programs that animate: mesh in the rest pose, bones."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from bodyscan.arrays import Array, Bytes, Indices
from bodyscan.body_model.registered import RegisteredBody, vote_on_faces
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.mesh.body import BodyMesh


@dataclass(frozen=True, eq=False)
class CarriedLandmark:
    """A landmark and the joint that carries it."""

    name: str
    position: Array  # (3,) mm, as the person stood
    sigma_mm: float
    found: str
    joint: int
    offset: Array  # (3,) mm, from the joint, in its frame


@dataclass(frozen=True, eq=False)
class SkinnedBody:
    """A registered body: `rest_vertices` skinned by `weights` are the vertices of `mesh`."""

    # As the person stood, in the template's topology; what was not measured is filled.
    mesh: BodyMesh
    rest_vertices: Array  # (V, 3) mm, in the rest pose
    rest_joints: Array  # (J, 3) mm
    weights: Array  # (V, J), at most four above 0
    joint_names: tuple[str, ...]
    parents: Indices
    rotations: Array  # (J, 3), rotation vectors relative to the parents
    root: Array  # (3,) mm, of the first joint
    parts: Bytes  # (V,) index into part_names
    part_names: tuple[str, ...]
    landmarks: tuple[CarriedLandmark, ...]

    @property
    def face_parts(self) -> Bytes:
        """Part (F,) of each face."""
        return vote_on_faces(self.parts[self.mesh.faces])


def make_skinned(
    body: RegisteredBody,
    landmarks: Iterable[tuple[str, Array, float, str]],
    frame_from_rig: RigidTransform,
) -> SkinnedBody:
    """Make the skinned body of a registered one, in another frame than the rig's.

    landmarks: name, position (3,) mm in the rig frame, sigma, and how it was found.
    """
    template = body.fitted.template
    fitted = body.fitted.transform(frame_from_rig @ body.rig_from_body)
    weights = _keep_four(template.weights)
    rotations = fitted.posed.rotations
    parents = np.where(template.parents < 0, 0, template.parents)
    local = np.einsum("jba,jbc->jac", rotations[parents], rotations)
    local[template.parents < 0] = rotations[template.parents < 0]
    carried = []
    for name, at, sigma_mm, found in landmarks:
        joint = int(weights[template.landmarks[name]].argmax())
        position = frame_from_rig.apply(at)
        offset = rotations[joint].T @ (position - fitted.posed.joints[joint])
        carried.append(CarriedLandmark(name, position, sigma_mm, found, joint, offset))
    return SkinnedBody(
        body.to_mesh(frame_from_rig),
        fitted.find_rest_vertices(weights),
        fitted.rest_joints,
        weights,
        template.joint_names,
        template.parents,
        Rotation.from_matrix(local).as_rotvec(),
        fitted.posed.joints[0],
        template.parts,
        template.part_names,
        tuple(carried),
    )


def _keep_four(weights: Array) -> Array:
    """Weights (V, J) with the four largest of each row alone, rows summing to 1: what glTF holds."""
    four = np.argsort(-weights, axis=1, kind="stable")[:, :4]
    kept = np.zeros_like(weights)
    np.put_along_axis(kept, four, np.take_along_axis(weights, four, axis=1), axis=1)
    return np.asarray(kept / kept.sum(axis=1, keepdims=True))
