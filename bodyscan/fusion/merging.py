"""Aligned range images to one cloud: smooth each, thin, and average what several pairs saw.

Neighbours are found on pixel grids: inside an image by its own grid, in another image by
projecting the point into it. No search tree is built.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bodyscan.errors import ScanFailed
from bodyscan.fusion.body import BodyCloud
from bodyscan.fusion.brightness import gains, log_ratio
from bodyscan.fusion.grid import Floats, carried, rotated
from bodyscan.fusion.quadratics import NORMAL_MEDIAN
from bodyscan.fusion.smoothing import Surface, smooth
from bodyscan.fusion.thinning import one_per_voxel, voxel_size_for
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.reconstruction.range_image import RangeImage

FEWEST_POINTS = 1000
SAME_WAY = 0.6  # cosine between the normals of what may be one surface
EDGE_ON = 0.1  # a camera that sees a point flatter than this is not asked about it


@dataclass(frozen=True, eq=False)
class Samples:
    """N points taken from the surfaces, rig frame: `source` says which, `weight` as in Surface."""

    points: Floats
    normals: Floats
    sigma_mm: Floats
    weight: Floats
    colours: NDArray[np.uint8]
    source: NDArray[np.int16]


@dataclass(frozen=True, eq=False)
class Evidence:
    """What one other surface says about N samples, at `index` of them.

    shift_mm: from the sample along its normal to that surface.  normals, sigma_mm, weight,
    colours: of that surface there.  against: weight by which it contradicts the sample.
    """

    index: NDArray[np.intp]
    shift_mm: Floats
    normals: Floats
    sigma_mm: Floats
    weight: Floats
    colours: Floats
    against_index: NDArray[np.intp]
    against: Floats


def merge(
    range_images: Sequence[RangeImage],
    rig_from_camera: dict[str, RigidTransform],
    *,
    points: int = 1_000_000,
    window_mm: float = 7.0,
    agreement_mm: float = 1.5,
    double_mm: float = 6.0,
    workers: int = 2,
) -> BodyCloud:
    """One evenly spread cloud of about `points` points from aligned, cleaned range images.

    Surfaces of two pairs within `agreement_mm` along the normal are averaged by weight; between
    that and `double_mm` they are a double surface, of which the heavier one stays.
    Raises ScanFailed if the range images show next to nothing.
    """
    with ThreadPoolExecutor(workers) as pool:
        smoothed = pool.map(
            lambda image: smooth(image, rig_from_camera[image.pair], window_mm=window_mm),
            range_images,
        )
        surfaces = [surface for surface in smoothed if surface is not None]
        samples = thinned(surfaces, points)
        evidence = pool.map(
            lambda number: compare(samples, surfaces[number], number, agreement_mm, double_mm),
            range(len(surfaces)),
        )
        found = list(evidence)
    return averaged(samples, found, _evened(samples, found))


def thinned(surfaces: Sequence[Surface], points: int) -> Samples:
    """About `points` evenly spread samples of all surfaces."""
    pixels = [np.flatnonzero(surface.weight > 0) for surface in surfaces]
    ends = np.cumsum([some.size for some in pixels])
    total = int(ends[-1]) if surfaces else 0
    if total < FEWEST_POINTS:
        raise ScanFailed(
            f"the range images show next to nothing of a subject ({total} points)",
            remedy="Look at the range images; is the subject inside the scan volume?",
        )
    if total > points:
        every = np.concatenate(
            [s.points.reshape(-1, 3)[some] for s, some in zip(surfaces, pixels, strict=True)]
        )
        at_rim = np.concatenate(
            [s.rim.ravel()[some] < 0.5 for s, some in zip(surfaces, pixels, strict=True)]
        )
        chosen = one_per_voxel(every, at_rim, voxel_size_for(every, points))
        parts = np.split(chosen, np.searchsorted(chosen, ends[:-1]))
        starts = [0, *ends[:-1]]
        pixels = [
            some[part - start] for some, part, start in zip(pixels, parts, starts, strict=True)
        ]

    def pooled(name: str) -> NDArray[Any]:
        images = [getattr(surface, name) for surface in surfaces]
        flat = [image.reshape(-1, *image.shape[2:]) for image in images]
        return np.concatenate([image[some] for image, some in zip(flat, pixels, strict=True)])

    return Samples(
        pooled("points"),
        pooled("normals"),
        pooled("sigma_mm"),
        pooled("weight"),
        pooled("colours"),
        np.repeat(np.arange(len(pixels), dtype=np.int16), [some.size for some in pixels]),
    )


def compare(
    samples: Samples, surface: Surface, number: int, agreement_mm: float, double_mm: float
) -> Evidence:
    """What `surface` (the `number`th) says about the samples that do not come from it."""
    index, pixels = _seen_from(samples, surface, number)
    rows, columns = pixels
    normals, weight = surface.normals[rows, columns], surface.weight[rows, columns]
    own = samples.normals[index]
    alike = np.einsum("nc,nc->n", own, normals)
    offset = surface.points[rows, columns] - samples.points[index]
    outward = np.einsum("nc,nc->n", offset, normals)
    # Along the sample's normal to the tangent plane of the other surface.
    shift = outward / np.maximum(alike, SAME_WAY)
    same = alike > SAME_WAY
    agrees = same & (np.abs(shift) <= agreement_mm)
    # A second skin close by, or a surface that was seen through the sample.
    doubled = same & (np.abs(shift) < double_mm)
    contradicts = ~agrees & (doubled | (outward < -agreement_mm))
    return Evidence(
        index[agrees],
        shift[agrees],
        normals[agrees],
        surface.sigma_mm[rows, columns][agrees],
        weight[agrees],
        surface.colours[rows, columns][agrees].astype(np.float32),
        index[contradicts],
        weight[contradicts],
    )


def _seen_from(
    samples: Samples, surface: Surface, number: int
) -> tuple[NDArray[np.intp], tuple[NDArray[np.intp], NDArray[np.intp]]]:
    """Which samples face the camera and fall on a pixel of its surface: index, (rows, columns)."""
    camera_from_rig = surface.rig_from_camera.inverse()
    facing = rotated(samples.normals, camera_from_rig)
    in_camera = carried(samples.points, camera_from_rig)
    # n.(camera - point) > EDGE_ON * distance, and ahead of the camera.
    dots = -np.einsum("nc,nc->n", facing, in_camera)
    distance2 = np.einsum("nc,nc->n", in_camera, in_camera)
    faces = (dots > 0) & (dots * dots > EDGE_ON**2 * distance2) & (in_camera[:, 2] > 1.0)
    index = np.flatnonzero(faces & (samples.source != number))
    in_camera = in_camera[index]
    u, v = surface.camera.project(in_camera.astype(np.float64)).T
    columns = np.rint(u).astype(np.intp) - surface.corner[0]
    rows = np.rint(v).astype(np.intp) - surface.corner[1]
    height, width = surface.weight.shape
    inside = (columns >= 0) & (columns < width) & (rows >= 0) & (rows < height)
    index, rows, columns = index[inside], rows[inside], columns[inside]
    there = surface.weight[rows, columns] > 0
    return index[there], (rows[there], columns[there])


def _evened(samples: Samples, evidence: Sequence[Evidence]) -> Floats:
    """(P,) factors for the surfaces' grey levels, from where two of them show one spot."""
    ratios = []
    for b, one in enumerate(evidence):
        source = samples.source[one.index]
        for a in np.unique(source):
            shared = source == a
            ratio, spots = log_ratio(samples.colours[one.index[shared]], one.colours[shared])
            ratios.append((int(a), b, ratio, spots))
    return gains([ratio for ratio in ratios if ratio[-1]], len(evidence))


def averaged(samples: Samples, evidence: Sequence[Evidence], gain: Floats) -> BodyCloud:
    """Weighted means of each sample and what agrees with it; the outvoted are dropped.

    gain: (P,) factors for the surfaces' grey levels.
    """
    weight = samples.weight.astype(np.float64)
    against = np.zeros_like(weight)
    shift, shift2 = np.zeros_like(weight), np.zeros_like(weight)
    spread = np.square(samples.weight * samples.sigma_mm, dtype=np.float64)
    normals = samples.normals * samples.weight[:, None]
    colours = samples.colours * samples.weight * gain[samples.source]
    seen = np.ones(len(weight), np.uint8)
    for number, one in enumerate(evidence):
        at = one.index
        weight[at] += one.weight
        shift[at] += one.weight * one.shift_mm
        shift2[at] += one.weight * one.shift_mm**2
        spread[at] += np.square(one.weight * one.sigma_mm, dtype=np.float64)
        normals[at] += one.normals * one.weight[:, None]
        colours[at] += one.colours * one.weight * gain[number]
        seen[at] += 1
        against[one.against_index] += one.against
    kept = against < weight
    weight, seen, normals = weight[kept], seen[kept], normals[kept]
    mean = shift[kept] / weight
    # Pairs that disagree by more than their sigmas say make everything that much less certain,
    # and a place where they do so by more than three times that even more.
    general = disagreement(samples, evidence) ** 2
    chi2 = (shift2[kept] - weight * mean**2) / np.maximum(seen - 1, 1)
    grey = np.clip(np.rint(colours[kept] / weight), 0, 255).astype(np.uint8)
    return BodyCloud(
        samples.points[kept].astype(np.float64) + mean[:, None] * samples.normals[kept],
        (normals / np.linalg.norm(normals, axis=-1, keepdims=True)).astype(np.float32),
        (np.sqrt(spread[kept] * np.maximum(general, chi2 / 9.0)) / weight).astype(np.float32),
        np.repeat(grey[:, None], 3, axis=1),
        seen,
    )


def disagreement(samples: Samples, evidence: Sequence[Evidence]) -> float:
    """Typical distance between pairs over its standard deviation by their sigmas; at least 1."""
    ratios = [
        np.abs(one.shift_mm) / np.hypot(samples.sigma_mm[one.index], one.sigma_mm)
        for one in evidence
    ]
    every = np.concatenate(ratios) if ratios else np.empty(0)
    return max(1.0, float(np.median(every)) / NORMAL_MEDIAN) if every.size else 1.0
