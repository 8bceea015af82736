"""Aligned range images to one cloud: smooth each, thin, and average what several pairs saw.

Neighbours are found on pixel grids: inside an image by its own grid, in another image by
projecting the point into it. No search tree is built.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bodyscan.arrays import Floats
from bodyscan.errors import ScanFailed
from bodyscan.fusion.averaging import averaged
from bodyscan.fusion.brightness import gains, log_ratio
from bodyscan.fusion.comparing import Evidence, Samples, compare
from bodyscan.fusion.smoothing import Surface, smooth
from bodyscan.fusion.thinning import one_per_voxel, voxel_size_for
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.mesh.body import BodyCloud
from bodyscan.reconstruction.range_image import RangeImage

FEWEST_POINTS = 1000
SPOTS = 5000  # of an overlap are enough to compare exposures


@dataclass(frozen=True, eq=False)
class Merged:
    """A cloud, and of all that one pair said of another's points the share that spoke against them."""

    cloud: BodyCloud
    contradicted: float


def merge(range_images: Sequence[RangeImage], *placed: Any, **settings: Any) -> BodyCloud:
    """The cloud of `merged`."""
    return merged(range_images, *placed, **settings).cloud


def merged(
    range_images: Sequence[RangeImage],
    rig_from_camera: dict[str, RigidTransform],
    *,
    points: int = 1_000_000,
    window_mm: float = 7.0,
    agreement_mm: float = 1.5,
    double_mm: float = 6.0,
    workers: int = 2,
) -> Merged:
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
        compared = pool.map(
            lambda number: compare(samples, surfaces[number], number, agreement_mm, double_mm),
            range(len(surfaces)),
        )
        evidence = list(compared)
    gain = _evened(samples, surfaces, evidence)
    cloud = averaged(samples, surfaces, evidence, gain, workers)
    return Merged(cloud, _contradicted(evidence))


def _contradicted(evidence: Sequence[Evidence]) -> float:
    against = sum(one.against_index.size for one in evidence)
    return against / max(against + sum(one.index.size for one in evidence), 1)


def thinned(surfaces: Sequence[Surface], points: int) -> Samples:
    """About `points` evenly spread samples of all surfaces."""
    ends = np.cumsum([0, *(len(surface.points) for surface in surfaces)])
    if ends[-1] < FEWEST_POINTS:
        raise ScanFailed(
            f"the range images show next to nothing of a subject ({ends[-1]} points)",
            remedy="Look at the range images; is the subject inside the scan volume?",
        )

    pixels = [np.arange(len(surface.points)) for surface in surfaces]
    if ends[-1] > points:
        every = np.concatenate([surface.points for surface in surfaces])
        at_rim = np.concatenate([surface.rim < 0.5 for surface in surfaces])
        chosen = one_per_voxel(every, at_rim, voxel_size_for(every, points))
        parts = np.split(chosen, np.searchsorted(chosen, ends[1:-1]))
        pixels = [part - start for part, start in zip(parts, ends, strict=False)]

    def pooled(name: str) -> NDArray[Any]:
        fields = [getattr(surface, name) for surface in surfaces]
        taken = [field.take(some, axis=0) for field, some in zip(fields, pixels, strict=True)]
        return np.concatenate(taken)

    return Samples(
        pooled("points"),
        pooled("normals"),
        pooled("sigma_mm"),
        pooled("weight"),
        pooled("colours"),
        np.cumsum([0, *(some.size for some in pixels)]),
    )


def _evened(samples: Samples, surfaces: Sequence[Surface], evidence: Sequence[Evidence]) -> Floats:
    """(P,) factors for the surfaces' grey levels, from where two of them show one spot."""
    ratios = []
    for b, (surface, one) in enumerate(zip(surfaces, evidence, strict=True)):
        starts = np.searchsorted(one.index, samples.starts)
        for a, (start, end) in enumerate(pairwise(starts)):
            step = 1 + (end - start) // SPOTS
            some = slice(start, end, step)
            ours, theirs = samples.colours[one.index[some]], surface.colours[one.at[some]]
            ratio, spots = log_ratio(ours, theirs.astype(np.float32))
            ratios.append((a, b, ratio, spots * step))
    return gains([ratio for ratio in ratios if ratio[-1]], len(evidence))
