"""Registered bodies of known shape and pose: the template lies exactly on them, without a fit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from made_bodies import mesh_of

from bodyscan.arrays import Array, Mask
from bodyscan.body_model.fitting import FittedBody
from bodyscan.body_model.registered import RegisteredBody
from bodyscan.body_model.template import BodyShapeAndPose, PosedBody, load_template, pose_body
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.mesh.topology import compute_vertex_normals

TEMPLATE = load_template()


def make_body(
    seed: int, *, arms_deg: float = 0.0, bumps_mm: float = 3.0
) -> tuple[Array, Array, PosedBody]:
    """Vertices (V, 3), shape (K,) and posed body of somebody in a scanning pose.

    arms_deg: off the trunk beyond 15 below the template's; bumps_mm: RMS of what is no shape of its.
    """
    rng = np.random.default_rng(seed)
    rotations = rng.normal(0.0, np.radians(3.0), TEMPLATE.joints.shape)
    lower = [name.endswith(("pelvis", "thigh", "shank", "foot")) for name in TEMPLATE.joint_names]
    rotations[lower] = 0.0  # both feet stand on the floor
    for side, sign in (("left", -1.0), ("right", 1.0)):
        arm = TEMPLATE.joint_names.index(f"{side} upper arm")
        rotations[arm, 0] += sign * np.radians(15.0 - arms_deg)
    shape = rng.normal(0.0, 0.8, len(TEMPLATE.shapes))
    posed = pose_body(TEMPLATE, BodyShapeAndPose(shape, rotations, np.zeros(3)))
    vertices = posed.vertices
    centres = vertices[rng.integers(0, len(vertices), 80)]
    near = np.exp(-((vertices[:, None] - centres) ** 2).sum(axis=2) / (2.0 * 60.0**2))
    bumps = near @ rng.normal(size=80)
    normals = compute_vertex_normals(vertices, TEMPLATE.faces)
    vertices = vertices + (bumps_mm * bumps / bumps.std())[:, None] * normals
    shift = -np.append(vertices[:, :2].mean(axis=0), vertices[:, 2].min())
    posed = PosedBody(posed.vertices + shift, posed.rotations, posed.joints + shift)
    return vertices + shift, shape, posed


def register_exactly(vertices: Array, shape: Array, posed: PosedBody) -> RegisteredBody:
    """The template laid exactly over a body."""
    mesh = mesh_of(vertices, TEMPLATE.faces)
    fitted = FittedBody(TEMPLATE, vertices, shape, posed, np.zeros(len(vertices)), 0.0)
    return RegisteredBody(mesh, RigidTransform.identity(), fitted, np.zeros(len(mesh.vertices)))


def hide(body: RegisteredBody, hidden: Mask) -> RegisteredBody:
    """The same body where some of the template's vertices (V,) were not measured."""
    distance = np.where(hidden, np.nan, body.fitted.distance_mm)
    sigma = np.where(hidden, np.nan, body.mesh.sigma_mm).astype(np.float32)
    filled = np.asarray(hidden[TEMPLATE.faces].any(axis=1))
    return replace(
        body,
        mesh=replace(body.mesh, sigma_mm=sigma, filled=filled),
        fitted=replace(body.fitted, distance_mm=distance),
    )
