"""How well the points of a cloud support each vertex of a surface laid through them.

Every point contributes its tangent plane. Around a measured vertex there are enough points, their
planes agree with each other, and they pass close to the vertex.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import KDTree

from bodyscan.arrays import Array, Floats, Indices, Mask
from bodyscan.compiled import compiled
from bodyscan.mesh.body import BodyCloud
from bodyscan.mesh.topology import compute_face_normals
from bodyscan.progress import THREADS

MAX_SHIFT = 0.25
"""Share of the reach by which a vertex may be off its points."""


@dataclass(frozen=True, eq=False)
class Support:
    """Support of V vertices by the points within a reach, (V,) each.

    nearest, sigma_mm: index of the nearest point, and its standard deviation.
    weight: of the nearest points together: 1 for one at the vertex itself that faces like it.
    shift_mm, scatter_mm: from the vertex along its normal to the mean of those points' tangent
        planes, and the RMS of the planes about that.
    """

    nearest: Indices
    sigma_mm: Floats
    weight: Array
    shift_mm: Array
    scatter_mm: Array
    reach_mm: float

    @property
    def measured(self) -> Mask:
        """(V,): whether a vertex lies on its points, and these agree: not beyond the rim of what
        was seen, nor where the grid lifts it off the points (fingertips), nor between toes."""
        lifted = np.abs(self.shift_mm) > np.maximum(MAX_SHIFT * self.reach_mm, 4.0 * self.sigma_mm)
        torn = self.scatter_mm > np.maximum(0.125 * self.reach_mm, 2.0 * self.sigma_mm)
        # One point 3 mm away, or a sixth of the median vertex: a straight rim has a half of that.
        min_weight = max(0.3, float(np.median(self.weight)) / 6.0)
        return np.asarray((self.weight > min_weight) & ~lifted & ~torn)


def measure_support(vertices: Array, normals: Floats, cloud: BodyCloud, reach_mm: float) -> Support:
    """Support of vertices (V, 3) with unit normals (V, 3) by the 8 nearest points within the reach."""
    tree = KDTree(cloud.points, compact_nodes=False, balanced_tree=False)  # built in half the time
    distance, near = tree.query(vertices, 8, distance_upper_bound=reach_mm, workers=THREADS)
    near = np.minimum(near, len(cloud.points) - 1)  # for those without: any
    distance = np.asarray(distance)
    around = _average_planes(
        (vertices, normals), (cloud.points, cloud.normals), distance, near, 0.5 * reach_mm
    )
    nearest = near[:, 0]
    return Support(nearest, cloud.sigma_mm[nearest], *around, reach_mm)


def fit_to_points(vertices: Array, faces: Indices, normals: Floats, around: Support) -> Array:
    """Move the vertices (V, 3) along normals to the points around, by less the smaller their weight.

    Where a face would fold over, its corners move by half of that, then a quarter, then not at all.
    """
    farthest = MAX_SHIFT * around.reach_mm
    move = np.minimum(around.weight, 1.0) * np.clip(around.shift_mm, -farthest, farthest)
    concerned = np.arange(len(faces))
    min_cosine = 0.3  # of the angle by which a face may turn
    for share in (0.5, 0.5, 0.0):
        some = faces[concerned]
        moved = vertices + move[:, None] * normals
        before, after = compute_face_normals(vertices, some), compute_face_normals(moved, some)
        cosine = np.einsum("fc,fc->f", before, after)
        lengths = np.linalg.norm(before, axis=1) * np.linalg.norm(after, axis=1)
        folded = np.unique(some[cosine < min_cosine * lengths])
        move[folded] *= share
        touched = np.zeros(len(vertices), bool)
        touched[folded] = True
        concerned = np.flatnonzero(touched[faces].any(axis=1))
    return vertices + move[:, None] * normals


@compiled
def _average_planes(
    surface: tuple[Array, Floats],
    cloud: tuple[Array, Floats],
    distance: Array,
    near: Indices,
    scale_mm: float,
) -> tuple[Array, Array, Array]:
    """Weight, shift and scatter as in `Support`, from the nearest points.

    surface, cloud: points and normals.
    distance, near: (V, k), infinite where there are no more points. A point's weight falls off as a
        Gaussian; one that faces another direction counts for the scatter only.
    """
    (vertices, normals), (points, point_normals) = surface, cloud
    (count, size), tiny = near.shape, 1e-300
    weight, shift, scatter = np.zeros(count), np.zeros(count), np.empty(count)
    planes, weights = np.empty(size), np.empty(size)
    for n in range(count):
        squares = 0.0
        for j in range(size):
            k, planes[j], cosine = near[n, j], 0.0, 0.0
            for axis in range(3):
                normal = point_normals[k, axis]
                planes[j] += (points[k, axis] - vertices[n, axis]) * normal
                cosine += normals[n, axis] * normal
            weights[j] = np.exp(-0.5 * (distance[n, j] / scale_mm) ** 2)
            facing = weights[j] * max(cosine, 0.0) ** 2
            weight[n] += facing
            shift[n] += facing * planes[j]
        shift[n] /= max(weight[n], tiny)
        for j in range(size):
            squares += weights[j] * (planes[j] - shift[n]) ** 2
        scatter[n] = np.sqrt(squares / max(weights.sum(), tiny))
    return weight, shift, scatter
