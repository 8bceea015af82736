"""The builder's commands: describe a rig, calibrate it, look at it, keep it right."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from bodyscan.cli.console import Output, add_command
from bodyscan.cli.options import (
    Calibration,
    CalibrationArgument,
    CalibrationOut,
    FollowLinks,
    OutFolder,
    OverwriteCalibration,
    RigFile,
)
from bodyscan.errors import BadInput
from bodyscan.files.atomic import hold_folder
from bodyscan.files.messages import require_writable
from bodyscan.settings import RigExportSettings

if TYPE_CHECKING:  # loads Open3D
    from bodyscan.registration.rig_calibration import RigCalibration

PANEL = "Builder: calibrate a rig"


def register(app: typer.Typer) -> None:
    """Add these commands to the command line, in the order in which a rig needs them."""
    making = (init, check, patterns, calibrate_rig, import_)
    keeping = (check_calibration, accept_changed, refine_rig, sigma_map, export_rig)
    for command in (*making, *keeping):
        add_command(app, PANEL, command)


def init(
    output: Output,
    folder: Annotated[Path, typer.Argument(metavar="FOLDER", help="Folder to write into.")],
    rig: Annotated[
        Literal["three-pole-12", "four-pole-16", "one-pair"],
        typer.Option(help="The example that becomes rig.yaml."),
    ] = "three-pole-12",
) -> None:
    """Write an example rig file, pipelines, a body to simulate, and the first commands to type."""
    from importlib.resources import files

    from bodyscan.files.atomic import write_bytes

    starters = ("first-commands.txt", "fuse.yaml", "calibrate.yaml", "woman_average.ply")
    sources = {"rig.yaml": f"{rig}.yaml"} | {name: name for name in starters}
    require_writable(folder)
    there = [name for name in sources if (folder / name).exists()]
    if there:
        raise BadInput(
            f"holds {', '.join(there)} already, which would be replaced",
            where=str(folder),
            remedy="give another folder",
        )
    for name, source in sources.items():
        write_bytes(folder / name, (files("bodyscan") / "starter" / source).read_bytes())
    output.add_files("written", *(folder / name for name in sources))
    output.say(f"read {folder / 'first-commands.txt'}: what to type, in order")


def check(output: Output, rig_file: RigFile) -> None:
    """Check a rig file and its captures (images by their headers): list what is missing or wrong."""
    from bodyscan.captures.check import check as look_over
    from bodyscan.captures.check import format_report
    from bodyscan.rig.rig import load_rig

    rig, known_errors = load_rig(rig_file), []
    if any(pair.known for pair in rig.pairs):
        from bodyscan.workflows.import_rig import find_known_errors

        known_errors = find_known_errors(rig_file)
    found = look_over(rig_file, known_errors=known_errors)
    if found.ok and found.folders and rig.rig_frame.shot:
        from bodyscan.captures.folder import open_captures
        from bodyscan.workflows.find_boards import choose_frame

        try:
            framed = choose_frame(rig, open_captures(rig, rig_file))
            found = replace(found, warnings=(*found.warnings, *framed.notes))
        except BadInput as error:
            found = replace(found, errors=(str(error),))
    output.say(*format_report(found), wrong=not found.ok)
    output.figures(images=found.images, shots=len(found.shots))
    output.exit_code = 0 if found.ok else 2


def patterns(
    output: Output,
    rig_file: RigFile,
    out: OutFolder,
    width: Annotated[
        int, typer.Option(min=1, max=32767, help="Width of the projector's image, px.")
    ] = 1920,
    height: Annotated[
        int, typer.Option(min=1, max=32767, help="Height of the projector's image, px.")
    ] = 1080,
) -> None:
    """Write the images that a rig's projectors must show, as PNG, with their order."""
    from bodyscan.captures.pattern_files import find_uneven_stripes, write_patterns
    from bodyscan.rig.rig import load_rig

    require_writable(out)
    rig = load_rig(rig_file)
    orders = write_patterns(rig, out, width, height)
    output.notes(find_uneven_stripes(rig, width, height))
    for order in orders:
        output.add_files("patterns, in the order of", order)


def calibrate_rig(
    output: Output,
    rig_file: RigFile,
    out: CalibrationOut = None,
    overwrite: OverwriteCalibration = False,
) -> None:
    """Calibrate every pair of a rig and join them in one frame."""
    from bodyscan.workflows.calibrate_rig import calibrate_folder

    out = _prepare_calibration_folder(rig_file, out, overwrite)
    with hold_folder(out), output.stages() as progress:
        found, saved = calibrate_folder(rig_file, out, progress)
    _report_calibration(output, found, saved)


def import_(
    output: Output,
    rig_file: RigFile,
    out: CalibrationOut = None,
    sigma_px: Annotated[
        float | None,
        typer.Option(
            min=1e-6,
            help="Accuracy of the calibration in pixels, 1 sigma. Default: as in the rig file.",
        ),
    ] = None,
    overwrite: OverwriteCalibration = False,
) -> None:
    """Import calibrations from other programs: the files that the rig file names as `known`."""
    from bodyscan.workflows.import_rig import import_folder

    out = _prepare_calibration_folder(rig_file, out, overwrite)
    _report_calibration(output, *import_folder(rig_file, out, sigma_px))


def _prepare_calibration_folder(rig_file: Path, out: Path | None, overwrite: bool) -> Path:
    from bodyscan.captures.folder import resolve_capture_path
    from bodyscan.rig.rig import load_rig

    # A default beside the rig file may lie among its captures: their shots are told by name.
    folder = out or rig_file.parent / "calibration"
    _require_writable(folder, overwrite)
    named = load_rig(rig_file).calibration if out else ()
    require_writable(folder, *(resolve_capture_path(rig_file, entry) for entry in named))
    return folder


def _require_writable(folder: Path, overwrite: bool, *inputs: Path | None) -> None:
    """Raise BadInput if no calibration can be written there: now, not after minutes of work."""
    from bodyscan.registration.storage import refuse_existing

    require_writable(folder, *inputs)
    refuse_existing(folder, overwrite)


def _report_calibration(output: Output, found: RigCalibration, saved: Path) -> None:
    from bodyscan.cli import tables
    from bodyscan.registration.calibration_verdict import grade_calibration

    output.notes(found.notes)
    with output.optional("table"):
        output.show(tables.calibration_table(found))
        output.figures(**tables.calibration_figures(found))
    output.say(*found.advice)
    verdict = grade_calibration(found)
    output.verdict(verdict, found.failed)
    output.add_files("calibration", saved)
    output.exit_code = 1 if verdict.mark == "bad" else 0


def check_calibration(
    output: Output,
    folders: Annotated[
        list[Path],
        typer.Argument(metavar="FOLDER...", help="Shots of a board, or scans of people."),
    ],
    calibration: Calibration,
    repair: Annotated[
        Path | None, typer.Option(help="Folder for a calibration in which the moves are corrected.")
    ] = None,
    follow_links: FollowLinks = False,
    overwrite: OverwriteCalibration = False,
) -> None:
    """Find out whether anything in the rig has moved: which pair or pole, and how far."""
    from bodyscan.registration.storage import archive_previous, load_calibration, save_calibration
    from bodyscan.workflows.check_rig import check_rig

    if repair is not None:
        _require_writable(repair, overwrite, *folders, calibration)
    rig = load_calibration(calibration)
    with output.stages() as progress:
        found = check_rig(rig, folders, progress, follow_links=follow_links)
    output.say(*found.lines, wrong=not found.valid)
    output.figures(valid=found.valid)
    if repair is not None:
        repaired = found.repair(rig)
        archive_previous(repair)
        output.add_files("repaired", save_calibration(repaired, repair))
    output.exit_code = 0 if found.valid else 1


def accept_changed(output: Output, calibration: CalibrationArgument) -> None:
    """Accept a calibration that was edited by hand, and add a note that says so."""
    from bodyscan.registration.storage import accept_calibration

    accepted = accept_calibration(calibration)
    if accepted is None:
        output.say("the calibration was not edited: there is nothing to accept")
    else:
        output.add_files("calibration", accepted)


def refine_rig(
    output: Output,
    folder: Annotated[
        Path, typer.Argument(metavar="FOLDER", help="Scan of a rigid object that stood still.")
    ],
    calibration: Calibration,
    out: Annotated[Path, typer.Option(help="Folder for the refined calibration.")],
    overwrite: OverwriteCalibration = False,
) -> None:
    """Refine the poses of the pairs on a rigid object, within what the boards allow."""
    from bodyscan.captures.folder import open_scan
    from bodyscan.registration.storage import archive_previous, load_calibration, save_calibration
    from bodyscan.workflows.check_rig import refine_rig as refine

    _require_writable(out, overwrite, folder, calibration)
    rig = load_calibration(calibration)
    with output.stages() as progress:
        found = refine(rig, open_scan(rig.rig, folder), folder.name, progress)
    archive_previous(out)
    saved = save_calibration(found.value, out)
    output.failures(found.failures)
    output.say(*found.notes)
    output.add_files("calibration", saved)


def sigma_map(
    output: Output,
    calibration: CalibrationArgument,
    out: Annotated[
        Path | None, typer.Option(help="Default: `sigma-map.png` beside the calibration.")
    ] = None,
) -> None:
    """Map the sigma that the poses of the pairs cause in the scan volume."""
    from bodyscan.report.calibration_charts import write_sigma_map

    output.add_files("picture", write_sigma_map(calibration, out))


def export_rig(
    output: Output,
    calibration: CalibrationArgument,
    out: OutFolder,
    formats: Annotated[
        str, typer.Option("--format", help="Formats, separated by commas.")
    ] = ",".join(RigExportSettings().formats),
) -> None:
    """Export a calibrated rig for colmap, opencv, kalibr, mrcal, caliscope or aniposelib.

    Projectors that have a centre and a lens are written as further cameras.
    """
    from bodyscan.export.rig import export_rig as write
    from bodyscan.registration.storage import load_calibration

    require_writable(out, calibration)
    written = write(load_calibration(calibration), out, formats.split(","))
    for path in written.value:
        output.add_files("rig", path)
    output.notes(written.notes)
    output.failures(written.failures)
