"""One person: range images, aligned, merged to a body cloud, meshed."""

from __future__ import annotations

from dataclasses import dataclass, field

from bodyscan.calibration.rig_calibration import RigCalibration
from bodyscan.capture.folder import Captures
from bodyscan.errors import BadInput, ScanFailed
from bodyscan.fusion.body import BodyCloud, BodyMesh
from bodyscan.fusion.cleaning import clean
from bodyscan.fusion.merging import merge
from bodyscan.fusion.meshing import mesh
from bodyscan.progress import Progress, silent
from bodyscan.reconstruction.pairs import range_images
from bodyscan.registration.alignment import Alignment, AlignmentSettings, align

MOST_FILLED = 0.25
MOST_DISAGREEMENT_MM = 0.8


@dataclass(frozen=True)
class ScanSettings:
    """points: size of the body cloud.  alignment: of range images; None: not at all."""

    points: int = 1_000_000
    alignment: AlignmentSettings | None = field(default_factory=AlignmentSettings)


@dataclass(frozen=True, eq=False)
class Scan:
    """A body model and how it came about.  measured: points of each pair's cleaned range image.
    failed: pairs that gave none, with the reason.
    """

    cloud: BodyCloud
    mesh: BodyMesh
    alignment: Alignment | None
    measured: dict[str, int]
    failed: dict[str, str]


def alignment_settings(matching: str) -> AlignmentSettings | None:
    """Default settings with one way of matching: projected, nearest; none: no alignment.

    Raises BadInput for another word.
    """
    if matching == "none":
        return None
    if matching not in ("projected", "nearest"):
        raise BadInput(
            f"there is no alignment {matching!r}", remedy="choose projected, nearest or none"
        )
    return AlignmentSettings(matching="projected" if matching == "projected" else "nearest")


def scan(
    calibration: RigCalibration,
    captures: Captures,
    settings: ScanSettings = ScanSettings(),
    progress: Progress = silent,
) -> Scan:
    """Person images in, body model and mesh out.

    Raises ScanFailed if no pair, or no part of a body inside the scan volume, is left.
    """
    images, failed = range_images(calibration, captures, progress)
    progress("cleaning", 0, 1)
    cleaned = clean(images, calibration.rig_from_camera, calibration.rig.volume)
    seen = [image for image in cleaned if image.valid.any()]
    progress("cleaning", 1, 1)
    if not seen:
        raise ScanFailed(
            "nobody stands in the scan volume",
            remedy="look at the lit images; check `volume` in the rig file",
        )
    placing = dict(calibration.rig_from_camera)
    alignment = None
    if settings.alignment is not None and len(seen) > 1:
        progress("aligning", 0, 1)
        alignment = align(seen, placing, calibration.covariance, settings.alignment)
        placing |= alignment.rig_from_camera
        progress("aligning", 1, 1)
    progress("merging", 0, 1)
    cloud = merge(seen, placing, points=settings.points)
    progress("merging", 1, 1)
    progress("meshing", 0, 1)
    surface = mesh(cloud, images, placing)
    progress("meshing", 1, 1)
    measured = {image.pair: int(image.valid.sum()) for image in cleaned}
    return Scan(cloud, surface, alignment, measured, failed)


def warnings(result: Scan) -> list[str]:
    """What an operator should know before trusting the model."""
    found = []
    filled = float(result.mesh.filled.mean())
    if filled > MOST_FILLED:
        found.append(
            f"{100.0 * filled:.0f} % of the mesh is made up: the pairs that measured do not see "
            "the body from all sides"
        )
    alignment = result.alignment
    if alignment is not None and alignment.rms_after_mm > MOST_DISAGREEMENT_MM:
        found.append(
            f"the pairs disagree by {alignment.rms_after_mm:.2f} mm where they overlap: is this the "
            "calibration of this rig, has nothing moved since, did the person stand still?"
        )
    return found
