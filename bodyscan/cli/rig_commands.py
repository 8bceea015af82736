"""The commands for a rig that is calibrated, and `reproduce`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from bodyscan.errors import BadInput
from bodyscan.settings import RigExportSettings


def register(app: typer.Typer) -> None:
    """Add this module's commands to the command line."""
    for command in (export_rig, sigma_map, refine_rig, check_calibration, reproduce):
        app.command(command.__name__.replace("_", "-"))(command)


def export_rig(
    calibration: Annotated[Path, typer.Argument(help="What calibrate-rig wrote.")],
    out: Annotated[Path, typer.Option(help="Folder to write into.")],
    formats: Annotated[str, typer.Option("--format", help="Comma-separated.")] = ",".join(
        RigExportSettings().formats
    ),
) -> None:
    """Write a calibrated rig for other programs: a COLMAP model with rig, OpenCV's YAML."""
    from bodyscan.cli import console
    from bodyscan.export.rig import export_rig as write
    from bodyscan.registration.storage import load_calibration

    written = write(load_calibration(calibration), out, formats.split(","))
    console.console.print("\n".join(map(str, written)))


def sigma_map(
    calibration: Annotated[Path, typer.Argument(help="What calibrate-rig wrote.")],
    out: Annotated[
        Path | None, typer.Option(help="Default: `sigma-map.png` beside the calibration.")
    ] = None,
) -> None:
    """Draw how well the rig's placing knows each place of the scan volume, front and side."""
    from bodyscan.cli import console
    from bodyscan.registration.storage import load_calibration
    from bodyscan.report.sigma_map import draw_sigma_map

    rig = load_calibration(calibration)
    folder = calibration if calibration.is_dir() else calibration.parent
    cameras = {name: pair.camera for name, pair in rig.pairs.items()}
    path = out or folder / "sigma-map.png"
    if path.suffix.lower() != ".png":
        raise BadInput("the map is drawn as PNG", where=str(path), remedy="name it .png")
    draw_sigma_map(rig.rig.volume, rig.rig_from_camera, cameras, rig.covariance, path)
    console.console.print(f"picture: {path}")


def refine_rig(
    folder: Annotated[
        Path, typer.Argument(metavar="FOLDER", help="A scan of a rigid object that stood still.")
    ],
    calibration: Annotated[Path, typer.Option(help="What calibrate-rig wrote.")],
    out: Annotated[Path, typer.Option(help="Folder for the refined calibration.")],
) -> None:
    """Bring the pairs closer together on an object they scanned, within what the boards allow."""
    from dataclasses import replace

    from bodyscan.alignment.object_refinement import refine_on_object
    from bodyscan.captures.folder import open_scan
    from bodyscan.cli import console
    from bodyscan.errors import FailedWork
    from bodyscan.fusion.cleaning import clean, require_subject
    from bodyscan.registration.storage import load_calibration, save_calibration
    from bodyscan.workflows.range_images import reconstruct_range_images

    rig = load_calibration(calibration)
    with console.stage_clock() as clock:
        measured = reconstruct_range_images(rig, open_scan(rig.rig, folder), clock)
        clock("aligning", 0, 1)
        cleaned = clean(measured.value, rig.rig_from_camera, rig.rig.volume)
        found = refine_on_object(require_subject(cleaned), rig.rig_from_camera, rig.covariance)
        clock("aligning", 1, 1)
    for name, reason in measured.failures.items():
        console.console.print(f"left out: {name}: {reason}", style="red", highlight=False)
    console.console.print("\n".join(found.lines), highlight=False)
    if not found.better:
        raise FailedWork("the overlaps do not come closer: the calibration is better as it is")
    notes = (*rig.notes, *(f"refined on {folder.name}: {line}" for line in found.lines))
    refined = replace(rig, rig_from_camera=found.rig_from_camera, notes=notes)
    console.console.print(f"calibration: {save_calibration(refined, out)}")


def check_calibration(
    folders: Annotated[
        list[Path], typer.Argument(metavar="FOLDER...", help="A board's shots, or scans of people.")
    ],
    calibration: Annotated[Path, typer.Option(help="What calibrate-rig wrote.")],
    repair: Annotated[
        Path | None,
        typer.Option(help="Write a calibration with what moved put right into this folder."),
    ] = None,
) -> None:
    """Say whether the rig still is what it was, and which pair or pole moved by how much."""
    from bodyscan.cli import console
    from bodyscan.registration.storage import load_calibration, save_calibration
    from bodyscan.workflows.check_rig import check_rig

    rig = load_calibration(calibration)
    with console.stage_clock() as clock:
        found = check_rig(rig, folders, clock)
    console.console.print("\n".join(found.lines), highlight=False)
    console.console.print(console.times_table(clock.seconds))
    if repair is not None:
        console.console.print(f"repaired: {save_calibration(found.repaired(rig), repair)}")
    raise typer.Exit(0 if found.valid else 1)


def reproduce(
    out: Annotated[Path, typer.Option(help="Folder for the text and the figures.")],
    seed: Annotated[int, typer.Option(help="Of all noise.")] = 0,
    real_light: Annotated[
        bool, typer.Option("--real-light", help="A bowed board, speckle, jitter, a smile, defocus.")
    ] = False,
    quick: Annotated[
        bool, typer.Option("--quick", help="Coarser rendering and fewer shots.")
    ] = False,
) -> None:
    """Simulate the chapter's own set-up: its Tables 1 and 2, its Fig. 6 and 7, and all rivals."""
    from bodyscan.cli import console
    from bodyscan.laboratory.reproduce import FIGURES, TEXT
    from bodyscan.laboratory.reproduce import reproduce as run

    with console.stage_clock() as clock:
        text = run(out, seed=seed, quick=quick, real_light=real_light, progress=clock)
    # Tables are wider than most terminals: a line cut in two would be hard to read.
    typer.echo(text)
    console.console.print(console.times_table(clock.seconds))
    files = ", ".join(str(out / name) for name in (TEXT, *FIGURES))
    console.console.print(f"written: {files}", soft_wrap=True)
