"""The command line. Heavy imports happen inside the commands."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Annotated, Literal

import typer

from bodyscan import __version__
from bodyscan.cli import job_commands as jobs
from bodyscan.cli import report_commands as reports
from bodyscan.cli import rig_commands
from bodyscan.errors import BadInput, BodyscanError
from bodyscan.memory import keep_freed_memory
from bodyscan.settings import AlignmentSettings, ExportSettings, FusionSettings, ScanSettings

app = typer.Typer(
    add_completion=False,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    help="Calibrate a rig of projector-camera pairs and fuse its scans of a person into a body model.",
)


RigFile = Annotated[Path, typer.Argument(metavar="RIG.YAML", help="The rig file.")]
Folder = Annotated[Path, typer.Argument(metavar="FOLDER")]


def main() -> None:
    """Entry point: errors are printed without a traceback, 2 for bad input, 1 for failed work."""
    # Work is shared out by stages, in threads of their own; BLAS threads inside them only get in
    # each other's way (measured: 15 s instead of 1 s for twelve cameras on two cores).
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    # What OpenCV warns of, we say in our own words, with the place in the rig file.
    os.environ.setdefault("OPENCV_LOG_LEVEL", "ERROR")
    keep_freed_memory()
    os.umask(0o077)  # images and models of people are for their owner alone
    arguments = [argument for argument in sys.argv[1:] if argument != "--debug"]
    debug = len(arguments) < len(sys.argv) - 1
    try:
        app(args=arguments)
    except BodyscanError as error:
        if debug:
            raise
        typer.secho(f"error: {error}", err=True, fg="red")
        sys.exit(error.exit_code)


def _show_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"bodyscan {__version__}")
        raise typer.Exit


@app.callback()
def _options(
    debug: Annotated[
        bool, typer.Option("--debug", help="Show tracebacks (may stand anywhere).")
    ] = False,
    version: Annotated[
        bool,
        typer.Option("--version", callback=_show_version, is_eager=True, help="Show the version."),
    ] = False,
) -> None:
    """Calibrate a rig of projector-camera pairs and fuse its scans of a person into a body model."""


def _refuse_file(folder: Path | None) -> None:
    """A folder to write into must not be a file: said before the work, not after it."""
    if folder is not None and folder.exists() and not folder.is_dir():
        raise BadInput(
            "is a file; results go into a folder", where=str(folder), remedy="give another --out"
        )


@app.command()
def check(rig_file: RigFile) -> None:
    """Validate a rig file and its capture folders, and list what is missing."""
    from bodyscan.captures.check import check as look_over
    from bodyscan.captures.check import report_lines

    report = look_over(rig_file)
    typer.echo("\n".join(report_lines(report)))
    raise typer.Exit(0 if report.ok else 2)


@app.command()
def simulate(
    rig_file: RigFile,
    out: Annotated[Path, typer.Option(help="Folder to write images and truth into.")],
    subject: Annotated[
        Path | None, typer.Option(help="A body surface (PLY, metres, z up, facing -y).")
    ] = None,
    scale: Annotated[
        float,
        typer.Option(min=0.1, max=4.0, help="Of image size and number of stripes."),
    ] = 1.0,
    seed: Annotated[int, typer.Option(help="Of every random draw.")] = 0,
    projector: Annotated[
        str, typer.Option(help="mirror (laser and rotating mirror) or pinhole (with a lens).")
    ] = "mirror",
    sway_mm: Annotated[
        float, typer.Option(min=0.0, help="How far the person moves while the pairs capture.")
    ] = 0.0,
    board_shots: Annotated[
        int | None, typer.Option(min=3, help="Number of board poses; 40 for twelve pairs.")
    ] = None,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Write over captures that are there already.")
    ] = False,
) -> None:
    """Simulate captures of a rig, a board and (with --subject) a person, with known truth."""
    _refuse_file(out)
    if not overwrite and ((out / "captures").exists() or (out / "rig.yaml").exists()):
        raise BadInput(
            "this folder holds captures already, which would be written over",
            where=str(out),
            remedy="give another --out, or say --overwrite",
        )
    from bodyscan.cli import console
    from bodyscan.simulation import settings_for
    from bodyscan.simulation import simulate as run

    with console.stage_clock() as clock:
        run(
            rig_file,
            out,
            subject=subject,
            scale=scale,
            seed=seed,
            settings=settings_for(projector, sway_mm=sway_mm),
            board_shots=board_shots,
            progress=clock,
        )
    console.console.print(f"captures: {out / 'captures'}\nrig file: {out / 'rig.yaml'}")


@app.command()
def patterns(
    rig_file: RigFile,
    out: Annotated[Path, typer.Option(help="Folder to write into.")],
    width: Annotated[int, typer.Option(min=1, max=32767, help="Of the projector, px.")] = 1920,
    height: Annotated[int, typer.Option(min=1, max=32767, help="Of the projector, px.")] = 1080,
) -> None:
    """Write the images that a rig's projectors are to show, as PNG, with their order."""
    from bodyscan.captures.pattern_files import uneven_stripes, write_patterns
    from bodyscan.rig.rig_file import load_rig

    _refuse_file(out)
    rig = load_rig(rig_file)
    written = write_patterns(rig, out, width, height)
    for note in uneven_stripes(rig, width, height):
        typer.secho(f"note: {note}", fg="yellow")
    typer.echo(
        "\n".join(f"patterns: {path.parent}, in the order of {path.name}" for path in written)
    )


@app.command("calibrate-rig")
def calibrate_rig(
    rig_file: RigFile,
    out: Annotated[
        Path | None, typer.Option(help="Default: `calibration` beside the rig file.")
    ] = None,
) -> None:
    """Calibrate every pair of a rig and join them in one frame."""
    from bodyscan.captures.folder import open_captures
    from bodyscan.cli import console
    from bodyscan.registration.storage import save_calibration
    from bodyscan.rig.rig_file import load_rig
    from bodyscan.workflows.calibrate_rig import calibrate_rig as calibrate

    _refuse_file(out)
    rig = load_rig(rig_file)
    captures = open_captures(rig, rig_file)
    with console.stage_clock() as clock:
        calibration = calibrate(rig, captures, clock)
    saved = save_calibration(calibration, out or rig_file.parent / "calibration")
    for note in calibration.notes:
        console.console.print(f"note: {note}", style="yellow", highlight=False)
    for name, reason in calibration.failed.items():
        console.console.print(f"failed: {name}: {reason}", style="red", highlight=False)
    console.console.print(console.calibration_table(calibration))
    for line in calibration.advice:
        console.console.print(line, highlight=False)
    console.console.print(console.times_table(clock.seconds))
    console.console.print(f"calibration: {saved}")


@app.command()
def scan(
    folder: Folder,
    calibration: Annotated[Path, typer.Option(help="What calibrate-rig wrote.")],
    out: Annotated[Path | None, typer.Option(help="Default: FOLDER-model.")] = None,
    points: Annotated[
        int, typer.Option(min=1000, help="Size of the body cloud.")
    ] = FusionSettings().points,
    align: Annotated[
        Literal["projected", "nearest", "none"],
        typer.Option(
            help="Range images: projected, nearest (Open3D's ICP), or none (boards only)."
        ),
    ] = "projected",
    empty: Annotated[
        Path | None,
        typer.Option(help="Captures of the rig with nobody in it: cut away what they show."),
    ] = None,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace a result, with all that was made of it.")
    ] = False,
    e57: Annotated[
        bool, typer.Option("--e57", help="Write each pair's raw cloud too: `raw.e57` (pye57).")
    ] = False,
) -> None:
    """Fuse one person's captures into a body cloud and a closed mesh."""
    from bodyscan.captures.folder import open_scan
    from bodyscan.cli import console
    from bodyscan.errors import ScanFailed
    from bodyscan.fusion.storage import clear, make_room, save_failure, save_scan
    from bodyscan.registration.storage import calibration_id, load_calibration
    from bodyscan.report.pictures import draw_scan
    from bodyscan.workflows.scan_person import scan_person as fuse

    _refuse_file(out)
    make_room(out or folder.with_name(f"{folder.name}-model"), overwrite)
    rig_calibration = load_calibration(calibration)
    captures = open_scan(rig_calibration.rig, folder)
    settings = ScanSettings(
        fusion=FusionSettings(points=points), alignment=AlignmentSettings(matching=align)
    )
    out = out or folder.with_name(f"{folder.name}-model")
    background = open_scan(rig_calibration.rig, empty) if empty else None
    subject, when = captures.subject, captures.when
    origin = calibration_id(calibration)
    try:
        with console.stage_clock() as clock:
            result = fuse(rig_calibration, captures, settings, clock, empty=background)
    except ScanFailed as error:
        clear(out)
        save_failure(error, out, calibration_id=origin, subject=subject, when=when)
        raise
    clear(out)
    saved = save_scan(result, out, calibration_id=origin, subject=subject, when=when)
    if e57:
        from bodyscan.export.e57 import export_raw_clouds

        export_raw_clouds(out / "raw.e57", result, subject=subject, calibration_id=origin)
    with console.errors.status("drawing"):
        pictures = draw_scan(result.cloud, result.mesh, out)
    console.console.print(console.scan_table(result))
    console.console.print(console.times_table(clock.seconds))
    console.console.print(f"result: {saved}\npictures: {', '.join(map(str, pictures))}")
    console.print_verdict(result.verdict)
    raise typer.Exit(1 if result.verdict.grade == "repeat" else 0)


@app.command()
def export(
    result: Folder,
    out: Annotated[Path | None, typer.Option(help="Default: `export` inside the result.")] = None,
    formats: Annotated[str, typer.Option("--format", help="Comma-separated.")] = ",".join(
        ExportSettings().formats
    ),
    deface: Annotated[
        bool, typer.Option("--deface", help="A plain head for sharing; goes into `shared`.")
    ] = False,
    frame: Annotated[str, typer.Option(help="rig, or body: under it, x the way it faces.")] = "rig",
) -> None:
    """Write a scan's mesh as PLY, OBJ, STL and GLB for other programs."""
    from bodyscan.cli import console
    from bodyscan.export.scan import export_scan
    from bodyscan.fusion.storage import load_scan

    _refuse_file(out)
    with console.errors.status("exporting"):
        folder = out or result / ("shared" if deface else "export")
        written = export_scan(
            load_scan(result), folder, formats.split(","), deface=deface, frame=frame
        )
    console.console.print("\n".join(map(str, written)))


@app.command()
def measure(
    result: Folder,
    heights: Annotated[
        str | None, typer.Option(help="Of slices over the floor, mm: 800,1050. Default: every 100.")
    ] = None,
    out: Annotated[
        Path | None, typer.Option(help="Default: `measurements.json` inside the result.")
    ] = None,
) -> None:
    """Measure a scan's mesh: stature, girths of horizontal slices, volume, area."""
    from bodyscan.cli import console
    from bodyscan.files.atomic import write_json
    from bodyscan.fusion.storage import load_scan
    from bodyscan.measurement.measurements import heights_from, measure
    from bodyscan.report.measurements import measurements_document, tables

    levels = None if heights is None else heights_from(heights)
    stored = load_scan(result)
    measured = measure(stored.mesh, levels)
    path = out or result / "measurements.json"
    write_json(path, measurements_document(measured, stored.facts))
    console.console.print(*tables(measured), sep="\n")
    console.console.print(f"measurements: {path}")


@app.command()
def evaluate(workspace: Folder) -> None:
    """Compare the calibration and scan of a simulated workspace with the truth beside it."""
    from bodyscan.cli import console
    from bodyscan.workflows.evaluate import evaluate_workspace

    with console.errors.status("comparing"):
        text = evaluate_workspace(workspace)
    console.console.print(text, highlight=False)


rig_commands.register(app)
jobs.register(app)
reports.register(app)
