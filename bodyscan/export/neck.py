"""A body's neck: the narrowest horizontal slice between its head and its shoulders."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from bodyscan.arrays import Array, Indices
from bodyscan.errors import FailedWork
from bodyscan.mesh.topology import directed_edges

# Distance from crown to neck over stature: a tall adult's, and a small child's (a quarter).
HIGHEST, LOWEST = 0.09, 0.24
REACH_MM = 160.0  # from the head's axis; arms and shoulders farther out do not count
STEP_MM = 4.0
SHOULDERS = 0.07  # share of the stature, below the neck
LEAST_GIRTH_MM, MOST_GIRTH_MM, LEAST_HEAD_MM = 180.0, 700.0, 400.0


@dataclass(frozen=True, eq=False)
class Neck:
    """height_mm: above the floor (z). axis: (2,) x and y of the head over it. Rig frame, mm."""

    height_mm: float
    axis: Array


def find_neck(vertices: Array, faces: Indices) -> Neck:
    """The narrowest slice below the head of a standing body, vertices (V, 3), faces (F, 3).

    A slice's size is the girth of its convex hull, within REACH_MM of the head's axis; the head is
    what stands highest over the body's middle, so that a raised hand is not mistaken for it. Raises
    FailedWork if there is no such slice.
    """
    axis, top = _crown(vertices)
    stature = top - float(vertices[:, 2].min())
    heights = np.arange(top - LOWEST * stature, top - HIGHEST * stature, STEP_MM)
    near = np.linalg.norm(vertices[:, :2] - axis, axis=1) < 2.0 * REACH_MM
    near &= vertices[:, 2] > heights[0] - (SHOULDERS * stature + REACH_MM)
    faces = faces[near[faces].all(axis=1)]
    girths = np.array([girth(vertices, faces, height, axis) for height in heights])
    narrowest = int(np.argmin(girths)) if girths.size else 0
    neck = float(girths[narrowest])
    head = max(girths[narrowest:].max(), girth(vertices, faces, top - 0.06 * stature, axis))
    shoulders = girth(vertices, faces, heights[narrowest] - SHOULDERS * stature, axis)
    inside = 0 < narrowest < len(girths) - 1 and LEAST_GIRTH_MM < neck < MOST_GIRTH_MM
    # Wrists of arms held overhead are narrow too, but have no head above and no shoulders below.
    if not (inside and head > LEAST_HEAD_MM and head > 1.1 * neck and shoulders > 1.5 * neck):
        raise FailedWork(
            "no neck was found, so the face cannot be taken away",
            remedy="look at the mesh: does the subject stand upright, arms not overhead?",
        )
    return Neck(float(heights[narrowest]), axis)


def girth(vertices: Array, faces: Indices, height: float, axis: Array) -> float:
    """Girth of the convex hull of the slice at `height` near
    `axis` (x, y), mm; infinite if empty."""
    edges = directed_edges(faces)
    low, high = vertices[edges[:, 0]], vertices[edges[:, 1]]
    across = (low[:, 2] < height) & (high[:, 2] >= height)
    low, high = low[across], high[across]
    part = (height - low[:, 2]) / (high[:, 2] - low[:, 2])
    slice_ = low[:, :2] + part[:, None] * (high - low)[:, :2]
    slice_ = slice_[np.linalg.norm(slice_ - axis, axis=1) < REACH_MM]
    try:
        hull = slice_[ConvexHull(slice_).vertices] if len(slice_) > 3 else slice_[:0]
    except QhullError:
        return float("inf")
    if not len(hull):
        return float("inf")
    return float(np.linalg.norm(hull - np.roll(hull, 1, axis=0), axis=1).sum())


def _crown(vertices: Array) -> tuple[Array, float]:
    """The head's axis (x, y) and height: the top of what is over the trunk's middle."""
    low, high = vertices[:, 2].min(), vertices[:, 2].max()
    trunk = vertices[np.abs(vertices[:, 2] - (low + 0.55 * (high - low))) < 0.1 * (high - low)]
    middle = np.median(trunk[:, :2], axis=0)
    over = vertices[np.linalg.norm(vertices[:, :2] - middle, axis=1) < REACH_MM]
    top = float(over[:, 2].max())
    head = over[over[:, 2] > top - 100.0]
    return np.median(head[:, :2], axis=0), top
