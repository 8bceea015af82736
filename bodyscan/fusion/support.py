"""How well the points of a cloud support each vertex of a surface laid through them.

Every point contributes its tangent plane. Around a measured vertex there are enough points, their
planes agree with each other, and they pass close to the vertex.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bodyscan.arrays import Array, Floats, Indices, Mask
from bodyscan.compiled import compiled
from bodyscan.mesh.body import BodyCloud
from bodyscan.mesh.topology import face_normals
from bodyscan.progress import map_threads, split_range

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
        was seen, nor where the grid lifts it off the points (fingertips), nor between surfaces
        (toes)."""
        lifted = np.abs(self.shift_mm) > np.maximum(MAX_SHIFT * self.reach_mm, 4.0 * self.sigma_mm)
        torn = self.scatter_mm > np.maximum(0.125 * self.reach_mm, 2.0 * self.sigma_mm)
        # One point 3 mm away, or a sixth of the median vertex: a straight rim has a half of that.
        min_weight = max(0.3, float(np.median(self.weight)) / 6.0)
        return np.asarray((self.weight > min_weight) & ~lifted & ~torn)


def measure_support(vertices: Array, normals: Floats, cloud: BodyCloud, reach_mm: float) -> Support:
    """Support of vertices (V, 3) with unit normals (V, 3) by the 8 nearest points within the reach."""
    distance, near = PointColumns.from_points(cloud.points, reach_mm).find_nearest(vertices, 8)
    weight, shift, scatter = _average_planes(
        np.ascontiguousarray(vertices),
        np.ascontiguousarray(normals),
        distance,
        near,
        cloud.points,
        cloud.normals,
        0.5 * reach_mm,
    )
    nearest = np.minimum(near[:, 0], len(cloud.points) - 1)  # for those without: any
    return Support(nearest, cloud.sigma_mm[nearest], weight, shift, scatter, reach_mm)


def fit_to_points(vertices: Array, faces: Indices, normals: Floats, around: Support) -> Array:
    """Move the vertices (V, 3) along their normals to the points around, by less the smaller their
    weight.

    Where a face would fold over, its corners move by half of that, then a quarter, then not at all.
    """
    farthest = MAX_SHIFT * around.reach_mm
    move = np.minimum(around.weight, 1.0) * np.clip(around.shift_mm, -farthest, farthest)
    concerned = np.arange(len(faces))
    min_cosine = 0.3  # of the angle by which a face may turn
    for share in (0.5, 0.5, 0.0):
        some = faces[concerned]
        moved = vertices + move[:, None] * normals
        before, after = face_normals(vertices, some), face_normals(moved, some)
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
    vertices: Array,
    normals: Floats,
    distance: Array,
    near: Indices,
    points: Array,
    point_normals: Floats,
    scale_mm: float,
) -> tuple[Array, Array, Array]:
    """Weight, shift and scatter as in `Support`, from the nearest points.

    distance, near: (V, k), sorted by distance, infinite where there are no more points. A point's
        weight falls off as a Gaussian; one that faces another direction counts for the scatter
        only.
    """
    count, neighbours = near.shape
    weight, shift, scatter = np.zeros(count), np.zeros(count), np.zeros(count)
    planes, weights = np.empty(neighbours), np.empty(neighbours)
    for v in range(count):
        known, total, mean = 0, 0.0, 0.0
        while known < neighbours and distance[v, known] < np.inf:
            p = near[v, known]
            plane, cosine = 0.0, 0.0
            for k in range(3):
                plane += (points[p, k] - vertices[v, k]) * point_normals[p, k]
                cosine += normals[v, k] * point_normals[p, k]
            one = np.exp(-0.5 * (distance[v, known] / scale_mm) ** 2)
            planes[known], weights[known] = plane, one
            facing = one * max(cosine, 0.0) ** 2
            total += one
            mean += facing * plane
            weight[v] += facing
            known += 1
        if weight[v] > 0.0:
            shift[v] = mean / weight[v]
        for j in range(known):
            scatter[v] += weights[j] * (planes[j] - shift[v]) ** 2
        if known > 0:
            scatter[v] = np.sqrt(scatter[v] / total)
    return weight, shift, scatter


@dataclass(frozen=True, eq=False)
class PointColumns:
    """Points (N, 3) in columns along x, `reach_mm` wide, for searches within that reach: built in a
    tenth of the time of a tree, and searched in half.

    order: indices of the points, column after column, (N,).
    start: where each column begins, by (y, z); columns at the rim are empty.
    low: y and z where the columns begin, (2,) mm.
    """

    points: Array
    order: Indices
    start: Indices
    low: Array
    reach_mm: float

    @staticmethod
    def from_points(points: Array, reach_mm: float) -> PointColumns:
        low = points[:, 1:].min(axis=0) - reach_mm
        across = ((points[:, 1:] - low) / reach_mm).astype(np.int64)
        shape = across.max(axis=0) + 2
        column = across[:, 0] * shape[1] + across[:, 1]
        start = np.concatenate([[0], np.cumsum(np.bincount(column, minlength=shape.prod()))])
        order = _sort(column, start)
        return PointColumns(points[order], order, start[:-1].reshape(shape), low, reach_mm)

    def find_nearest(self, queries: Array, count: int) -> tuple[Array, Indices]:
        """Find the nearest points to queries (M, 3): distances (M, count) mm, ascending,
        infinite beyond the reach, and indices (M, count), N for missing ones."""
        distance = np.full((len(queries), count), np.inf)
        near = np.full((len(queries), count), len(self.points))

        def find(part: slice) -> None:
            some = np.ascontiguousarray(queries[part])
            _find(
                some, self.points, self.start, self.low, self.reach_mm, distance[part], near[part]
            )

        map_threads(find, split_range(len(queries)), stage="nearest points")
        return distance, np.append(self.order, len(self.points))[near]


@compiled
def _sort(column: Indices, start: Indices) -> Indices:
    """Indices (N,) of points by column, in their own order within each."""
    free, order = start.copy(), np.empty(len(column), np.int64)
    for n in range(len(column)):
        order[free[column[n]]] = n
        free[column[n]] += 1
    return order


@compiled
def _find(
    queries: Array,
    points: Array,
    start: Indices,
    low: Array,
    reach_mm: float,
    distance: Array,
    near: Indices,
) -> None:
    """Fill in distances (M, k) and positions (M, k) in `order` of the nearest points, ascending."""
    wanted = distance.shape[1]
    height, width = start.shape
    for v in range(len(queries)):
        x, y, z = queries[v, 0], queries[v, 1], queries[v, 2]
        row, column = int(np.floor((y - low[0]) / reach_mm)), int(np.floor((z - low[1]) / reach_mm))
        farthest = reach_mm**2
        found = 0
        for j in range(max(row - 1, 0), min(row + 2, height - 1)):
            first, last = max(column - 1, 0), min(column + 2, width - 1)
            if first >= last:
                continue
            for p in range(start[j, first], start[j, last]):
                along = points[p, 0] - x
                if along * along >= farthest:
                    continue
                squared = along * along + (points[p, 1] - y) ** 2 + (points[p, 2] - z) ** 2
                if squared >= farthest:
                    continue
                rank = min(found, wanted - 1)
                while rank > 0 and distance[v, rank - 1] > squared:
                    distance[v, rank], near[v, rank] = distance[v, rank - 1], near[v, rank - 1]
                    rank -= 1
                distance[v, rank], near[v, rank] = squared, p
                found = min(found + 1, wanted)
                if found == wanted:
                    farthest = distance[v, wanted - 1]
        for n in range(found):
            distance[v, n] = np.sqrt(distance[v, n])
