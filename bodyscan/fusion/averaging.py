"""Weighted means of what several range images say about each point of a body."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bodyscan.arrays import Array, Bytes, Floats
from bodyscan.compiled import compiled
from bodyscan.fusion.brightness import EvenGrey
from bodyscan.fusion.evidence import Evidence
from bodyscan.fusion.quadratic_fit import NORMAL_MEDIAN
from bodyscan.fusion.smoothing import SmoothSurface
from bodyscan.fusion.thinning import Samples
from bodyscan.geometry.pose_covariance import PoseCovariance
from bodyscan.mesh.body import BodyCloud
from bodyscan.progress import THREADS

AT_A_TIME = 1 << 16  # samples whose sums fit into a processor's cache
EVERY = 8  # one spot of an overlap in this many is used to find how far apart surfaces are
# Columns of the sums over the surfaces that show a point, its own included: weights; weights
# times shift, its square, grey level, normal; squares of weight times sigma; weights against it.
WEIGHT, SHIFT, SHIFT2, GREY, SPREAD, AGAINST, NORMAL, SUMS = 0, 1, 2, 3, 4, 5, 6, 9


def average(
    samples: Samples,
    surfaces: Sequence[SmoothSurface],
    evidence: Sequence[Evidence],
    grey: EvenGrey,
    poses: PoseCovariance | None = None,
    workers: int = THREADS,
) -> BodyCloud:
    """Average each sample with what agrees with it; outvoted samples are dropped.

    poses: how well the pairs' poses are known, None for exactly.
    """
    general = scatter(samples, surfaces, evidence, poses) ** 2

    def part(start: int) -> tuple[NDArray[Any], ...]:
        some = slice(start, start + AT_A_TIME)
        normals, sigma_mm = samples.normals[some], samples.sigma_mm[some]
        sums, seen = _own_sums(normals, sigma_mm, samples.weight[some], grey.samples[some])
        for surface, one, levels in zip(surfaces, evidence, grey.surfaces, strict=True):
            facts = (surface.normals, surface.sigma_mm, surface.weight, levels)
            here = slice(*np.searchsorted(one.index, (some.start, some.stop)))
            agreed = one.index[here] - start, one.at[here], one.shift_mm[here]
            _add(facts, *agreed, sums, seen)
            here = slice(*np.searchsorted(one.against_index, (some.start, some.stop)))
            weights = surface.weight[one.against_at[here]]
            sums[one.against_index[here] - start, AGAINST] += weights
        return _means(samples.points[some], normals, sums, seen, general)

    with ThreadPoolExecutor(workers) as pool:
        parts = list(pool.map(part, range(0, len(samples.points), AT_A_TIME)))
    return BodyCloud(*(np.concatenate(fields) for fields in zip(*parts, strict=True)))


def scatter(
    samples: Samples,
    surfaces: Sequence[SmoothSurface],
    evidence: Sequence[Evidence],
    poses: PoseCovariance | None = None,
) -> float:
    """Typical distance between pairs in units of its predicted sigma; at least 1.

    Errors of the pairs' poses set their surfaces apart too, but are no fault of the points: they
    are part of the prediction here, and `pose_variance` adds them to the points' sigmas once.
    """
    ratios = [np.empty(0)]
    for surface, one in zip(surfaces, evidence, strict=True):
        index, shift_mm = one.index[::EVERY], one.shift_mm[::EVERY]
        variance = samples.sigma_mm[index] ** 2 + surface.sigma_mm[one.at[::EVERY]] ** 2
        if poses is not None:
            variance += _apart_by_poses(samples, index, surfaces, surface.pair, poses)
        ratios.append(np.abs(shift_mm) / np.sqrt(variance))
    every = np.concatenate(ratios)
    return max(1.0, float(np.median(every)) / NORMAL_MEDIAN) if every.size else 1.0


def _apart_by_poses(
    samples: Samples,
    index: NDArray[np.int32],
    surfaces: Sequence[SmoothSurface],
    other: str,
    poses: PoseCovariance,
) -> Floats:
    """Variance (n,) mm^2, along the normals of samples `index`, of the pair `other` against the
    samples' own pairs."""
    variance = np.empty(len(index), np.float32)
    ends = np.searchsorted(index, samples.starts)
    for own, (first, last) in zip(surfaces, pairwise(ends), strict=True):
        points, normals = samples.points[index[first:last]], samples.normals[index[first:last]]
        lever = np.hstack([np.cross(points, normals), normals])
        variance[first:last] = np.sum(lever @ poses.between(own.pair, other) * lever, axis=1)
    return variance


@compiled
def _own_sums(
    normals: Floats, sigma_mm: Floats, weights: Floats, levels: Floats
) -> tuple[Array, Bytes]:
    """Sums (N, 9) over the samples' own surfaces alone, and how many surfaces showed each (one)."""
    sums = np.zeros((len(weights), SUMS))
    for n in range(len(weights)):
        weight = float(weights[n])
        sums[n, WEIGHT], sums[n, GREY] = weight, weight * levels[n]
        sums[n, SPREAD] = (weight * sigma_mm[n]) ** 2
        for k in range(3):
            sums[n, NORMAL + k] = weight * normals[n, k]
    return sums, np.ones(len(weights), np.uint8)


@compiled
def _add(
    surface: tuple[Floats, Floats, Floats, Floats],
    index: NDArray[np.int32],
    at: NDArray[np.int32],
    shifts: Floats,
    sums: Array,
    seen: Bytes,
) -> None:
    """Add points `at` of a surface (normals, sigmas, weights, greys) to the sums at `index`."""
    normals, sigma_mm, weights, levels = surface
    for n in range(len(index)):
        here, there = index[n], at[n]
        weight, shift = float(weights[there]), shifts[n]
        sums[here, WEIGHT] += weight
        sums[here, SHIFT] += weight * shift
        sums[here, SHIFT2] += weight * shift * shift
        sums[here, GREY] += weight * levels[there]
        sums[here, SPREAD] += (weight * sigma_mm[there]) ** 2
        for k in range(3):
            sums[here, NORMAL + k] += weight * normals[there, k]
        seen[here] += 1


@compiled
def _means(
    points: Floats, normals: Floats, sums: Array, seen: Bytes, general: float
) -> tuple[Array, Floats, Floats, Bytes, Bytes]:
    """Points, normals, sigmas, colours and number of pairs for what was not outvoted.

    If pairs disagree by more than their sigmas predict (`general`, in variances), every sigma is
    enlarged by that; places that disagree by more than three times their sigmas get even more.
    """
    kept = np.flatnonzero(sums[:, AGAINST] < sums[:, WEIGHT])
    where, turned = np.empty((len(kept), 3)), np.empty((len(kept), 3), np.float32)
    sigma, grey = np.empty(len(kept), np.float32), np.empty((len(kept), 3), np.uint8)
    for n in range(len(kept)):
        of = sums[kept[n]]
        mean = of[SHIFT] / of[WEIGHT]
        apart = of[SHIFT2] - of[WEIGHT] * mean * mean
        chi2 = apart / max(seen[kept[n]] - 1, 1)
        sigma[n] = np.sqrt(of[SPREAD] * max(general, chi2 / 9.0)) / of[WEIGHT]
        x, y, z = of[NORMAL], of[NORMAL + 1], of[NORMAL + 2]
        length = np.sqrt(x * x + y * y + z * z)
        for k in range(3):
            where[n, k] = points[kept[n], k] + mean * normals[kept[n], k]
            turned[n, k] = of[NORMAL + k] / length
            grey[n, k] = min(max(np.rint(of[GREY] / of[WEIGHT]), 0.0), 255.0)
    return where, turned, sigma, grey, seen[kept]
