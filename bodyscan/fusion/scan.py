"""One person: range images aligned, merged to a body cloud, meshed and graded."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from bodyscan.alignment.bending import at_once
from bodyscan.alignment.body_parts import PersonMotion
from bodyscan.alignment.following import Followed
from bodyscan.alignment.icp import Alignment, align
from bodyscan.alignment.oblique_light import LightLine, ObliqueLight, take_out
from bodyscan.alignment.sway_prior import SwayPrior
from bodyscan.alignment.together import Together, bring_together
from bodyscan.fusion.cleaning import clean, require_subject
from bodyscan.fusion.floor import find_floor
from bodyscan.fusion.merging import merge
from bodyscan.fusion.meshing import attach_attributes, closed_surface
from bodyscan.fusion.pose_variance import add_motion_variance, add_pose_variance
from bodyscan.fusion.regions import label_regions
from bodyscan.fusion.scan_verdict import ImageEvidence, RigEvidence, grade_scan
from bodyscan.fusion.seams import judge_seams
from bodyscan.fusion.surface_check import check_surface
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.mesh.body import BodyCloud, BodyMesh, BreathAt
from bodyscan.outcome import Outcome
from bodyscan.progress import Progress, silent, step
from bodyscan.reconstruction.range_image import RangeImage
from bodyscan.registration.rig_calibration import RigCalibration
from bodyscan.settings import ScanSettings
from bodyscan.verdict import Announce, Verdict, say_nothing

Made = Callable[[BodyCloud | BodyMesh], None]
"""Called with a scan's cloud, and then with its mesh, as soon as each exists; from any thread."""


def no_use(body: BodyCloud | BodyMesh) -> None:
    """A `Made` that does nothing."""


@dataclass(frozen=True, eq=False)
class Scan:
    """A body model, how it was made, and whether it is good.

    measured: number of points in each pair's cleaned range image.
    failed: pairs that gave none, with the reason.
    range_images: cleaned, of the pairs that saw the subject, cropped to it and carried to one
        moment.
    rig_from_camera: each pair's pose relative to the subject, after alignment.
    person: how a moving body moved, part by part.
    notes: on the range images, such as stripes that were not used.
    oblique_light: how far aside light comes out of the skin, as far as overlaps show it.
    """

    cloud: BodyCloud
    mesh: BodyMesh
    alignment: Alignment | None
    measured: dict[str, int]
    failed: dict[str, str]
    verdict: Verdict
    range_images: tuple[RangeImage, ...]
    rig_from_camera: dict[str, RigidTransform]
    person: PersonMotion | None = None
    notes: tuple[str, ...] = ()
    oblique_light: ObliqueLight | None = None


def fuse(
    calibration: RigCalibration,
    measured: Outcome[Sequence[RangeImage]],
    settings: ScanSettings,
    progress: Progress = silent,
    *,
    empty: Sequence[RangeImage] = (),
    announce: Announce = say_nothing,
    made: Made = no_use,
) -> Scan:
    """Fuse range images of one person, background included, to a body model and mesh.

    measured: with pairs that gave none as failures.
    empty: as in `clean`.
    announce: called with the verdict on the points alone, before the mesh is made.
    made: called with the cloud while the mesh is made, and with the mesh while it is judged.

    Raises ScanFailed if they show no body.
    """
    images = measured.value
    with step(progress, "cleaning"):
        cleaned = clean(images, calibration.rig_from_camera, calibration.rig.volume, empty=empty)
        seen = require_subject(cleaned)
    placing = dict(calibration.rig_from_camera)
    alignment, followed, known = None, None, calibration.covariance
    together: Together | None = None
    oblique: ObliqueLight | None = None
    if settings.alignment.matching != "none" and len(seen) > 1:
        with step(progress, "aligning"):
            found = align(seen, placing, known, settings.alignment)
            lines = _light_lines(seen, calibration)
            if lines:
                seen, found, oblique = take_out(
                    seen, placing, found, lines, known, settings.alignment
                )
            together = bring_together(
                seen, placing, found, known, calibration.rig.poles, settings.alignment
            )
            alignment, followed = together.alignment, together.followed
            placing |= alignment.rig_from_camera
            seen = at_once(seen, placing, followed)
            untied = {image.pair for image in seen} - alignment.motion_mm.keys()
            known = SwayPrior.of(settings.alignment).loosen(known, untied)
    with step(progress, "merging"):
        fused = merge(seen, placing, settings.fusion)
        there = {image.pair: placing[image.pair] for image in seen}
        cloud = add_pose_variance(fused.cloud, there, known)
        if followed:
            cloud = add_motion_variance(fused.cloud, cloud, followed)
    person = PersonMotion.of(followed) if followed else None
    points = {image.pair: int(image.valid.sum()) for image in cleaned}
    failed = dict(measured.failures)

    with step(progress, "judging"):
        moved = {name for one in together.shifted for name in one.pairs} if together else set()
        floor = find_floor(
            [image for image in images if image.pair not in moved],
            calibration.rig_from_camera,
            calibration.rig.volume,
        )
        judged = partial(
            grade_scan,
            cloud,
            RigEvidence.of(calibration),
            ImageEvidence(
                failed,
                _silent(calibration.rig.poles, [*points, *failed], [image.pair for image in seen]),
                {image.pair: image.agreement for image in images if image.agreement},
                judge_seams(seen, there, calibration.rig.poles),
                fused.contradictions,
                floor,
            ),
            settings.use,
            together=together,
            person=person,
        )
        announce(judged(), final=False)

    def named() -> BodyCloud:
        regions = label_regions(cloud, seen, there, settings.fusion.window_mm)
        known = replace(cloud, regions=regions)
        made(known)
        return known

    with step(progress, "meshing"), ThreadPoolExecutor(1) as beside:
        # Meshing mostly uses one core, so regions are labelled on the other meanwhile.
        naming = beside.submit(named)
        shape = closed_surface(cloud, settings.mesh, images, placing)
        cloud = naming.result()
        surface = attach_attributes(*shape, cloud, settings.mesh.reach_mm)
        surface = _breathing(surface, followed)
        made(surface)
        carried = {image.pair: image for image in seen}
        at_once_or_empty = [carried.get(image.pair, image) for image in cleaned]
        held = check_surface(surface, at_once_or_empty, placing)
        verdict = judged(mesh=surface, surface=held)
    images, notes = tuple(seen), measured.notes
    return Scan(
        cloud, surface, alignment, points, failed, verdict, images, placing, person, notes, oblique
    )


def _light_lines(
    seen: Sequence[RangeImage], calibration: RigCalibration
) -> dict[str, LightLine] | None:
    """The light line of each pair.

    None if a pair has no light sheets, or if points come from stripes of both directions, each of
    which oblique light moves differently.
    """
    pairs = [calibration.pairs.get(image.pair) for image in seen]
    sheets = {pair.name: pair.sheets for pair in pairs if pair is not None}
    found = {name: LightLine.of(one) for name, one in sheets.items() if one is not None}
    lines = {name: line for name, line in found.items() if line is not None}
    return None if len(lines) < len(seen) or any(one.agreement for one in seen) else lines


def _silent(
    poles: Mapping[str, str], asked: Sequence[str], seeing: Sequence[str]
) -> tuple[str, ...]:
    """Poles of which no pair saw anybody; a single pair may look over a child's head."""
    count = Counter(poles[name] for name in asked if name in poles)
    seen = {poles.get(name) for name in seeing}
    return tuple(pole for pole, pairs in count.items() if pairs > 1 and pole not in seen)


def _breathing(surface: BodyMesh, followed: Followed | None) -> BodyMesh:
    """The mesh with the displacement to mean breath, where that is known."""
    if followed is None or followed.breath is None:
        return surface
    way, sigma = followed.breath.along(
        followed.cells, surface.vertices, surface.normals.astype(np.float64)
    )
    return replace(surface, breath=BreathAt(way.astype(np.float32), sigma.astype(np.float32)))
