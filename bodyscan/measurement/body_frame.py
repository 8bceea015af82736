"""The body's own frame: floor at z = 0, origin under the body, x where it faces, y to its left."""

from __future__ import annotations

import numpy as np

from bodyscan.arrays import Array
from bodyscan.geometry.transforms import RigidTransform

UPPER_BODY = 0.45  # of the stature: hips, trunk and arms, which together are wider than deep


def rig_from_body(vertices: Array) -> RigidTransform:
    """Pose of a standing body in the rig frame, from evenly spread vertices (V, 3) mm.

    It is only turned about the vertical and moved along the floor. The upper body is widest from
    side to side; of the two directions across that, the subject faces the one nearer to the rig's
    x.
    """
    upper = vertices[vertices[:, 2] > UPPER_BODY * vertices[:, 2].max(), :2]
    middle = 0.5 * (np.percentile(upper, 2, axis=0) + np.percentile(upper, 98, axis=0))
    _, axes = np.linalg.eigh(np.cov((upper - upper.mean(axis=0)).T))
    forward = axes[:, 0] * (1.0 if axes[0, 0] >= 0 else -1.0)
    rotation = np.eye(3)
    rotation[:2, 0], rotation[:2, 1] = forward, [-forward[1], forward[0]]
    return RigidTransform(rotation, np.array([middle[0], middle[1], 0.0]))
