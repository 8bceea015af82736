"""The operator's commands: scan people, fuse in batches, look at scans, export them, forget them."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from bodyscan.cli.console import Output, add_command
from bodyscan.cli.options import (
    Anyway,
    Calibration,
    Changes,
    FollowLinks,
    OutFolder,
    Overwrite,
    Result,
    RigFile,
    ScanFolder,
)
from bodyscan.errors import BadInput, FailedWork, escape_control
from bodyscan.files.atomic import hold_folder, scratch_folder, sweep_scratch
from bodyscan.files.messages import require_writable
from bodyscan.progress import step
from bodyscan.settings import AlignmentSettings, ExportSettings, FusionSettings, ScanSettings

if TYPE_CHECKING:
    from bodyscan.fusion.storage import StoredScan
    from bodyscan.jobs.job import Job
    from bodyscan.jobs.object_storage import Store
    from bodyscan.jobs.pipeline import Pipeline
    from bodyscan.jobs.supervision import Listen
    from bodyscan.measurement.changes import MeasureChanges
    from bodyscan.measurement.measurements import Measurements

PANEL = "Operator: scan people"
DEFAULTS = ScanSettings()


def register(app: typer.Typer) -> None:
    """Add these commands to the command line, in the order of a day."""
    for command in (capture, scan, report, measure, export, batch, watch, station, verify, forget):
        add_command(app, PANEL, command)


def capture(
    output: Output,
    rig_file: RigFile,
    out: Annotated[Path, typer.Option(help="Capture folder to write, such as INBOX/anna.")],
    subject: Annotated[
        str | None, typer.Option(help="The subject's pseudonym. Default: the folder's name.")
    ] = None,
    board: Annotated[
        str | None, typer.Option(metavar="SHOT", help="Take this shot of a board, not a person.")
    ] = None,
    overwrite: Overwrite = False,
) -> None:
    """Project the stripes and photograph them by all pairs, with the devices of the rig file."""
    from bodyscan.capture.devices import load_capture_rig, open_devices
    from bodyscan.capture.exposure import find_exposures, measure_delays
    from bodyscan.capture.session import Shot, capture_shot, refuse_existing_shot

    rig = load_capture_rig(rig_file)
    shot = Shot(out, subject=subject or out.name)
    if board is not None:
        shot = Shot(out, name=board, kind="calibration")
    require_writable(out)
    refuse_existing_shot(rig, shot, overwrite)
    with output.stages() as progress, open_devices(rig, rig_file.parent) as devices:
        for pair, delay_ms in measure_delays(devices).items():
            output.say(
                f"{pair}: the projector shows a frame {delay_ms:.0f} ms after it is asked to"
            )
        if devices.plan.exposure_ms is None:
            output.say(*(found.describe(pair) for pair, found in find_exposures(devices)))
        found = capture_shot(devices, shot, progress)
    output.figures(frames=found.frames, retaken=found.retaken)
    output.failures(found.lost)
    again = f", {found.retaken} taken again" if found.retaken else ""
    output.say(f"{found.frames} frames{again}")
    output.add_files("captures", out)
    output.exit_code = 1 if found.lost else 0


Matching = Annotated[
    Literal["projected", "open3d", "none"],
    typer.Option(
        help="How to align range images: by projection, by Open3D (ICP, pose graph), or not at all."
    ),
]


def scan(
    output: Output,
    folder: ScanFolder,
    calibration: Calibration,
    out: Annotated[Path | None, typer.Option(help="Default: FOLDER-model.")] = None,
    points: Annotated[
        int, typer.Option(min=1000, help="Number of points in the body cloud.")
    ] = DEFAULTS.fusion.points,
    align: Matching = DEFAULTS.alignment.matching,
    empty: Annotated[
        Path | None, typer.Option(help="Captures of the empty rig; whatever they show is removed.")
    ] = None,
    changes: Changes = None,
    follow_links: FollowLinks = False,
    overwrite: Overwrite = False,
    e57: Annotated[
        bool,
        typer.Option("--e57", help="Also write each pair's raw cloud, `raw.e57` (needs pye57)."),
    ] = False,
) -> None:
    """Fuse one person's captures into a body cloud and a closed mesh."""
    from bodyscan.cli import tables
    from bodyscan.files.model_file import apply_settings
    from bodyscan.fusion.storage import make_room
    from bodyscan.workflows.scan_person import scan_folder

    out = out or folder.with_name(f"{folder.name}-model")
    require_writable(out, folder, calibration, empty)
    fusion, alignment = FusionSettings(points=points), AlignmentSettings(matching=align)
    settings = ScanSettings(fusion=fusion, alignment=alignment)
    settings = apply_settings(settings, changes or (), BadInput)
    with hold_folder(out), output.stages() as progress:
        make_room(out, overwrite)
        found, saved, pictures = scan_folder(
            folder, calibration, out, settings, progress, empty=empty, follow_links=follow_links
        )
    with output.optional("table"):
        output.show(tables.scan_table(found))
        output.figures(**tables.scan_figures(found))
    output.add_files("result", saved)
    output.notes(found.notes)
    output.notes(pictures.notes)
    output.add_files("pictures", *pictures.value)
    output.verdict(found.verdict)
    output.exit_code = 1 if found.verdict.grade == "repeat" else 0
    if e57:
        from bodyscan.export.e57 import export_raw_clouds
        from bodyscan.fusion.storage import load_scan

        facts = load_scan(out).facts
        origin = {key: facts[key] for key in ("subject", "calibration_id")}
        export_raw_clouds(out / "raw.e57", found, **origin)
        output.add_files("raw clouds", out / "raw.e57")


def report(
    output: Output,
    result: Annotated[
        Path, typer.Argument(metavar="RESULT", help="Result of calibrate-rig or scan.")
    ],
    out: Annotated[
        Path | None, typer.Option(metavar="FILE.html", help="Default: report.html in the result.")
    ] = None,
    compare: Annotated[
        Path | None,
        typer.Option(metavar="OTHER", help="Another scan, or a known surface (PLY, mm)."),
    ] = None,
) -> None:
    """Write a report on a calibration or a scan: one HTML file that opens anywhere and prints."""
    from bodyscan.report.result_page import write_report

    path, page = write_report(result, out, compare)
    output.notes(page.notes)
    output.verdict(page.verdict)
    output.add_files("report", path)


def measure(
    output: Output,
    result: Result,
    heights: Annotated[
        str | None,
        typer.Option(help="Heights of slices in mm, such as 800,1050. Default: every 100."),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(help="Default: `measurements.json` inside the result; .csv for CSV."),
    ] = None,
    named: Annotated[
        bool, typer.Option("--named", help="Lay a body over the scan: landmarks, measures by name.")
    ] = False,
    landmarks: Annotated[
        Path | None,
        typer.Option(help="With --named: also write the landmarks to this .csv, .json or .lnd."),
    ] = None,
    since: Annotated[
        Path | None,
        typer.Option(metavar="EARLIER", help="With --named: what changed since this scan."),
    ] = None,
    anyway: Anyway = False,
) -> None:
    """Measure a scan's mesh: stature, girths of horizontal slices, volume, area."""
    from bodyscan.files.atomic import write_json
    from bodyscan.fusion.storage import refuse_own_file
    from bodyscan.measurement.measurements import measure as measure_mesh
    from bodyscan.measurement.measurements import parse_heights
    from bodyscan.report.measurement_table import (
        MEASUREMENTS,
        make_measurements_document,
        require_formats,
        tables,
        write_landmarks,
        write_measurements,
    )

    path = out or result / MEASUREMENTS
    require_formats(path, landmarks, since, named=named)
    for file in filter(None, (path, landmarks)):
        refuse_own_file(file, result)
    levels = None if heights is None else parse_heights(heights)
    stored, earlier = _load_scans(result, since, anyway=anyway)
    measured = measure_mesh(stored.mesh, levels, named=named, anyway=anyway)
    changes = None if earlier is None else _compare(earlier, stored, measured)
    content = make_measurements_document(measured, stored.facts, changes)
    write_measurements(path, measured, stored.facts, changes)
    written = [path]
    if landmarks is not None and measured.named is not None:
        write_landmarks(landmarks, measured.named, stored.facts)
        written.append(landmarks)
    for one in (file for file in written if file.suffix != ".json"):
        # As beside an export, so that `bodyscan forget` knows whose it is.
        whose = {key: content[key] for key in ("subject", "compared_with") if key in content}
        write_json(one.with_name(f"{one.name}.json"), whose)
    output.show(*tables(measured, changes))
    _show_grade(output, stored)
    output.figures(**content)
    output.add_files("measurements", *written)


def export(
    output: Output,
    result: Result,
    out: Annotated[Path | None, typer.Option(help="Default: `export` inside the result.")] = None,
    formats: Annotated[
        str, typer.Option("--format", help="Formats, separated by commas.")
    ] = ",".join(ExportSettings().formats),
    deface: Annotated[
        bool,
        typer.Option(
            "--deface", help="Replace the head by a plain one, for sharing; writes into `shared`."
        ),
    ] = False,
    registered: Annotated[
        bool,
        typer.Option(
            "--registered",
            help="Also lay a parametric body over the scan: one topology for all, with parts, "
            "landmarks, skeleton.",
        ),
    ] = False,
    texture: Annotated[
        bool,
        typer.Option("--texture", help="Also write GLB and OBJ with their colours in an image."),
    ] = False,
    texture_px: Annotated[
        int, typer.Option(min=256, max=16384, help="Side of that image, pixels.")
    ] = ExportSettings().texture_px,
    frame: Annotated[
        str, typer.Option(help="rig, or body (origin under the body, x the way it faces).")
    ] = "rig",
    up: Annotated[
        Literal["z", "y"],
        typer.Option(help="Axis that points up in PLY, OBJ and STL (mm); GLB is y up, in metres."),
    ] = "z",
    anyway: Anyway = False,
) -> None:
    """Export a scan's mesh as PLY, OBJ, STL and GLB for other programs."""
    from bodyscan.export.scan import export_scan
    from bodyscan.fusion.storage import load_scan, refuse_repeat

    folder = out or result / ("shared" if deface else "export")
    require_writable(folder)
    with output.stages() as progress, step(progress, "exporting"):
        stored = load_scan(result)
        if not anyway:
            refuse_repeat(result, stored.facts)
        extra = {"registered": registered, "textured": texture}
        versions = *ExportSettings().versions, *(name for name, wanted in extra.items() if wanted)
        with hold_folder(folder):
            export_scan(
                stored, folder, formats.split(","), versions,
                texture_px=texture_px, deface=deface, frame=frame, up=up,
                made=lambda path: output.add_files("export", path),
            )  # fmt: skip
    _show_grade(output, stored)
    output.say(f"PLY, OBJ and STL are in mm, {up} up; GLB is in metres, y up")


def _load_scans(
    folder: Path, since: Path | None, *, anyway: bool
) -> tuple[StoredScan, StoredScan | None]:
    """Load a scan, and an earlier one of the same person if its folder is given. Raises BadInput if it
    is of another, FailedWork if a scan is to be repeated."""
    from bodyscan.fusion.storage import load_scan, refuse_repeat

    later, earlier = load_scan(folder), None if since is None else load_scan(since)
    for path, scan in ((folder, later), (since, earlier)):
        if path is not None and scan is not None and not anyway:
            refuse_repeat(path, scan.facts)
    if earlier is not None and not anyway:
        one, other = (scan.facts.get("subject") or "nobody named" for scan in (earlier, later))
        if one != other:
            what = f"it is of {one}, the later scan of {other}"
            remedy = "Give two scans of one person, or --anyway."
            raise BadInput(what, where=str(since), remedy=remedy)
    return later, earlier


def _compare(
    earlier: StoredScan, later: StoredScan, measured: Measurements
) -> MeasureChanges | None:
    """Changes of the named measures since an earlier scan, if they were taken."""
    from bodyscan.measurement.changes import MeasureChanges, find_changes
    from bodyscan.measurement.named import measure_by_name

    if measured.named is None:
        return None
    one, other = (scan.facts.get("calibration_id") for scan in (earlier, later))
    found = find_changes(measure_by_name(earlier.mesh), measured.named)
    about = earlier.facts.get("subject"), earlier.facts.get("when")
    return MeasureChanges(*about, one == other, found)


def _show_grade(output: Output, scan: StoredScan) -> None:
    """Show the verdict of a scan that is not good: what is made of it may lack whole parts."""
    if scan.verdict and scan.verdict.grade != "good":
        output.verdict(scan.verdict)


def batch(
    output: Output,
    pipeline: Annotated[
        Path, typer.Argument(metavar="PIPELINE.YAML", help="The pipeline file; see pipelines/.")
    ],
    scans: Annotated[str, typer.Option(help="Folder (or URL) of scan folders, or of rigs.")],
    out: Annotated[
        str, typer.Option(help="Folder (or URL) to write one job folder for each into.")
    ],
    calibration: Annotated[
        str | None,
        typer.Option(help="Default: `calibration` in the folder of scans, beside it or above it."),
    ] = None,
    changes: Changes = None,
    until: Annotated[
        str | None, typer.Option(metavar="STAGE", help="The last stage to run.")
    ] = None,
    workers: Annotated[
        int | None, typer.Option(min=1, help="Number of jobs at the same time.")
    ] = None,
    cluster: Annotated[
        str | None,
        typer.Option(
            metavar="tcp://HOST:PORT", help="Address of a dask scheduler to send jobs to."
        ),
    ] = None,
) -> None:
    """Fuse every scan of a day (or calibrate every rig), each in its own process.

    With --json each event is printed as a line of JSON when it happens; the last one is the summary.
    """
    from bodyscan.jobs.job import find_jobs
    from bodyscan.jobs.object_storage import Store, find_stored_jobs, is_url
    from bodyscan.jobs.pipeline import load_pipeline
    from bodyscan.jobs.stages import KINDS, select_stages_until

    settings = load_pipeline(pipeline, changes or ())
    every = KINDS[settings.kind]
    last = until or every[-1].name
    select_stages_until(every, last)  # refuses an unknown stage before any folder is made
    if not is_url(scans) and not is_url(out):
        given = Path(calibration) if calibration else None
        jobs = find_jobs(settings, Path(scans), Path(out), given, last)
        read = (path for job in jobs for path in (job.source, job.calibration))
        require_writable(Path(out), *read)
        _run(output, jobs, Path(out), workers, cluster)
        return
    fuses = settings.kind == "fuse"
    if not (is_url(scans) and is_url(out)) or (fuses and not is_url(calibration or "")):
        raise BadInput(
            "scans, output and calibration are either all in object storage or none",
            where=f"{scans}, {out}, {calibration}",
            remedy="give a URL to each of --scans, --out and --calibration",
        )
    store = Store(scans, out, calibration if fuses else None)
    with scratch_folder() as outline:
        jobs = find_stored_jobs(store, settings, last, outline)
        _run(output, jobs, outline / "out", workers, cluster, store)


def _run(
    output: Output,
    jobs: Sequence[Job],
    out: Path,
    workers: int | None,
    cluster: str | None,
    store: Store | None = None,
) -> None:
    """The exit code is 1 if a job was set aside, or a scan has to be repeated."""
    from bodyscan.jobs import batch as batches
    from bodyscan.jobs import object_storage
    from bodyscan.jobs.supervision import supervise_job

    output.stream_events()
    resources = jobs[0].pipeline.resources
    shares = batches.allocate(
        resources, len(jobs), workers, batches.cores(), batches.measure_free_memory_mb()
    )
    work = partial(object_storage.work_on_stored, store=store) if store else supervise_job
    with _listening(output) as listen:
        if cluster:
            run = batches.run_on_cluster(cluster, resources.threads, listen=listen, work=work)
        else:
            listen({"event": "shares", **asdict(shares)})
            run = batches.run_locally(shares, listen=listen, work=work)
        outcomes = batches.run_batch(jobs, out, run, listen)
        if store:
            object_storage.fetch_figures(jobs, store)
        summary = batches.finish(jobs, outcomes, out)
        if store:
            summary |= {"table": object_storage.put_summary(out, store)}
        listen(summary)
    _conclude(output, summary)


def _conclude(output: Output, summary: Mapping[str, Any]) -> None:
    """Set the exit code, and name the scans to repeat, which may be done since an earlier run."""
    if summary["repeat"]:
        output.say(f"to be scanned again: {', '.join(summary['repeat'])}", wrong=True)
    output.exit_code = 1 if summary["set_aside"] or summary["repeat"] else 0


@contextmanager
def _listening(output: Output) -> Iterator[Listen]:
    """Show how jobs go; the process ends at once when it is interrupted."""
    from bodyscan.jobs import display

    shown = display.show_failures() if output.quiet else display.show_on_screen()
    try:
        with display.print_json_lines() if output.json else shown as listen:
            yield listen
    except KeyboardInterrupt:
        sys.stdout.flush()
        sweep_scratch(with_own=True)
        typer.secho("stopped; run the same command again to go on", err=True)
        os._exit(130)  # the jobs' processes end with this one


PipelineFile = Annotated[
    Path | None,
    typer.Option("--pipeline", metavar="PIPELINE.YAML", help="Settings, as for `batch`."),
]
QuietSeconds = Annotated[
    float,
    typer.Option(
        "--quiet-s",
        min=1.0,
        help="Take a scan as complete when nothing has come for this many seconds.",
    ),
]


def watch(
    output: Output,
    inbox: Annotated[
        Path, typer.Argument(metavar="INBOX", help="Folder in which each scan appears as a folder.")
    ],
    calibration: Calibration,
    out: OutFolder,
    pipeline: PipelineFile = None,
    changes: Changes = None,
    quiet_s: QuietSeconds = 30.0,
    once: Annotated[
        bool, typer.Option("--once", help="End when everything in INBOX is done.")
    ] = False,
) -> None:
    """Fuse scans while their images arrive; the verdict comes seconds after the last image.

    You can stop it at any moment; started again, it continues. docs/station.md describes the protocol.
    """
    from bodyscan.jobs.watching import Watched
    from bodyscan.jobs.watching import watch as watch_inbox

    require_writable(out, inbox, calibration)
    output.stream_events()
    watched = Watched(inbox, out, calibration, _watch_settings(pipeline, changes), quiet_s)
    with _listening(output) as listen:
        summary = watch_inbox(watched, listen, once=once)
    _conclude(output, summary)


def _watch_settings(pipeline: Path | None, changes: list[str] | None) -> Pipeline:
    from bodyscan.files.model_file import apply_settings
    from bodyscan.jobs.pipeline import Pipeline, load_pipeline

    if pipeline:
        return load_pipeline(pipeline, changes or ())
    return apply_settings(Pipeline(name="watch", kind="fuse"), changes or (), BadInput)


def station(
    output: Output,
    inbox: Annotated[Path, typer.Option(help="Folder in which each scan appears as a folder.")],
    out: OutFolder,
    calibration: Annotated[
        Path | None,
        typer.Option(help="Default: `calibration` beside the rig file; the page can make it."),
    ] = None,
    rig: Annotated[
        Path | None,
        typer.Option(metavar="RIG.YAML", help="Rig file: its devices, and its shots of the board."),
    ] = None,
    host: Annotated[
        str, typer.Option(help="Name or address under which other computers reach this one.")
    ] = "127.0.0.1",
    port: Annotated[int, typer.Option(min=1, max=65535, help="Port of the page.")] = 8765,
    certificate: Annotated[
        Path | None, typer.Option(metavar="FILE.pem", help="Certificate for https, with --key.")
    ] = None,
    key: Annotated[
        Path | None, typer.Option(metavar="FILE.pem", help="Private key of the certificate.")
    ] = None,
    pipeline: PipelineFile = None,
    changes: Changes = None,
    quiet_s: QuietSeconds = 30.0,
) -> None:
    """Serve a page for the people at a rig: calibrate, scan, see the verdict, the day, the rig.

    It does what `watch` does, and shows it. docs/station.md describes the pages.
    """
    from bodyscan.jobs.watching import Watched
    from bodyscan.station.serving import Address, serve

    calibration = calibration or (rig.parent if rig else Path()) / "calibration"
    require_writable(out, inbox, calibration)
    settings = _watch_settings(pipeline, changes)
    watched = Watched(inbox, out, calibration, settings, quiet_s, preview=True)
    serve(watched, rig, Address(host, port, certificate, key), output.say)


def verify(
    output: Output,
    folder: Annotated[
        Path,
        typer.Argument(
            metavar="FOLDER", help="Folder that batch or watch wrote, or a job's in it."
        ),
    ],
) -> None:
    """Compare images, calibration and results with the manifest, and find any byte that changed."""
    from bodyscan.jobs.verification import verify as look

    verified = look(folder)
    output.figures(files=verified.files)
    output.say(*(escape_control(fault) for fault in verified.faults), wrong=True)
    output.notes((escape_control(str(path)) for path in verified.added), "added since, not checked")
    if verified.faults:
        raise FailedWork(
            f"{len(verified.faults)} of {verified.files} files have changed",
            where=str(folder),
            remedy="restore them; or start `bodyscan batch` again with the same scans and --out, which "
            "redoes what was changed",
        )
    output.say(f"{verified.files} files, every byte unchanged")


def forget(
    output: Output,
    subject: Annotated[str, typer.Argument(metavar="SUBJECT", help="The subject's pseudonym.")],
    workspace: Annotated[Path, typer.Option(help="Folder to search.")] = Path(),
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Say what would be removed, and remove nothing.")
    ] = False,
    yes: Annotated[
        bool, typer.Option("--yes", help="Do not ask first; needed without a terminal.")
    ] = False,
) -> None:
    """Remove every file of a subject: images, jobs, results, exports, rows of summaries."""
    from bodyscan.jobs import forgetting

    found = forgetting.find_subject(subject, workspace)
    forgetting.require_found(found, subject, workspace)
    if not dry_run:
        if not yes:
            _confirm_removal(f"{len(found.files)} files of {subject}", workspace)
        found = forgetting.forget_subject(subject, workspace)
    verb = "would remove" if dry_run else "removed"
    listed = [str(path) for path in found.files]
    if not output.verbose:
        listed = list(forgetting.list_by_folder(found))
    output.say(*(f"{verb} {escape_control(line)}" for line in listed))
    output.notes((escape_control(str(path)) for path in found.unreadable), "owner unknown")
    output.notes(
        (
            escape_control(f"{path}: {count} images or bodies; look whether they show {subject}")
            for path, count in found.unnamed.items()
        ),
        "names nobody",
    )
    output.figures(files=len(found.files), removed=not dry_run)
    output.say(f"{verb} {len(found.files)} files of {subject}")


def _confirm_removal(what: str, workspace: Path) -> None:
    """Ask on the terminal, and abort unless the answer is yes; a pipe's input may not be an answer."""
    if sys.stdin is None or not sys.stdin.isatty():  # None: closed
        raise BadInput(
            f"removing {what} for good needs a confirmation, and there is no terminal",
            where=str(workspace),
            remedy="add --yes to remove them, or --dry-run to list them",
        )
    typer.confirm(f"remove {what} for good?", abort=True, err=True)
