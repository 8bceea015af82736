"""Merge aligned range images into one cloud: smooth each, thin, average what several pairs measured.

Neighbours are found on pixel grids: inside an image by its own grid, in another image by
projecting the point into it. No search tree is built.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bodyscan.arrays import Array, Bytes, Floats
from bodyscan.fusion.brightness import EqualizedGrey, equalize_brightness
from bodyscan.fusion.consistency import Consistency, Contradictions, compare_with_surface
from bodyscan.fusion.quadratic_fit import NORMAL_MEDIAN
from bodyscan.fusion.smoothing import Numbers, SmoothSurface, smooth
from bodyscan.fusion.voxel_thinning import Samples, take_samples
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.geometry.uncertainty import PoseCovariance
from bodyscan.mesh.body import BodyCloud
from bodyscan.progress import THREADS
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
    workers: int = THREADS,
) -> MergedCloud:
    """Merge aligned, cleaned range images into one even cloud of about `settings.points` points.

    poses: how well the pairs' poses are known; None for exactly. See `estimate_sigma_inflation`.

    Surfaces of two pairs within `settings.agreement_mm` along the normal are averaged by weight; of
    a double surface within `settings.double_mm` the heavier one stays. Raises ScanFailed for images
    that show next to nothing.
    """
    with ThreadPoolExecutor(workers) as pool:
        smoothed = pool.map(
            lambda image: smooth(image, rig_from_camera[image.pair], settings.window_mm),
            range_images,
        )
        surfaces = [surface for surface in smoothed if surface is not None]
        samples = take_samples(surfaces, settings.points)
        compared = pool.map(
            lambda number: compare_with_surface(
                samples, surfaces[number], number, settings.agreement_mm, settings.double_mm
            ),
            range(len(surfaces)),
        )
        consistency = list(compared)
    grey = equalize_brightness(samples, surfaces, consistency)
    cloud = average(samples, surfaces, consistency, grey, poses, workers)
    pairs = [surface.pair for surface in surfaces]
    contradictions = Contradictions.count(
        pairs, consistency, samples, surfaces, settings.agreement_mm
    )
    return MergedCloud(cloud, contradictions)


def average(
    samples: Samples,
    surfaces: Sequence[SmoothSurface],
    consistency: Sequence[Consistency],
    grey: EqualizedGrey,
    poses: PoseCovariance | None = None,
    workers: int = THREADS,
) -> BodyCloud:
    """Average each sample with the surfaces that agree with it; outvoted samples are dropped."""
    block = 1 << 16  # samples whose sums fit into a processor's cache
    inflation = estimate_sigma_inflation(samples, surfaces, consistency, poses) ** 2

    def part(start: int) -> tuple[NDArray[Any], ...]:
        some = slice(start, start + block)
        normals, sigma_mm = samples.normals[some], samples.sigma_mm[some]
        sums = _start_sums(normals, sigma_mm, samples.weight[some], grey.samples[some])
        for surface, one, levels in zip(surfaces, consistency, grey.surfaces, strict=True):
            here = slice(*np.searchsorted(one.index, (some.start, some.stop)))
            agreed = one.at[here], one.index[here] - start, one.shift_mm[here]
            _add_surface(surface, levels, *agreed, sums)
            here = slice(*np.searchsorted(one.against_index, (some.start, some.stop)))
            weights = surface.weight[one.against_at[here]]
            sums.against[one.against_index[here] - start] += weights
        return _average(samples.points[some], normals, sums, inflation)

    with ThreadPoolExecutor(workers) as pool:
        parts = list(pool.map(part, range(0, len(samples.points), block)))
    return BodyCloud(*(np.concatenate(fields) for fields in zip(*parts, strict=True)))


def estimate_sigma_inflation(
    samples: Samples,
    surfaces: Sequence[SmoothSurface],
    consistency: Sequence[Consistency],
    poses: PoseCovariance | None = None,
) -> float:
    """Robust sigma of the distances between pairs over their predicted sigmas; at least 1.

    Errors of the pairs' poses are part of the prediction here, because they are no errors of the
    points; `pose_variance` adds them to the points' sigmas. One point in 8 takes part.
    """
    ratios = [np.empty(0)]
    for surface, one in zip(surfaces, consistency, strict=True):
        index, shift_mm = one.index[::8], one.shift_mm[::8]
        variance = samples.sigma_mm[index] ** 2 + surface.sigma_mm[one.at[::8]] ** 2
        if poses is not None:
            variance += _pose_variance(samples, index, surfaces, surface.pair, poses)
        ratios.append(np.abs(shift_mm) / np.sqrt(variance))
    every = np.concatenate(ratios)
    return max(1.0, float(np.median(every)) / NORMAL_MEDIAN) if every.size else 1.0


def _pose_variance(
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


class _Sums(NamedTuple):
    """Sums (N,) over the pairs that show each of N samples, the sample's own pair included.

    weight, against: of weights, and of those of surfaces that contradict the sample.
    shift, square, grey, normal: of weights times shift, its square, grey level and normal (N, 3).
    variance: of the squares of weights times sigmas.
    pairs: their number.
    """

    weight: Array
    shift: Array
    square: Array
    grey: Array
    normal: Array
    variance: Array
    against: Array
    pairs: Array


def _start_sums(normals: Floats, sigma_mm: Floats, weights: Floats, grey: Floats) -> _Sums:
    shift, square, against = np.zeros((3, len(weights)))
    return _Sums(
        weights.astype(np.float64),
        shift,
        square,
        (weights * grey).astype(np.float64),
        (weights[:, None] * normals).astype(np.float64),
        ((weights * sigma_mm) ** 2).astype(np.float64),
        against,
        np.ones(len(weights)),
    )


def _add_surface(
    surface: SmoothSurface, grey: Floats, at: Numbers, here: Numbers, shift: Floats, sums: _Sums
) -> None:
    """Add a surface's points `at` to the sums of the samples `here`, each of which comes once."""
    weight = surface.weight[at].astype(np.float64)
    sums.weight[here] += weight
    sums.shift[here] += weight * shift
    sums.square[here] += weight * shift * shift
    sums.grey[here] += weight * grey[at]
    sums.variance[here] += (weight * surface.sigma_mm[at]) ** 2
    sums.normal[here] += weight[:, None] * surface.normals[at]
    sums.pairs[here] += 1


def _average(
    points: Floats, normals: Floats, sums: _Sums, inflation: float
) -> tuple[Array, Floats, Floats, Bytes, Bytes]:
    """Points, normals, sigmas, colours and number of pairs of the samples that were not outvoted.

    inflation: variance of the pairs' differences over the predicted one. It enlarges sigmas, and
        differences of more than three sigmas enlarge them more.
    """
    kept = sums.against < sums.weight
    sums = _Sums(*(field[kept] for field in sums))
    mean = sums.shift / sums.weight
    chi2 = (sums.square - sums.weight * mean**2) / np.maximum(sums.pairs - 1.0, 1.0)
    sigma_mm = np.sqrt(sums.variance * np.maximum(inflation, chi2 / 9.0)) / sums.weight
    normal = sums.normal / np.linalg.norm(sums.normal, axis=1, keepdims=True)
    grey = np.clip(np.rint(sums.grey / sums.weight), 0.0, 255.0).astype(np.uint8)
    return (
        points[kept] + mean[:, None] * normals[kept],
        normal.astype(np.float32),
        sigma_mm.astype(np.float32),
        np.repeat(grey[:, None], 3, axis=1),
        sums.pairs.astype(np.uint8),
    )
