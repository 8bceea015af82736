"""The steps for a scan, or for a rig: stages that read named files and write one folder each."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from bodyscan.captures.folder import Captures, open_captures, open_scan
from bodyscan.errors import BadInput, CalibrationFileError, CaptureError
from bodyscan.files.reading import read_json_object
from bodyscan.jobs.job import CALIBRATION, RIG_FILE, Job, list_results_in
from bodyscan.progress import Progress, step
from bodyscan.rig.rig import Rig, load_rig
from bodyscan.verdict import Announce

if TYPE_CHECKING:
    from bodyscan.fusion.storage import Made
    from bodyscan.workflows.range_images import Preparation


@dataclass(frozen=True)
class Stage:
    """One step of a job; its results are in the folder of its name."""

    name: str
    version: int  # raised whenever the same input would give other results than before
    sections: tuple[str, ...]  # of the pipeline file, that it uses
    # The files it reads, each under a name that says what it is for.
    inputs: Callable[[Job], dict[str, Path]]
    # Writes its results into an empty folder, and announces a verdict if it reaches one.
    run: Callable[[Job, Path, Progress, Announce], None]


Kinds = Mapping[str, tuple[Stage, ...]]


def select_stages_until(stages: tuple[Stage, ...], until: str) -> tuple[Stage, ...]:
    """The stages up to the one called `until`. Raises BadInput if there is none of that name."""
    names = [stage.name for stage in stages]
    if until not in names:
        raise BadInput(f"there is no stage {until!r}", remedy=f"choose from {', '.join(names)}")
    return stages[: names.index(until) + 1]


def scan_inputs(job: Job) -> dict[str, Path]:
    """The scan's images and captures.yaml, and the calibration."""
    if job.source.is_symlink() and not job.source.resolve().is_relative_to(
        job.source.parent.resolve()
    ):
        raise CaptureError(
            f"is a symbolic link that leads out of the scans' folder, to {job.source.resolve()}",
            where=str(job.source),
            remedy="copy what it points to into the scans' folder",
        )
    calibration = find_calibration_of(job)
    files = _list_images(open_scan(read_rig_of(calibration), job.source), job.source)
    return files | {
        f"calibration/{name}": calibration / name for name in (CALIBRATION, "calibration.npz")
    }


def run_scan(
    job: Job,
    out: Path,
    progress: Progress,
    announce: Announce,
    preparation: Preparation | None = None,
    made: Made | None = None,
) -> None:
    """Scan as `bodyscan scan` does: cloud, mesh, their facts, pictures.

    preparation: what a resident process has already loaded and decoded.
    made: called with the cloud and the mesh as soon as they are there.
    """
    from bodyscan.workflows.scan_person import scan_folder

    folders, settings = (job.source, find_calibration_of(job), out), job.pipeline.scan
    *_, pictures = scan_folder(
        *folders, settings, progress, preparation=preparation, announce=announce, made=made
    )
    for note in pictures.notes:
        print(note, flush=True)  # into the job's log


def run_measures(job: Job, out: Path, progress: Progress, announce: Announce) -> None:
    """Measure as `bodyscan measure --named` does, with landmarks; nobody there is no failure."""
    from bodyscan.fusion.storage import load_scan
    from bodyscan.report.measurement_table import write_measures

    with step(progress, "measuring"):
        if reason := write_measures(load_scan(job.folder / "scan"), out):
            print(f"no measures by name: {reason}", flush=True)  # into the job's log


def run_export(job: Job, out: Path, progress: Progress, announce: Announce) -> None:
    """Export as `bodyscan export` does."""
    from bodyscan.export.scan import export_scan
    from bodyscan.fusion.storage import load_scan

    settings = job.pipeline.export
    with step(progress, "exporting"):
        scan = load_scan(job.folder / "scan")
        export_scan(
            scan, out, settings.formats, settings.versions,
            deface=settings.deface, texture_px=settings.texture_px,
        )  # fmt: skip


def run_report(job: Job, out: Path, progress: Progress, announce: Announce) -> None:
    """Report as `bodyscan report` does."""
    from bodyscan.report.result_page import write_report

    with step(progress, "reporting"):
        folder = job.folder / ("scan" if job.pipeline.kind == "fuse" else "calibration")
        write_report(folder, out / "report.html")


def list_rig_inputs(job: Job) -> dict[str, Path]:
    """The rig file and the images of its calibration captures."""
    rig_file = job.source / RIG_FILE
    rig = load_rig(rig_file)
    return {"rig.yaml": rig_file, **_list_images(open_captures(rig, rig_file), job.source)}


def run_calibrate(job: Job, out: Path, progress: Progress, announce: Announce) -> None:
    """Calibrate as `bodyscan calibrate-rig` does."""
    from bodyscan.workflows.calibrate_rig import calibrate_folder

    calibrate_folder(job.source / RIG_FILE, out, progress)


def run_rig_export(job: Job, out: Path, progress: Progress, announce: Announce) -> None:
    """Export a rig as `bodyscan export-rig` does."""
    from bodyscan.export.rig import export_rig
    from bodyscan.registration.storage import load_calibration

    with step(progress, "exporting"):
        formats = job.pipeline.rig_export.formats
        export_rig(load_calibration(job.folder / "calibration"), out, formats)


def list_results_of(*stages: str) -> Callable[[Job], dict[str, Path]]:
    """Inputs that are the results of earlier stages."""

    def inputs(job: Job) -> dict[str, Path]:
        return {
            f"{stage}/{name}": path
            for stage in stages
            for name, path in list_results_in(job.folder / stage).items()
        }

    return inputs


KINDS: Kinds = {
    "fuse": (
        Stage("scan", 7, ("alignment", "fusion", "mesh"), scan_inputs, run_scan),
        Stage("measures", 1, (), list_results_of("scan"), run_measures),
        Stage("export", 4, ("export",), list_results_of("scan"), run_export),
        Stage("report", 2, (), list_results_of("scan", "measures"), run_report),
    ),
    "calibrate": (
        Stage("calibration", 3, (), list_rig_inputs, run_calibrate),
        Stage("rig", 2, ("rig_export",), list_results_of("calibration"), run_rig_export),
        Stage("report", 1, (), list_results_of("calibration"), run_report),
    ),
}


def find_calibration_of(job: Job) -> Path:
    """The folder that `calibrate-rig` wrote. Raises BadInput if the job names none."""
    if job.calibration is None:
        raise BadInput("the job names no calibration", where=str(job.folder))
    return job.calibration if job.calibration.is_dir() else job.calibration.parent


def read_rig_of(calibration: Path) -> Rig:
    """The rig file's content as stored in a calibration; its arrays are not loaded."""
    path = calibration / CALIBRATION
    try:
        return Rig.model_validate(read_json_object(path)["rig"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise CalibrationFileError(
            f"is not a readable calibration ({type(error).__name__})",
            where=str(path),
            remedy="restore the file from a copy, or calibrate again",
        ) from error


def _list_images(captures: Captures, base: Path) -> dict[str, Path]:
    """Every existing image and the files that describe them; keys: captures/<path below base>."""
    paths = [p for s in captures.sequences for p in s.paths if p not in set(s.missing)]
    paths += captures.described_in
    return {f"captures/{Path(os.path.relpath(path, base)).as_posix()}": path for path in paths}
