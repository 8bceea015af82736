"""Scan one person: images to range images, these to a cloud and a mesh; save them with pictures.

Range images are cleaned, aligned, merged, judged and meshed.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING

import numpy as np

from bodyscan.alignment.icp import align
from bodyscan.alignment.sway_prior import SwayPrior, select_tighter
from bodyscan.arrays import Array, Indices
from bodyscan.captures.folder import Captures, ImageSequence, open_scan
from bodyscan.errors import BodyscanError, CaptureError, ScanFailed
from bodyscan.fusion import storage
from bodyscan.fusion.cleaning import clean, require_subject
from bodyscan.fusion.consistency import Contradictions
from bodyscan.fusion.merging import MergedCloud, merge
from bodyscan.fusion.meshing import attach_attributes, make_closed_surface, require_closed
from bodyscan.fusion.pose_variance import add_motion_variance, add_pose_variance
from bodyscan.fusion.regions import label_regions
from bodyscan.fusion.storage import Made, Origin, Scan, ignore_made
from bodyscan.fusion.verdict import grade_scan
from bodyscan.fusion.verdict.coverage import measure_coverage
from bodyscan.fusion.verdict.evidence import ImageEvidence, RigEvidence, ScanEvidence
from bodyscan.fusion.verdict.overlaps import find_seams
from bodyscan.fusion.verdict.rig import (
    find_compressed,
    find_exchanged,
    find_floor,
    find_misplaced,
    find_silent_poles,
)
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.geometry.uncertainty import PoseCovariance
from bodyscan.mesh.body import BodyCloud, BodyMesh
from bodyscan.motion.estimation import EstimatedMotion
from bodyscan.motion.person_alignment import PersonAlignment, align_person
from bodyscan.motion.person_motion import PersonMotion
from bodyscan.motion.warping import warp_to_middle
from bodyscan.outcome import Outcome
from bodyscan.progress import Progress, background, silent, step
from bodyscan.reconstruction.range_image import RangeImage
from bodyscan.registration.rig_calibration import RigCalibration
from bodyscan.registration.storage import calibration_id, load_calibration
from bodyscan.report.pictures import Pictures, draw_pictures, write_pictures
from bodyscan.settings import AlignmentSettings, FusionSettings, ScanSettings
from bodyscan.verdict import Announce, Verdict, say_nothing
from bodyscan.workflows.range_images import (
    Preparation,
    Reconstructed,
    reconstruct_range_images,
    reconstruct_sequence,
)

if TYPE_CHECKING:
    from bodyscan.mesh.sliced_parts import BodyParts


def scan_person(
    calibration: RigCalibration,
    captures: Captures,
    settings: ScanSettings,
    progress: Progress = silent,
    *,
    empty: Captures | None = None,
    reconstructed: Mapping[ImageSequence, Reconstructed] = MappingProxyType({}),
    announce: Announce = say_nothing,
    made: Made = ignore_made,
) -> Scan:
    """Make a body model and mesh from images of a person.

    empty: captures of the rig with nobody in it, whose surfaces are not part of the subject.
    reconstructed: see `reconstruct_range_images`.
    announce, made: see `fuse`.

    Raises ScanFailed if no pair, or no part of a body inside the scan volume, is left; CaptureError
    if a pair took stripes in two shots.
    """
    require_single_shot(captures)
    images = reconstruct_range_images(
        calibration, captures, progress, made=reconstructed, volume_only=True
    )
    nobody = empty and reconstruct_range_images(calibration, empty, progress, volume_only=True)

    def read_as(one: str, other: str) -> RangeImage | None:
        sequence = next(s for s in captures.pair_sequences(one) if s.has_stripes)
        with suppress(BodyscanError):
            exchanged = replace(sequence, pair=other)
            return reconstruct_sequence(calibration, captures, exchanged, volume_only=True)[0]
        return None

    return fuse(
        calibration, images, settings, progress,
        empty=nobody.value if nobody else (), announce=announce, made=made, read_as=read_as,
    )  # fmt: skip


def require_single_shot(captures: Captures) -> None:
    """Raise CaptureError if a pair took its stripes twice: two poses, or two persons, would be one."""
    shots: dict[str, list[str]] = {}
    for sequence in captures.sequences:
        if sequence.has_stripes:
            shots.setdefault(sequence.pair, []).append(sequence.shot)
    pair, taken = max(shots.items(), key=lambda one: len(one[1]), default=("", []))
    if len(taken) > 1:
        raise CaptureError(
            f"pair {pair} has stripe sequences from {len(taken)} shots ({', '.join(taken[:3])}); a "
            "scan uses one",
            where=str(captures.folders[0]),
            remedy="put each shot into a folder of its own, or name the one that counts in its "
            f"captures.yaml: `shots: [{{name: {taken[0]}}}]`",
        )


def scan_folder(
    folder: Path,
    calibration: Path,
    out: Path,
    settings: ScanSettings,
    progress: Progress = silent,
    *,
    empty: Path | None = None,
    follow_links: bool = False,
    preparation: Preparation | None = None,
    announce: Announce = say_nothing,
    made: Made | None = None,
) -> tuple[Scan, Path, Outcome[list[Path]]]:
    """Scan a capture folder; return the scan, its scan.json in `out` and the pictures beside it.

    Earlier results in `out` are removed. Pictures are drawn while a core is free, the cloud's
    during meshing and the mesh's during judging, and written once the result is saved.

    empty: captures of the rig with nobody in it.
    follow_links: follow links even if the calibration's rig file does not allow it.
    preparation: what was loaded and decoded before.
    announce: called with the verdict on the points alone, and with the final one once the cloud and
        the mesh are saved.
    made: called with the cloud and the mesh while pictures of them are drawn.

    Raises ScanFailed after recording it in scan.json.
    """
    rig = preparation.refresh() if preparation else load_calibration(calibration)
    described = rig.rig.model_copy(update={"follow_links": True}) if follow_links else rig.rig
    captures = open_scan(described, folder)
    nobody = open_scan(described, empty) if empty else None
    reconstructed = preparation.take(captures) if preparation else {}
    origin = Origin(
        calibration_id(calibration), captures.subject, captures.when, captures.simulated, rig.axes
    )
    drawn: list[Future[Pictures]] = []
    with background() as other:

        def draw(body: BodyCloud | BodyMesh) -> None:
            if made is not None:
                other.submit(made, body)
            drawn.append(other.submit(draw_pictures, body))

        try:
            scan = scan_person(
                rig, captures, settings, progress,
                empty=nobody, reconstructed=reconstructed, announce=announce, made=draw,
            )  # fmt: skip
        except ScanFailed as error:
            storage.clear(out)
            storage.save_failure(error, out, origin)
            raise
        storage.clear(out)
        with step(progress, "writing"), storage.save_body(scan, out) as digests:
            announce(scan.verdict, final=True)
            pictures = write_pictures((each.result() for each in drawn), out)
            # Last, so that what is killed before its end is no result, and is made again.
            saved = storage.save_facts(scan, out, origin, digests)
    return scan, saved, pictures


@dataclass(frozen=True, eq=False)
class _Subject:
    """Range images that show something of the subject, carried to one moment if it moved."""

    images: Sequence[RangeImage]
    # The pairs' poses after alignment; as calibrated for those that saw nothing.
    rig_from_camera: dict[str, RigidTransform]
    covariance: PoseCovariance  # of these poses
    aligned: PersonAlignment | None = None  # what alignment found; None if it took no part

    @property
    def image_poses(self) -> dict[str, RigidTransform]:
        """Poses of the images' own pairs."""
        return {image.pair: self.rig_from_camera[image.pair] for image in self.images}

    @property
    def motion(self) -> EstimatedMotion | None:
        return self.aligned.motion if self.aligned else None

    @cached_property
    def person(self) -> PersonMotion | None:
        return PersonMotion.from_motion(self.motion) if self.motion else None


def fuse(
    calibration: RigCalibration,
    measured: Outcome[Sequence[RangeImage]],
    settings: ScanSettings,
    progress: Progress = silent,
    *,
    empty: Sequence[RangeImage] = (),
    announce: Announce = say_nothing,
    made: Made = ignore_made,
    read_as: Callable[[str, str], RangeImage | None] = lambda one, other: None,
) -> Scan:
    """Fuse range images of one person, background included, to a body model and mesh.

    measured: with pairs that gave none as failures.
    empty: as in `clean`.
    announce: called with the verdict on the points alone, before the mesh is made.
    made: called with the cloud while the mesh is made, and with the mesh while it is judged.
    read_as: gives the range image of one pair's images read as another's, if they can be.

    Raises ScanFailed if they show no body.
    """
    with step(progress, "cleaning"):
        calibrated, volume = calibration.rig_from_camera, calibration.rig.volume
        cleaned = clean(measured.value, calibrated, volume, empty=empty)
        subject = _Subject(require_subject(cleaned), dict(calibrated), calibration.covariance)
        seeing = {image.pair for image in subject.images}
        misplaced = find_misplaced(measured.value, seeing, calibrated, volume)
        measured = replace(measured, failures={**measured.failures, **misplaced})
    if settings.alignment.matching != "none" and len(subject.images) > 1:
        with step(progress, "aligning"):
            subject = _align(subject, calibration, settings.alignment)
    with step(progress, "merging"):
        merged = _merge(subject, settings.fusion)
    with step(progress, "judging"):
        images = _collect_image_evidence(
            calibration, measured, cleaned, subject, merged.contradictions
        )
        rig, facts = RigEvidence.from_calibration(calibration), (subject.aligned, subject.person)
        evidence = ScanEvidence(merged.cloud, rig, images, settings.use, *facts)
        evidence, verdict = _judge_points(evidence, measured.value, calibration, read_as)
        announce(verdict, final=False)
    with step(progress, "meshing"):
        cloud, mesh, parts = _mesh(merged.cloud, measured.value, subject, settings, made)
        # Also by the images of pairs that saw nothing of the subject.
        carried = {image.pair: image for image in subject.images}
        every = [carried.get(image.pair, image) for image in cleaned]
        coverage = measure_coverage(mesh, every, subject.rig_from_camera, calibration.pairs)
        verdict = grade_scan(replace(evidence, mesh=mesh, coverage=coverage, find_parts=parts))
    return Scan(
        cloud,
        mesh,
        subject.aligned.alignment if subject.aligned else None,
        {image.pair: int(image.valid.sum()) for image in cleaned},
        dict(measured.failures),
        verdict,
        tuple(subject.images),
        subject.rig_from_camera,
        subject.person,
        measured.notes,
    )


def _judge_points(
    evidence: ScanEvidence,
    images: Sequence[RangeImage],
    calibration: RigCalibration,
    read_as: Callable[[str, str], RangeImage | None],
) -> tuple[ScanEvidence, Verdict]:
    """Grade a scan by its points; of one that is to be repeated, also ask whether images of pairs were
    exchanged. Returns the evidence with that, and the verdict."""
    verdict = grade_scan(evidence)
    if verdict.grade != "repeat":
        return evidence, verdict
    poses, volume = calibration.rig_from_camera, calibration.rig.volume
    exchanged = find_exchanged(images, poses, volume, read_as)
    evidence = replace(evidence, images=replace(evidence.images, exchanged=exchanged))
    return evidence, grade_scan(evidence)


def _align(
    calibrated: _Subject, calibration: RigCalibration, settings: AlignmentSettings
) -> _Subject:
    """Align the images and carry them to one moment."""
    images, start, boards = calibrated.images, calibrated.rig_from_camera, calibrated.covariance
    settings = settings.widen_spacing(len(images))
    found = align(images, start, boards, settings)
    aligned = align_person(images, start, found, boards, calibration.rig.poles, settings)
    rig_from_camera = start | aligned.alignment.rig_from_camera
    images = warp_to_middle(images, rig_from_camera, aligned.motion)
    moved, covariance = aligned.alignment.motion_mm, boards
    if aligned.alignment.covariance is not None:
        # As the boards left them, if nobody moved; as the overlaps left them, whoever moved.
        covariance = select_tighter(boards, aligned.alignment.covariance, moved)
    unaligned = {image.pair for image in images} - moved.keys()
    covariance = SwayPrior.from_settings(settings).loosen(covariance, unaligned)
    return _Subject(images, rig_from_camera, covariance, aligned)


def _merge(subject: _Subject, settings: FusionSettings) -> MergedCloud:
    """Merge to one cloud; its sigmas include those of the pairs' poses and the person's motion."""
    # Following a person fits the pairs to each other: what it leaves between them is not the poses'.
    poses = None if subject.motion else subject.covariance
    merged = merge(subject.images, subject.rig_from_camera, settings, poses=poses)
    cloud = add_pose_variance(merged.cloud, subject.image_poses, subject.covariance)
    if subject.motion:
        cloud = add_motion_variance(merged.cloud, cloud, subject.motion)
    return replace(merged, cloud=cloud)


def _collect_image_evidence(
    calibration: RigCalibration,
    measured: Outcome[Sequence[RangeImage]],
    cleaned: Sequence[RangeImage],
    subject: _Subject,
    contradictions: Contradictions,
) -> ImageEvidence:
    poles = calibration.rig.poles
    seeing = [image.pair for image in subject.images]
    # What is said of pairs that failed explains why they saw nobody.
    tried = [image.pair for image in cleaned if image.pair not in measured.failures]
    displaced = subject.aligned.displaced if subject.aligned else ()
    moved = {name for one in displaced for name in one.pairs}
    unmoved = [image for image in measured.value if image.pair not in moved]
    return ImageEvidence(
        measured.failures,
        find_silent_poles(poles, tried, seeing),
        {image.pair: image.saturated for image in measured.value if image.overexposed},
        frozenset(calibration.rig_from_camera.keys() - set(seeing)),
        {image.pair: image.agreement for image in measured.value if image.agreement},
        find_seams(subject.images, subject.image_poses, poles),
        contradictions,
        find_floor(unmoved, calibration.rig_from_camera, calibration.rig.volume),
        compressed=find_compressed(measured.value),
        nonlinear=tuple(image.pair for image in measured.value if image.nonlinear),
    )


def _mesh(
    cloud: BodyCloud,
    measured: Sequence[RangeImage],
    subject: _Subject,
    settings: ScanSettings,
    made: Made,
) -> tuple[BodyCloud, BodyMesh, Callable[[], BodyParts]]:
    """Label the cloud's regions, and mesh it; the mesh holds its displacement to mean breath. Also
    returns what gives the parts of the mesh, or raises what went wrong with them."""

    def label() -> BodyCloud:
        regions = label_regions(
            cloud, subject.images, subject.image_poses, settings.fusion.window_mm
        )
        # A smooth surface leaves out how far strands of hair stand off it.
        sigma_mm = np.hypot(cloud.sigma_mm, regions.relief_mm)
        known = replace(cloud, sigma_mm=sigma_mm, regions=regions.numbers)
        made(known)
        return known

    with background() as other:
        # Meshing mostly uses one core, so the other does meanwhile what it can.
        labelling = other.submit(label)
        shape = make_closed_surface(cloud, settings.mesh, measured, subject.rig_from_camera)
        known, checking = labelling.result(), other.submit(require_closed, *shape)
        parts = other.submit(_find_parts, *shape)
        mesh = attach_attributes(*shape, known, settings.mesh.reach_mm)
        checking.result()
    if subject.motion:
        mesh = subject.motion.add_breath(mesh)
    made(mesh)
    return known, mesh, parts.result


def _find_parts(vertices: Array, faces: Indices) -> BodyParts:
    # It needs networkx, which takes an eighth of a second to import.
    from bodyscan.mesh.sliced_parts import find_mesh_parts

    return find_mesh_parts(vertices, faces)
