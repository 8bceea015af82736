"""The commands `report` and `accept`."""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated

import typer

from bodyscan.errors import BadInput

if TYPE_CHECKING:
    from bodyscan.evaluation.acceptance_file import AcceptanceFile
    from bodyscan.evaluation.acceptance_readings import Readings
    from bodyscan.progress import Progress
    from bodyscan.registration.rig_calibration import RigCalibration


def register(app: typer.Typer) -> None:
    """Add this module's commands to the command line."""
    app.command()(report)
    app.command()(accept)


def report(
    result: Annotated[
        Path, typer.Argument(metavar="RESULT", help="What calibrate-rig or scan wrote.")
    ],
    out: Annotated[
        Path | None, typer.Option(metavar="FILE.html", help="Default: report.html in the result.")
    ] = None,
    compare: Annotated[
        Path | None,
        typer.Option(metavar="OTHER", help="Another scan, or a known surface (PLY, mm)."),
    ] = None,
) -> None:
    """Write one HTML file about a calibration or a scan that opens anywhere, and prints."""
    from bodyscan.cli import console
    from bodyscan.files.atomic import write_json, write_text
    from bodyscan.report.page import render
    from bodyscan.report.result_page import build_page

    folder = result if result.is_dir() else result.parent
    path = out or folder / "report.html"
    if path.is_dir():
        raise BadInput("is a folder", where=str(path), remedy="give --out the name of a file")
    with console.errors.status("writing the report"):
        page = build_page(result, compare)
        write_text(path, render(page))
        if page.subject is not None and path.parent.resolve() != folder.resolve():
            # As beside an export: so that `bodyscan forget` knows whose it is.
            write_json(path.with_name(f"{path.name}.json"), {"subject": page.subject})
    console.console.print(f"verdict: {page.verdict.grade}", highlight=False)
    console.console.print(f"report: {path}", soft_wrap=True, highlight=False)


def accept(
    artefact: Annotated[
        Path | None,
        typer.Argument(metavar="ARTEFACT.YAML", help="Artefacts as calibrated, and limits."),
    ] = None,
    calibration: Annotated[
        Path | None, typer.Option(help="What calibrate-rig wrote; with --simulate: that beside it.")
    ] = None,
    spheres: Annotated[
        list[Path] | None,
        typer.Option(metavar="FOLDER", help="A scan of the spheres at one place; repeatable."),
    ] = None,
    plate: Annotated[
        list[Path] | None,
        typer.Option(metavar="FOLDER", help="A scan of the plate at one place; repeatable."),
    ] = None,
    simulate: Annotated[
        Path | None,
        typer.Option(metavar="WORKSPACE", help="Simulate the artefacts in this simulated rig."),
    ] = None,
    repeats: Annotated[int, typer.Option(min=1, help="Simulated shots of each place.")] = 2,
    places: Annotated[
        int | None, typer.Option(min=1, help="Simulate only so many of the places.")
    ] = None,
    limit: Annotated[
        list[str] | None, typer.Option(metavar="NAME=MM", help="Such as flatness_mm=0.5.")
    ] = None,
    out: Annotated[
        Path | None, typer.Option(help="Default: `acceptance` beside the calibration.")
    ] = None,
) -> None:
    """Measure spheres and a plate of known size at several places and judge the figures."""
    from bodyscan.cli import console
    from bodyscan.evaluation.acceptance_file import limit_from, load_acceptance
    from bodyscan.registration.storage import calibration_id, load_calibration
    from bodyscan.report.page import is_synthetic

    captured = [*(spheres or ()), *(plate or ())]
    if bool(captured) == (simulate is not None):
        raise BadInput(
            "both captures and --simulate" if captured else "there is nothing to measure",
            remedy="give --spheres and --plate folders, or --simulate WORKSPACE",
        )
    if calibration is None and simulate is None:
        raise BadInput("no calibration", remedy="give --calibration, what calibrate-rig wrote")
    file = load_acceptance(artefact, dict(limit_from(text) for text in limit or ()))
    place = calibration or (simulate or Path()) / "calibration"
    rig = load_calibration(place)
    with console.stage_clock() as clock:
        if simulate is not None:
            readings = _simulated(rig, simulate, file, repeats, places, clock)
        else:
            readings = _captured(rig, spheres or [], plate or [], file, clock)
    synthetic = simulate is not None or any(is_synthetic(folder) for folder in captured)
    folder = out or (place if place.is_dir() else place.parent).parent / "acceptance"
    raise typer.Exit(_judge(readings, file, rig, calibration_id(place), folder, synthetic))


def _judge(
    readings: Readings,
    file: AcceptanceFile,
    rig: RigCalibration,
    origin: str,
    folder: Path,
    synthetic: bool,
) -> int:
    """Writes and prints what was found; returns the exit code."""
    from bodyscan.cli import console
    from bodyscan.evaluation.acceptance_readings import acceptance_document, figures
    from bodyscan.files.atomic import write_json, write_text
    from bodyscan.report.acceptance_page import NO_STANDARD, acceptance_page, screen_table
    from bodyscan.report.page import render

    found = figures(readings, file)
    content = acceptance_document(readings, found, file, synthetic=synthetic, calibration_id=origin)
    write_json(folder / "acceptance.json", content)
    page = acceptance_page(found, readings, rig.rig.name, origin, synthetic)
    write_text(folder / "acceptance.html", render(page))
    console.console.print(screen_table(found, synthetic))
    console.console.print(NO_STANDARD, highlight=False)
    for problem in readings.problems:
        console.console.print(f"problem: {problem}", style="red", highlight=False)
    console.console.print(f"report: {folder / 'acceptance.html'}", soft_wrap=True, highlight=False)
    return 1 if readings.problems or any(one.exceeded for one in found) else 0


def _captured(
    rig: RigCalibration,
    spheres: list[Path],
    plates: list[Path],
    file: AcceptanceFile,
    progress: Progress,
) -> Readings:
    from bodyscan.captures.folder import open_scan
    from bodyscan.evaluation.acceptance_readings import Readings
    from bodyscan.workflows.accept import read_plates, read_spheres

    total = Readings()
    for folders, read in ((spheres, read_spheres), (plates, read_plates)):
        for folder in folders:
            total += read(rig, open_scan(rig.rig, folder), folder.name, file, progress)
    return total


def _simulated(
    rig: RigCalibration,
    workspace: Path,
    file: AcceptanceFile,
    repeats: int,
    places: int | None,
    progress: Progress,
) -> Readings:
    """Place by place: its images are measured and thrown away before the next one's are made."""
    import numpy as np

    from bodyscan.captures.folder import open_scan
    from bodyscan.evaluation.acceptance_readings import Readings
    from bodyscan.simulation import artefact as simulated
    from bodyscan.simulation.acceptance_places import plates_at, spheres_at
    from bodyscan.workflows.accept import read_plates, read_spheres

    world = simulated.open_workspace(workspace)
    centres = np.array(file.spheres.centres_mm)
    balls = simulated.sphere_surfaces(centres, file.spheres.radius_mm)
    flat = simulated.plate_surface(*file.plate.size_mm)
    volume = rig.rig.volume
    jobs = [
        *(
            (name, at, balls, repeats, read_spheres)
            for name, at in spheres_at(volume, centres)[:places]
        ),
        *((name, at, flat, 1, read_plates) for name, at in plates_at(volume)[:places]),
    ]
    total = Readings()
    for number, (name, at, surfaces, shots, read) in enumerate(jobs):
        with TemporaryDirectory(prefix="bodyscan-") as folder:
            taken = simulated.capture_artefact(
                world, surfaces, at, Path(folder) / f"place-{number + 1}",
                shots=shots, number=number, progress=progress,
            )  # fmt: skip
            total += read(rig, open_scan(rig.rig, taken), name, file, progress)
    return total
