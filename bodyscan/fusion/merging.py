"""Merge aligned range images into one cloud: smooth each, thin, average what several pairs saw.

Neighbours are found on pixel grids: inside an image by its own grid, in another image by
projecting the point into it. No search tree is built.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

from bodyscan.fusion.averaging import average
from bodyscan.fusion.brightness import even_brightness
from bodyscan.fusion.contradictions import Contradictions
from bodyscan.fusion.evidence import compare
from bodyscan.fusion.smoothing import smooth
from bodyscan.fusion.thinning import take_samples
from bodyscan.geometry.pose_covariance import PoseCovariance
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.mesh.body import BodyCloud
from bodyscan.progress import THREADS
from bodyscan.reconstruction.range_image import RangeImage
from bodyscan.settings import FusionSettings


@dataclass(frozen=True, eq=False)
class MergedCloud:
    """A cloud, and what the pairs said against each other's points."""

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

    poses: how well the pairs' poses are known; None for exactly. See `averaging.scatter`.

    Surfaces of two pairs within `settings.agreement_mm` along the normal are averaged by weight;
    between that and `settings.double_mm` they are a double surface, of which the heavier one stays.
    Raises ScanFailed if the range images show next to nothing.
    """
    with ThreadPoolExecutor(workers) as pool:
        smoothed = pool.map(
            lambda image: smooth(image, rig_from_camera[image.pair], settings.window_mm),
            range_images,
        )
        shown = {
            image.pair: surface
            for image, surface in zip(range_images, smoothed, strict=True)
            if surface is not None
        }
        surfaces = list(shown.values())
        samples = take_samples(surfaces, settings.points)
        compared = pool.map(
            lambda number: compare(
                samples, surfaces[number], number, settings.agreement_mm, settings.double_mm
            ),
            range(len(surfaces)),
        )
        evidence = list(compared)
    grey = even_brightness(samples, surfaces, evidence)
    cloud = average(samples, surfaces, evidence, grey, poses, workers)
    found = Contradictions.of(list(shown), evidence, samples, surfaces, settings.agreement_mm)
    return MergedCloud(cloud, found)
