"""What one smoothed range image says about points that others measured.

A point is projected into the image and compared with the surface at that pixel: no search tree.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bodyscan.arrays import Array, Floats
from bodyscan.compiled import compiled
from bodyscan.fusion.smoothing import SmoothSurface
from bodyscan.fusion.thinning import Samples
from bodyscan.geometry.camera_tables import projection_table
from bodyscan.geometry.quadratic_table import Table, look_up

Numbers = NDArray[np.int32]

SAME_WAY = 0.6  # cosine between the normals of what may be one surface
NEAREST_MM = 1.0  # points behind the camera are not examined
EDGE_ON = 0.1  # cameras that see a point flatter than this are not asked about it


@dataclass(frozen=True, eq=False)
class Evidence:
    """What one other surface says about samples, in their order.

    index: numbers of the samples that it agrees with.
    at: numbers of its points there.
    shift_mm: from the sample along its normal to that surface.
    against_index, against_at: the same where it contradicts the sample.
    """

    index: Numbers
    at: Numbers
    shift_mm: Floats
    against_index: Numbers
    against_at: Numbers


def compare(
    samples: Samples, surface: SmoothSurface, number: int, agreement_mm: float, double_mm: float
) -> Evidence:
    """What `surface` (number `number`) says about the samples that do not come from it.

    It agrees if it lies within `agreement_mm` of them, and contradicts them if it is a double
    surface within `double_mm`, or was seen through them.
    """
    count = len(samples.points)
    index, at = np.empty(count, np.int32), np.empty(count, np.int32)
    shift = np.empty(count, np.float32)
    against_index, against_at = np.empty(count, np.int32), np.empty(count, np.int32)
    camera_from_rig = surface.rig_from_camera.inverse()
    agreed, contradicted = _compare(
        (samples.points, samples.normals),
        (int(samples.starts[number]), int(samples.starts[number + 1])),
        (surface.points, surface.normals, surface.number),
        surface.corner,
        projection_table(surface.camera),
        (camera_from_rig.rotation, camera_from_rig.translation),
        surface.bent,
        (agreement_mm, double_mm),
        (index, at, shift, against_index, against_at),
    )
    return Evidence(
        index[:agreed].copy(),
        at[:agreed].copy(),
        shift[:agreed].copy(),
        against_index[:contradicted].copy(),
        against_at[:contradicted].copy(),
    )


@compiled
def _compare(
    samples: tuple[Floats, Floats],
    own: tuple[int, int],
    surface: tuple[Floats, Floats, Numbers],
    corner: tuple[int, int],
    projection: Table,
    camera_from_rig: tuple[Array, Array],
    bent: bool,
    limits_mm: tuple[float, float],
    evidence: tuple[Numbers, Numbers, Floats, Numbers, Numbers],
) -> tuple[int, int]:
    """Fill in the evidence; return how many samples are agreed with and how many contradicted.

    samples: points and normals.
    own: range of the samples that are the surface's own.
    surface: points, normals and the image of their numbers, which begins at `corner`.
    bent: whether its points are no longer seen at their pixels.
    limits_mm: of agreement, and of a double surface.
    """
    points, normals = samples
    surface_points, surface_normals, numbers = surface
    index, at, shifts, against_index, against_at = evidence
    centre = -camera_from_rig[0].T @ camera_from_rig[1]
    agreed = contradicted = 0
    for n in range(len(points)):
        if own[0] <= n < own[1] or not _faces(points[n], normals[n], centre):
            continue
        x, y, z = _in_camera(points[n], camera_from_rig)
        if z <= NEAREST_MM:
            continue
        u, v = look_up(projection, x / z, y / z)
        column, row = int(np.rint(u)) - corner[0], int(np.rint(v)) - corner[1]
        if not (0 <= column < numbers.shape[1] and 0 <= row < numbers.shape[0]):
            continue
        there = numbers[row, column]
        if there < 0:
            continue
        if bent:
            x, y, z = _in_camera(surface_points[there], camera_from_rig)
            at_u, at_v = look_up(projection, x / z, y / z)
            column, row = column + int(np.rint(u - at_u)), row + int(np.rint(v - at_v))
            if not (0 <= column < numbers.shape[1] and 0 <= row < numbers.shape[0]):
                continue
            there = numbers[row, column]
            if there < 0:
                continue
        alike = outward = 0.0
        for k in range(3):
            normal = surface_normals[there, k]
            alike += normals[n, k] * normal
            outward += (surface_points[there, k] - points[n, k]) * normal
        same = alike > SAME_WAY
        # Along the sample's normal to the tangent plane of the surface.
        shift = outward / alike
        if same and abs(shift) <= limits_mm[0]:
            index[agreed], at[agreed], shifts[agreed] = n, there, shift
            agreed += 1
        elif (same and abs(shift) < limits_mm[1]) or outward < -limits_mm[0]:
            # A double surface close by, or a surface that was seen through the sample.
            against_index[contradicted], against_at[contradicted] = n, there
            contradicted += 1
    return agreed, contradicted


@compiled
def _faces(point: Floats, normal: Floats, centre: Array) -> bool:
    """Whether a point faces a camera's centre: n.(centre - point) > EDGE_ON * distance."""
    towards = distance2 = 0.0
    for k in range(3):
        away = centre[k] - point[k]
        towards += normal[k] * away
        distance2 += away * away
    return towards > 0 and towards * towards > EDGE_ON**2 * distance2


@compiled
def _in_camera(point: Floats, camera_from_rig: tuple[Array, Array]) -> tuple[float, float, float]:
    """A point of the rig frame in the camera frame."""
    r, t = camera_from_rig
    return (
        r[0, 0] * point[0] + r[0, 1] * point[1] + r[0, 2] * point[2] + t[0],
        r[1, 0] * point[0] + r[1, 1] * point[1] + r[1, 2] * point[2] + t[1],
        r[2, 0] * point[0] + r[2, 1] * point[1] + r[2, 2] * point[2] + t[2],
    )
