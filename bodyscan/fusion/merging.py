"""Merge aligned range images into one cloud: smooth each, thin, average what several pairs measured.

Neighbours are found on pixel grids: inside an image by its own grid, in another image by
projecting the point into it. No search tree is built.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from bodyscan.arrays import Array, Floats
from bodyscan.compiled import compiled
from bodyscan.fusion.brightness import EqualizedColours, equalize_colours
from bodyscan.fusion.consistency import (
    Consistency,
    Contradictions,
    compare_with_surface,
    estimate_displacement_sigma,
    number_cubes,
)
from bodyscan.fusion.smoothing import Numbers, SmoothSurface, smooth
from bodyscan.fusion.voxel_thinning import Samples, take_samples
from bodyscan.geometry.robust import SIGMAS_PER_MEDIAN
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.geometry.uncertainty import PoseCovariance
from bodyscan.mesh.body import BodyCloud
from bodyscan.progress import map_threads
from bodyscan.reconstruction.range_image import RangeImage
from bodyscan.settings import FusionSettings


@dataclass(frozen=True, eq=False)
class MergedCloud:
    """A cloud, and how much the pairs contradict each other's points."""

    cloud: BodyCloud
    contradictions: Contradictions


def merge(
    range_images: Sequence[RangeImage],
    rig_from_camera: dict[str, RigidTransform],
    settings: FusionSettings,
    *,
    poses: PoseCovariance | None = None,
) -> MergedCloud:
    """Merge aligned, cleaned range images into one even cloud of about `settings.points` points.

    poses: how well the pairs' poses are known; None for exactly. See `estimate_sigma_inflation`.

    Surfaces of two pairs within `settings.agreement_mm` along the normal are averaged by weight; of
    a double surface within `settings.double_mm` the heavier one stays. Raises ScanFailed for images
    that show next to nothing.
    """
    channels = 1 if all(image.rgb is None for image in range_images) else 3
    smoothed = map_threads(
        lambda im: smooth(im, rig_from_camera[im.pair], settings.window_mm, channels=channels),
        range_images,
    )
    surfaces = [surface for surface in smoothed if surface is not None]
    samples = take_samples(surfaces, settings.points)
    limits_mm = settings.agreement_mm, settings.double_mm
    consistency = map_threads(
        lambda k: compare_with_surface(samples, surfaces[k], k, *limits_mm), range(len(surfaces))
    )
    colours = equalize_colours(samples, surfaces, consistency)
    inside = [one.leave_out_rims(s) for one, s in zip(consistency, surfaces, strict=True)]
    displaced_mm, double = estimate_displacement_sigma(samples, surfaces, inside)
    cloud = average(samples, surfaces, consistency, colours, poses, displaced_mm)
    pairs = [surface.pair for surface in surfaces]
    found = Contradictions.count(pairs, inside, samples, surfaces, settings.agreement_mm)
    return MergedCloud(cloud, replace(found, double=double))


def average(
    samples: Samples,
    surfaces: Sequence[SmoothSurface],
    consistency: Sequence[Consistency],
    colours: EqualizedColours,
    poses: PoseCovariance | None = None,
    displaced_mm: Array | float = 0.0,
) -> BodyCloud:
    """Average each sample with the surfaces that agree with it; outvoted samples are dropped.

    displaced_mm: what is added to the samples' sigmas, (N,), see `estimate_displacement_sigma`.
    """
    weight, sigma_mm = samples.weight, samples.sigma_mm
    # Of weights, shifts, variances, surfaces, contradictions, normals, and colours.
    sums = np.zeros((len(weight), 8 + colours.samples.shape[1]))
    sums[:, 0], sums[:, 2], sums[:, 3] = weight, (weight * sigma_mm) ** 2, 1.0
    sums[:, 5:8], sums[:, 8:] = weight[:, None] * samples.normals, weight[:, None] * colours.samples
    for surface, one, levels in zip(surfaces, consistency, colours.surfaces, strict=True):
        observed = surface.weight, surface.sigma_mm, levels, surface.normals
        _add_surface(one.index, one.at, one.shift_mm, observed, sums)
        np.add.at(sums[:, 4], one.against_index, surface.weight[one.against_at])
    kept = sums[:, 4] < sums[:, 0]
    total, shift, variance, count = sums[kept, :4].T
    normals, levels = sums[kept, 5:8], sums[kept, 8:] / total[:, None]
    mean = shift / total
    inflation = estimate_sigma_inflation(samples, surfaces, consistency, poses)[kept]
    sigma_mm = inflation * np.sqrt(variance) / total
    displaced_mm = np.broadcast_to(displaced_mm, kept.shape)[kept]
    return BodyCloud(
        samples.points[kept] + mean[:, None] * samples.normals[kept],
        (normals / np.linalg.norm(normals, axis=1, keepdims=True)).astype(np.float32),
        np.hypot(sigma_mm, displaced_mm).astype(np.float32),
        np.clip(np.rint(levels), 0.0, 255.0).astype(np.uint8).repeat(3 // levels.shape[1], axis=1),
        count.astype(np.uint8),
    )


@compiled
def _add_surface(
    index: Numbers,
    at: Numbers,
    shift_mm: Floats,
    surface: tuple[Floats, Floats, Floats, Floats],
    sums: Array,
) -> None:
    """Add a surface's points `at`, shifted from the samples `index`, to the sums (N, 8 + C).

    shift_mm: signed, along the sample's normal. surface: weights, sigmas, colours (n, C) and normals of
        its points. sums: columns as listed in `average`.
    """
    weights, sigma_mm, colours, normals = surface
    for n in range(len(index)):
        into, k, shift = sums[index[n]], at[n], np.float64(shift_mm[n])
        weight = np.float64(weights[k])
        into[0] += weight
        into[1] += weight * shift
        into[2] += (weight * sigma_mm[k]) ** 2
        into[3] += 1.0
        for c in range(3):
            into[5 + c] += weight * normals[k, c]
        for c in range(colours.shape[1]):
            into[8 + c] += weight * colours[k, c]


def estimate_sigma_inflation(
    samples: Samples,
    surfaces: Sequence[SmoothSurface],
    consistency: Sequence[Consistency],
    poses: PoseCovariance | None = None,
) -> Array:
    """Sigma of the distances between pairs over their predicted sigmas, around each sample (N,): in
    cubes of 20 mm, as hems and folds are; at least that of all, robustly, and 1.

    Errors of the pairs' poses are part of the prediction here, because they are no errors of the
    points; `pose_variance` adds them to the points' sigmas. One point in 8 takes part.
    """
    ratios = [np.empty(0)]
    for surface, one in zip(surfaces, consistency, strict=True):
        index, shift_mm = one.index[::8], one.shift_mm[::8]
        variance = samples.sigma_mm[index] ** 2 + surface.sigma_mm[one.at[::8]] ** 2
        if poses is not None:
            variance += _compute_pose_variance(samples, index, surfaces, surface.pair, poses)
        ratios.append(np.abs(shift_mm) / np.sqrt(variance))
    every = np.concatenate(ratios)
    overall = max(1.0, SIGMAS_PER_MEDIAN * float(np.median(every)) if every.size else 1.0)
    cube = number_cubes(samples.points, 20.0)
    at = cube[np.concatenate([one.index[::8] for one in consistency])]
    squares = np.bincount(at, np.minimum(every, 10.0) ** 2, int(cube.max()) + 1)
    # Neighbours share errors: five count as one, as does what holds of all. Less one standard error.
    count = 5.0 + np.bincount(at, minlength=len(squares))
    local = (5.0 * overall**2 + squares) / count - overall**2 * np.sqrt(10.0 / count)
    return np.sqrt(np.maximum(local, overall**2))[cube]


def _compute_pose_variance(
    samples: Samples,
    index: Numbers,
    surfaces: Sequence[SmoothSurface],
    other: str,
    poses: PoseCovariance,
) -> Floats:
    """Variance (n,) mm^2 along the normals of samples `index`, by the poses of their pairs relative
    to the pair `other`."""
    variance = np.empty(len(index), np.float32)
    ends = np.searchsorted(index, samples.starts)
    for surface, (first, last) in zip(surfaces, pairwise(ends), strict=True):
        points, normals = samples.points[index[first:last]], samples.normals[index[first:last]]
        lever = np.hstack([np.cross(points, normals), normals])
        variance[first:last] = np.sum(lever @ poses.relative(surface.pair, other) * lever, axis=1)
    return variance
