"""Scan one person's capture folder; save the result in a folder, with pictures of it."""

from __future__ import annotations

from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

from bodyscan.captures.folder import open_scan
from bodyscan.errors import ScanFailed
from bodyscan.fusion.scan import Scan
from bodyscan.fusion.storage import Origin, clear, save_failure, save_scan
from bodyscan.mesh.body import BodyCloud, BodyMesh
from bodyscan.outcome import Outcome
from bodyscan.progress import Progress, silent, step
from bodyscan.registration.storage import calibration_id, load_calibration
from bodyscan.report.pictures import Pictures, cloud_pictures, mesh_pictures, write_pictures
from bodyscan.settings import ScanSettings
from bodyscan.verdict import Announce, say_nothing
from bodyscan.workflows.preparation import Preparation
from bodyscan.workflows.scan_person import scan_person


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
    described = rig.rig
    if follow_links:
        described = described.model_copy(update={"follow_links": True})
    captures = open_scan(described, folder)
    nobody = open_scan(described, empty) if empty else None
    reconstructed = preparation.made_of(captures) if preparation else {}
    origin = Origin(
        calibration_id(calibration), captures.subject, captures.when, captures.simulated, rig.axes
    )
    drawn: list[Future[Pictures]] = []
    with ThreadPoolExecutor(1) as beside:

        def draw(body: BodyCloud | BodyMesh) -> None:
            if isinstance(body, BodyCloud):
                drawn.append(beside.submit(cloud_pictures, body))
            else:
                drawn.append(beside.submit(mesh_pictures, body))

        try:
            scan = scan_person(
                rig,
                captures,
                settings,
                progress,
                empty=nobody,
                reconstructed=reconstructed,
                announce=announce,
                made=draw,
            )
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
