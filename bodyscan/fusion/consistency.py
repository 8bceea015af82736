"""Geometric consistency of the pairs: which points others confirm, and which they contradict.

A point is projected into another pair's image and compared with the smoothed surface at that pixel:
no search tree.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.special import erfc

from bodyscan.arrays import Array, Floats, Indices, Mask
from bodyscan.compiled import compiled
from bodyscan.fusion.smoothing import Numbers, SmoothSurface
from bodyscan.fusion.voxel_thinning import Samples
from bodyscan.geometry.camera_tables import Table, look_up, make_projection_table

Counts = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Consistency:
    """What one surface shows of the samples of others, in the samples' order.

    index, at: numbers of the samples that it agrees with, and of its points there.
    shift_mm: from the sample along its normal to that surface.
    against_index, against_at: the same where it contradicts the sample.
    """

    index: Numbers
    at: Numbers
    shift_mm: Floats
    against_index: Numbers
    against_at: Numbers

    def leave_out_rims(self, surface: SmoothSurface) -> Consistency:
        """Without what was compared within a window of the surface's rims: blur lifts those, and a limb
        that moved by a millimetre shows, or hides, what is behind it."""
        inside = surface.rim >= 1.0
        kept, against = inside[self.at], inside[self.against_at]
        found = self.index[kept], self.at[kept], self.shift_mm[kept]
        return Consistency(*found, self.against_index[against], self.against_at[against])


@dataclass(frozen=True, eq=False)
class Contradictions:
    """How often pairs contradict each other's points.

    compared, against: how often points of the column's pair were compared with the row's surface,
        and contradicted by it, (P, P).
    by_noise: share of contradictions that both points' sigmas predict for a single surface.
    heights_mm: between which four of five contradictions are.
    double: number of places where surfaces are double, see `estimate_displacement_sigma`.
    """

    pairs: tuple[str, ...]
    compared: Counts
    against: Counts
    by_noise: float = 0.0
    heights_mm: tuple[float, float] = (0.0, 0.0)
    double: int = 0

    @staticmethod
    def count(
        pairs: Sequence[str],
        consistency: Sequence[Consistency],
        samples: Samples,
        surfaces: Sequence[SmoothSurface],
        agreement_mm: float,
    ) -> Contradictions:
        """Count, for each pair's surface, how many samples of each other pair it confirms or
        contradicts, without hair and dark cloth; consistency, surfaces: one for each pair."""
        bright = _find_bright(samples)

        def count_by_pair(index: Numbers) -> Counts:
            pair = np.searchsorted(samples.starts, index[bright[index]], side="right") - 1
            return np.bincount(pair, minlength=len(pairs))

        against = np.array([count_by_pair(one.against_index) for one in consistency])
        agreed = np.array([count_by_pair(one.index) for one in consistency])
        index = np.concatenate([one.against_index for one in consistency])
        heights = samples.points[index[bright[index]], 2]
        low, high = np.percentile(heights, (10, 90)).tolist() if len(heights) else (0.0, 0.0)
        sigma = np.concatenate([
            np.hypot(samples.sigma_mm[index], surface.sigma_mm[at])
            for one, surface in zip(consistency, surfaces, strict=True)
            for index, at in ((one.index, one.at), (one.against_index, one.against_at))
        ])  # fmt: skip
        beyond = erfc(agreement_mm / (np.sqrt(2.0) * np.maximum(sigma, 1e-6)))
        by_noise = float(beyond.mean()) if len(beyond) else 0.0
        return Contradictions(tuple(pairs), agreed + against, against, by_noise, (low, high))

    @property
    def share(self) -> float:
        """Share of contradictions in all comparisons."""
        return float(self.against.sum() / max(self.compared.sum(), 1))

    @property
    def beyond_noise(self) -> float:
        """The share that noise does not explain."""
        return self.share - self.by_noise

    def find_outlier(self, groups: Mapping[str, frozenset[str]]) -> str:
        """The smallest of the groups without which the others agree best; "" unless less than
        half of the share of contradictions is left without it."""
        left = {}
        for name, group in groups.items():
            kept = np.flatnonzero([pair not in group for pair in self.pairs])
            rows = np.ix_(kept, kept)
            left[name] = float(self.against[rows].sum() / max(self.compared[rows].sum(), 1))
        judged = [name for name, group in groups.items() if len(self.pairs) > len(group) + 1]
        outliers = [name for name in judged if left[name] < 0.5 * self.share]
        lowest = min((left[name] for name in outliers), default=0.0)
        # If a single pair is the outlier, leaving it out is as good as leaving out its pole.
        near = [name for name in outliers if left[name] <= lowest + 0.1 * (self.share - lowest)]
        return min(near, key=lambda name: (len(groups[name]), left[name]), default="")


def _find_bright(samples: Samples) -> Mask:
    """Samples not darker than a third of most (N,): strands of hair, and hems, move by themselves."""
    grey = samples.colours.max(axis=1)
    return np.asarray(grey >= np.median(grey) / 3.0)


def number_cubes(points: Floats, size_mm: float) -> Indices:
    """Number (N,) of the cube of that size in which each point (N, 3) lies."""
    cell = ((points - points.min(axis=0)) / size_mm).astype(np.int64)
    return np.asarray(np.ravel_multi_index(tuple(cell.T), tuple(cell.max(axis=0) + 1)))


def estimate_displacement_sigma(
    samples: Samples, surfaces: Sequence[SmoothSurface], consistency: Sequence[Consistency]
) -> tuple[Array, int]:
    """Sigma (N,) mm of samples around double surfaces, as of an arm that moved while one pole fired:
    their distance, since either may be right and girths go round both, or 0; and number of cubes.

    Counted are cubes of 60 mm, less than an arm's width, in which two pairs contradict each other more
    often than they agree; pairs that fired together agree wherever the arm was. An arm turned by 4
    degrees has 3 to 9; less than three, as of fingers, are left out.
    """
    cube = number_cubes(samples.points, 60.0)
    pair = np.searchsorted(samples.starts, np.arange(len(cube)), side="right") - 1
    bright, pairs = _find_bright(samples), len(surfaces)
    counts = np.zeros((2, (int(cube.max()) + 1) * pairs**2), np.int64)
    found = []
    for k, one in enumerate(consistency):
        # Of the cube and the two pairs that were compared.
        key = (cube * pairs + np.minimum(pair, k)) * pairs + np.maximum(pair, k)
        against, agreed = (index[bright[index]] for index in (one.against_index, one.index))
        found.append((against, key[against]))
        for count, index in zip(counts, (against, agreed), strict=True):
            count += np.bincount(key[index], minlength=len(count))
    double = (counts[0] > 30) & (counts[0] > counts[1])
    double_count = len(np.unique(np.flatnonzero(double) // pairs**2))
    if double_count < 3:
        return np.zeros(len(cube)), double_count
    chosen = [index[double[key]] for index, key in found]
    distance = np.concatenate([
        cKDTree(surface.points[::8]).query(samples.points[index])[0]
        for surface, index in zip(surfaces, chosen, strict=True)
    ])  # fmt: skip
    index = np.concatenate(chosen)
    which = np.unique(cube[index], return_inverse=True)[1]
    values = *samples.points[index].astype(np.float64).T, distance, distance**2
    x, y, z, mean, square = [np.bincount(which, each) / np.bincount(which) for each in values]
    # It shows least where a surface moved along itself: what one in 20 exceeds.
    farthest = mean + 1.64 * np.sqrt(np.maximum(square - mean**2, 0.0))
    # Around a limb: its other side, which one pole alone may have seen, is an arm's width away. Along
    # it, where poles share nothing: limbs hang or stand, and a hand moves with its forearm.
    centres = np.column_stack([np.tile([x, y], 2).T, 0.5 * np.append(z, z - 300.0)])
    near = cKDTree(centres).query(samples.points * [1.0, 1.0, 0.5], distance_upper_bound=90.0)[1]
    return np.append(np.tile(farthest, 2), 0.0)[np.asarray(near)], double_count


def compare_with_surface(
    samples: Samples, surface: SmoothSurface, number: int, agreement_mm: float, double_mm: float
) -> Consistency:
    """Compare the samples of other pairs with `surface`, which is number `number`.

    It agrees within `agreement_mm`, and contradicts as a double surface within `double_mm`, or if
    it was seen through the samples.
    """
    count = len(samples.points)
    index, at = np.empty(count, np.int32), np.empty(count, np.int32)
    shift = np.empty(count, np.float32)
    against_index, against_at = np.empty(count, np.int32), np.empty(count, np.int32)
    camera_from_rig = surface.rig_from_camera.inverse()
    agreed, contradicted = _compare(
        (samples.points, samples.normals),
        (int(samples.starts[number]), int(samples.starts[number + 1])),
        (surface.points, surface.normals, surface.number), surface.corner,
        make_projection_table(surface.camera), (camera_from_rig.rotation, camera_from_rig.translation),
        surface.warped, (agreement_mm, double_mm), (index, at, shift, against_index, against_at),
    )  # fmt: skip
    return Consistency(
        index[:agreed].copy(), at[:agreed].copy(), shift[:agreed].copy(),
        against_index[:contradicted].copy(), against_at[:contradicted].copy(),
    )  # fmt: skip


@compiled
def _compare(
    samples: tuple[Floats, Floats],
    excluded: tuple[int, int],
    surface: tuple[Floats, Floats, Numbers],
    corner: tuple[int, int],
    projection: Table,
    camera_from_rig: tuple[Array, Array],
    warped: bool,
    limits_mm: tuple[float, float],
    found: tuple[Numbers, Numbers, Floats, Numbers, Numbers],
) -> tuple[int, int]:
    """Write `found`; return how many samples are agreed with and how many contradicted.

    samples: points and normals; those in the range `excluded` come from the surface itself.
    surface: points, normals and the image of their numbers, which begins at `corner`.
    warped: whether its points do not lie on the rays of their pixels.
    limits_mm: of agreement, and of a double surface.
    """
    points, normals = samples
    surface_points, surface_normals, numbers = surface
    index, at, shifts, against_index, against_at = found
    centre = -camera_from_rig[0].T @ camera_from_rig[1]
    agreed = contradicted = 0
    for n in range(len(points)):
        if excluded[0] <= n < excluded[1] or not _faces(points, normals, n, centre):
            continue
        x, y, z = _in_camera(points, n, camera_from_rig)
        if z <= 1.0:  # mm
            continue
        u, v = look_up(projection, x / z, y / z)
        column, row = int(np.rint(u)) - corner[0], int(np.rint(v)) - corner[1]
        there = _number_at(numbers, row, column)
        if warped and there >= 0:
            x, y, z = _in_camera(surface_points, there, camera_from_rig)
            at_u, at_v = look_up(projection, x / z, y / z)
            column, row = column + int(np.rint(u - at_u)), row + int(np.rint(v - at_v))
            there = _number_at(numbers, row, column)
        if there < 0:
            continue
        cosine = outward = 0.0
        for k in range(3):
            normal = surface_normals[there, k]
            cosine += normals[n, k] * normal
            outward += (surface_points[there, k] - points[n, k]) * normal
        same = cosine > 0.6  # may be one surface
        # Along the sample's normal to the tangent plane of the surface.
        shift = outward / cosine
        if same and abs(shift) <= limits_mm[0]:
            index[agreed], at[agreed], shifts[agreed] = n, there, shift
            agreed += 1
        elif (same and abs(shift) < limits_mm[1]) or outward < -limits_mm[0]:
            # A double surface close by, or a surface that was seen through the sample.
            against_index[contradicted], against_at[contradicted] = n, there
            contradicted += 1
    return agreed, contradicted


@compiled
def _number_at(numbers: Numbers, row: int, column: int) -> int:
    inside = 0 <= column < numbers.shape[1] and 0 <= row < numbers.shape[0]
    return int(numbers[row, column]) if inside else -1


@compiled
def _faces(points: Floats, normals: Floats, n: int, centre: Array) -> bool:
    """Whether a camera sees point n not edge-on: n.(centre - point) > 0.1 distance."""
    towards = distance2 = 0.0
    for k in range(3):
        away = centre[k] - points[n, k]
        towards += normals[n, k] * away
        distance2 += away * away
    return towards > 0 and towards * towards > 0.1**2 * distance2


@compiled
def _in_camera(
    points: Floats, n: int, camera_from_rig: tuple[Array, Array]
) -> tuple[float, float, float]:
    """Point n of the rig frame in the camera frame."""
    r, t = camera_from_rig
    x, y, z = points[n, 0], points[n, 1], points[n, 2]
    return (
        r[0, 0] * x + r[0, 1] * y + r[0, 2] * z + t[0],
        r[1, 0] * x + r[1, 1] * y + r[1, 2] * z + t[1],
        r[2, 0] * x + r[2, 1] * y + r[2, 2] * z + t[2],
    )
