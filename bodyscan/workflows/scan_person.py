"""Scan one person: images to range images, these to a cloud and a mesh; save them with pictures."""

from __future__ import annotations

from collections.abc import Mapping
from concurrent.futures import Future
from pathlib import Path
from types import MappingProxyType

from bodyscan.captures.folder import Captures, ImageSequence, open_scan
from bodyscan.errors import ScanFailed
from bodyscan.fusion.storage import Made, Origin, Scan, clear, no_use, save_failure, save_scan
from bodyscan.mesh.body import BodyCloud, BodyMesh
from bodyscan.outcome import Outcome
from bodyscan.progress import Progress, background, silent, step
from bodyscan.registration.rig_calibration import RigCalibration
from bodyscan.registration.storage import calibration_id, load_calibration
from bodyscan.report.pictures import Pictures, draw_pictures, write_pictures
from bodyscan.settings import ScanSettings
from bodyscan.verdict import Announce, say_nothing
from bodyscan.workflows.fuse_range_images import fuse
from bodyscan.workflows.range_images import Preparation, Reconstructed, reconstruct_range_images


def scan_person(
    calibration: RigCalibration,
    captures: Captures,
    settings: ScanSettings,
    progress: Progress = silent,
    *,
    empty: Captures | None = None,
    reconstructed: Mapping[ImageSequence, Reconstructed] = MappingProxyType({}),
    announce: Announce = say_nothing,
    made: Made = no_use,
) -> Scan:
    """Make a body model and mesh from images of a person.

    empty: captures of the rig with nobody in it, whose surfaces are not part of the subject.
    reconstructed: see `reconstruct_range_images`.
    announce, made: see `fuse`.

    Raises ScanFailed if no pair, or no part of a body inside the scan volume, is left.
    """
    images = reconstruct_range_images(
        calibration, captures, progress, made=reconstructed, volume_only=True
    )
    nobody = empty and reconstruct_range_images(calibration, empty, progress, volume_only=True)
    return fuse(
        calibration, images, settings, progress,
        empty=nobody.value if nobody else (), announce=announce, made=made,
    )  # fmt: skip


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
) -> tuple[Scan, Path, Outcome[list[Path]]]:
    """Scan a capture folder; return the scan, its scan.json in `out` and the pictures beside it.

    Earlier results in `out` are removed. Pictures are drawn while a core is free, the cloud's
    during meshing and the mesh's during judging, and written once the result is saved.

    empty: captures of the rig with nobody in it.
    follow_links: follow links even if the calibration's rig file does not allow it.
    preparation: what was loaded and decoded before.
    announce: called with the verdict on the points alone, and with the final one once the result is
        saved.

    Raises ScanFailed after recording it in scan.json.
    """
    rig = preparation.calibration if preparation else load_calibration(calibration)
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
            drawn.append(other.submit(draw_pictures, body))

        try:
            scan = scan_person(
                rig, captures, settings, progress,
                empty=nobody, reconstructed=reconstructed, announce=announce, made=draw,
            )  # fmt: skip
        except ScanFailed as error:
            clear(out)
            save_failure(error, out, origin)
            raise
        with step(progress, "writing"):
            clear(out)
            saved = save_scan(scan, out, origin)
            announce(scan.verdict, final=True)
            pictures = write_pictures((each.result() for each in drawn), out)
    return scan, saved, pictures
