"""What the points of a cloud say about each vertex of a surface laid through them.

Every point contributes its tangent plane. Around a measured vertex there are enough points, their
planes agree with each other, and they pass close to the vertex.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bodyscan.arrays import Array, Floats, Indices, Mask
from bodyscan.compiled import compiled
from bodyscan.fusion.point_columns import PointColumns
from bodyscan.mesh.body import BodyCloud
from bodyscan.mesh.topology import face_normals

NEIGHBOURS = 8
# Shares of the reach: 2, 1 and 0.5 mm of 4.
RANGE = 0.5
LIFTED = 0.25
TORN = 0.125
LEAST_WEIGHT = 0.3  # relative to a point right at the vertex: one point 3 mm away
LEAST_SHARE = 1 / 6  # of the median vertex's weight: at a straight rim it is a half

STEEPEST_TURN = 0.3  # cosine of the largest angle by which a face may turn


@dataclass(frozen=True, eq=False)
class Support:
    """Support of V vertices by the points within a reach.

    nearest: index of the nearest point, (V,).
    sigma_mm: its standard deviation, (V,).
    weight: of the nearest points together, (V,): 1 for one at the vertex itself that faces like it,
        0 if there is none.
    shift_mm: from the vertex along its normal to the mean of those points' tangent planes, (V,).
    spread_mm: RMS of the planes about that mean, (V,).
    """

    nearest: Indices
    sigma_mm: Floats
    weight: Array
    shift_mm: Array
    spread_mm: Array
    reach_mm: float

    @property
    def measured(self) -> Mask:
        """(V,): whether a vertex lies where the points are, and these agree.

        False beyond the rim of what was seen (too little weight), where the grid's cells lift the
        surface off the points (fingertips), and where points of different surfaces meet (between
        toes, at the corner of an eye).
        """
        lifted = np.abs(self.shift_mm) > np.maximum(LIFTED * self.reach_mm, 4.0 * self.sigma_mm)
        torn = self.spread_mm > np.maximum(TORN * self.reach_mm, 2.0 * self.sigma_mm)
        enough = max(LEAST_WEIGHT, LEAST_SHARE * float(np.median(self.weight)))
        return np.asarray((self.weight > enough) & ~lifted & ~torn)


def support(vertices: Array, normals: Floats, cloud: BodyCloud, reach_mm: float) -> Support:
    """Support of vertices (V, 3) with unit normals (V, 3) by a cloud."""
    distance, near = PointColumns.of(cloud.points, reach_mm).nearest(vertices, NEIGHBOURS)
    weight, shift, spread = _average_planes(
        np.ascontiguousarray(vertices),
        np.ascontiguousarray(normals),
        distance,
        near,
        cloud.points,
        cloud.normals,
        RANGE * reach_mm,
    )
    nearest = np.minimum(near[:, 0], len(cloud.points) - 1)  # for those without: any
    return Support(nearest, cloud.sigma_mm[nearest], weight, shift, spread, reach_mm)


def fit_to_points(vertices: Array, faces: Indices, normals: Floats, around: Support) -> Array:
    """Move the vertices (V, 3) along their normals to where the points around are.

    The move is smaller if their weight is, so that there is no step where the points end. Where a
    face would fold over, its corners move by half of that, then a quarter, then not at all.
    """
    farthest = LIFTED * around.reach_mm
    move = np.minimum(around.weight, 1.0) * np.clip(around.shift_mm, -farthest, farthest)
    concerned = np.arange(len(faces))
    for share in (0.5, 0.5, 0.0):
        some = faces[concerned]
        moved = vertices + move[:, None] * normals
        before, after = face_normals(vertices, some), face_normals(moved, some)
        cosine = np.einsum("fc,fc->f", before, after)
        lengths = np.linalg.norm(before, axis=1) * np.linalg.norm(after, axis=1)
        folded = np.unique(some[cosine < STEEPEST_TURN * lengths])
        move[folded] *= share
        touched = np.zeros(len(vertices), bool)
        touched[folded] = True
        concerned = np.flatnonzero(touched[faces].any(axis=1))
    return vertices + move[:, None] * normals


@compiled
def _average_planes(
    vertices: Array,
    normals: Floats,
    distance: Array,
    near: Indices,
    points: Array,
    point_normals: Floats,
    scale_mm: float,
) -> tuple[Array, Array, Array]:
    """Weight, shift and spread as in `Support`, from the nearest points.

    distance, near: (V, k), sorted by distance, infinite where there are no more points.

    A point's weight falls off as a Gaussian of its distance; a point that faces another direction
    counts for the spread but not for the shift.
    """
    count, most = near.shape
    weight, shift, spread = np.zeros(count), np.zeros(count), np.zeros(count)
    planes, weights = np.empty(most), np.empty(most)
    for v in range(count):
        known, total, mean = 0, 0.0, 0.0
        while known < most and distance[v, known] < np.inf:
            p = near[v, known]
            plane, alike = 0.0, 0.0
            for k in range(3):
                plane += (points[p, k] - vertices[v, k]) * point_normals[p, k]
                alike += normals[v, k] * point_normals[p, k]
            one = np.exp(-0.5 * (distance[v, known] / scale_mm) ** 2)
            planes[known], weights[known] = plane, one
            facing = one * max(alike, 0.0) ** 2
            total += one
            mean += facing * plane
            weight[v] += facing
            known += 1
        if weight[v] > 0.0:
            shift[v] = mean / weight[v]
        for j in range(known):
            spread[v] += weights[j] * (planes[j] - shift[v]) ** 2
        if known > 0:
            spread[v] = np.sqrt(spread[v] / total)
    return weight, shift, spread
