"""The frame of a standing body: where it stands, and which way it faces."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from bodyscan.arrays import Array, Indices
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.mesh.topology import compute_face_areas

ARMPIT = 0.74
"""Its height as a share of the stature (Drillis and Contini 1966)."""


@dataclass(frozen=True, eq=False)
class BodyFrame:
    """rig_from_body: z = 0 on the floor, origin under the body, x where it faces, y to its left.
    known: whether the feet tell front from back; else it is assumed to face the rig's x.
    """

    rig_from_body: RigidTransform
    known: bool

    @property
    def view_axes(self) -> Array:
        """Columns (3, 3), rig frame: forward, left and up in pictures; the rig's own axes where the
        facing is not known."""
        return self.rig_from_body.rotation if self.known else np.eye(3)


def is_upright(vertices: Array, faces: Indices, along: int = 2) -> bool:
    """Whether a surface in one piece varies most along an axis, to 45 degrees or so; held out arms
    count little."""
    areas = compute_face_areas(vertices, faces)
    covariance = np.cov(vertices[faces].mean(axis=1).T, aweights=areas)
    return bool(covariance[along, along] >= 0.5 * np.linalg.eigvalsh(covariance)[-1])


def find_body_frame(vertices: Array) -> BodyFrame:
    """Find the frame of a standing body from evenly spread vertices (V, 3) mm, z up from the floor.

    The upper body is widest from side to side. Toes point forward: feet reach beyond their ankles.
    Of less than an upper body it is the rig frame.
    """
    heights = vertices[:, 2] / np.maximum(vertices[:, 2].max(initial=0.0), 1e-9)
    upper = vertices[heights > 0.45, :2]  # hips, trunk and arms, which together are wider than deep
    if len(upper) < 3:
        return BodyFrame(RigidTransform.identity(), False)
    middle = 0.5 * (np.percentile(upper, 2, axis=0) + np.percentile(upper, 98, axis=0))
    _, axes = np.linalg.eigh(np.cov((upper - upper.mean(axis=0)).T))
    feet, ankles = vertices[heights < 0.03, :2], vertices[(heights > 0.05) & (heights < 0.15), :2]
    # A raised foot has no sole on the floor: its ankle lies over none of `feet`.
    ankles = ankles[cKDTree(feet).query(ankles)[0] < 0.02 * vertices[:, 2].max()]
    toes = find_toes(feet, ankles, 0.12 * vertices[:, 2].max())
    # Half of what round feet reach on average, where only their toes go beyond the ankle.
    known = bool(np.linalg.norm(toes) > 0.005 * vertices[:, 2].max())
    along = axes.T @ toes
    # A stout body may be deeper than wide.
    forward = axes[:, int(known and abs(along[1]) > 2.0 * abs(along[0]))]
    forward = forward * np.sign(forward @ toes if known else forward[0] or 1.0)
    rotation = np.eye(3)
    rotation[:2, 0], rotation[:2, 1] = forward, [-forward[1], forward[0]]
    return BodyFrame(RigidTransform(rotation, np.array([middle[0], middle[1], 0.0])), known)


def find_toes(feet: Array, ankles: Array, reach_mm: float = np.inf) -> Array:
    """How far (2,) feet (N, 2) reach beyond the ankles (M, 2) closest to them, on average: each foot by
    itself, as one that hardly touches the floor would pull the mean of the ankles to its side."""
    if len(ankles) == 0:
        return np.zeros(2)
    distance, nearest = cKDTree(ankles).query(feet)
    near = np.flatnonzero(np.asarray(distance) < reach_mm)
    beyond = feet[near] - ankles[np.asarray(nearest)[near]]
    return beyond.mean(axis=0) if len(near) else np.zeros(2)
