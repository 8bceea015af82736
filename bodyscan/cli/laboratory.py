"""The laboratory's commands: simulate, measure against truth, accept."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from bodyscan.cli.console import Output, add_command
from bodyscan.cli.options import Calibration, OutFolder, Overwrite, RigFile
from bodyscan.errors import BadInput
from bodyscan.files.messages import require_writable
from bodyscan.progress import step

PANEL = "Laboratory: simulate, measure against truth, accept"


def register(app: typer.Typer) -> None:
    """Add these commands to the command line."""
    for command in (simulate, evaluate, accept, reproduce):
        add_command(app, PANEL, command)


SubjectPreset = Annotated[
    Literal["mannequin", "standing", "restless", "child"],
    typer.Option(help="How the subject moves while frames are taken."),
]
Look = Annotated[
    Literal["matt", "skin", "dressed"],
    typer.Option(help="Matt all over, like skin, or skin with dark hair and shorts."),
]
TruthChanges = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="KEY=VALUE",
        help="Change a number, such as person.breath_mm=5; repeatable. truth/truth.json lists all.",
    ),
]


def simulate(
    output: Output,
    rig_file: RigFile,
    out: OutFolder,
    subject: Annotated[
        Path | None, typer.Option(help="Surface of a body (PLY, metres, z up, facing -y).")
    ] = None,
    scale: Annotated[
        float, typer.Option(min=0.1, max=4.0, help="Factor on image size and number of stripes.")
    ] = 1.0,
    seed: Annotated[int, typer.Option(help="Seed of all random numbers.")] = 0,
    projector: Annotated[
        Literal["mirror", "pinhole"],
        typer.Option(help="A laser with a rotating mirror, or a projector with a lens."),
    ] = "mirror",
    preset: Annotated[
        Literal["ideal", "workshop"],
        typer.Option(help="Devices without faults, or as people build them."),
    ] = "workshop",
    subject_preset: SubjectPreset = "standing",
    look: Look = "matt",
    changes: TruthChanges = None,
    board_shots: Annotated[
        int | None,
        typer.Option(min=0, help="Number of board poses; 40 for twelve pairs, 0 for none."),
    ] = None,
    overwrite: Overwrite = False,
) -> None:
    """Simulate captures of a rig, a board and (with --subject) a person, with known truth."""
    require_writable(out)
    if not overwrite and ((out / "captures").exists() or (out / "rig.yaml").exists()):
        raise BadInput(
            "this folder holds captures already, which would be overwritten",
            where=str(out),
            remedy="give another --out, or --overwrite to replace them",
        )
    from bodyscan.mesh.surface_file import read_surface
    from bodyscan.simulation import compose_settings
    from bodyscan.simulation import simulate as run

    settings = compose_settings(
        projector, preset=preset, subject=subject_preset, look=look,
        changes=changes or (),
    )  # fmt: skip
    if subject is not None:
        output.notes(read_surface(subject, "metres").notes)
    with output.stages() as progress:
        run(
            rig_file, out, subject=subject, scale=scale, seed=seed, settings=settings,
            board_shots=board_shots, progress=progress,
        )  # fmt: skip
    output.add_files("captures", out / "captures")
    output.add_files("rig file", out / "rig.yaml")


def evaluate(
    output: Output,
    workspace: Annotated[
        Path,
        typer.Argument(
            metavar="WORKSPACE", help="Folder that simulate wrote, calibrated and scanned."
        ),
    ],
) -> None:
    """Compare the calibration and scan of a simulated workspace with the truth beside it."""
    from bodyscan.simulation.living import load_moving_body
    from bodyscan.workflows.evaluate import evaluate_workspace

    with output.stages() as progress, step(progress, "comparing"):
        body = load_moving_body(workspace / "truth")
        text = evaluate_workspace(workspace, None if body is None else body.vertices)
    output.say(*text.splitlines())


Artefact = Annotated[
    Path | None,
    typer.Argument(metavar="ARTEFACT.YAML", help="The calibrated artefacts, and limits."),
]
Spheres = Annotated[
    list[Path] | None,
    typer.Option(metavar="FOLDER", help="Scan of the spheres at one place; repeatable."),
]
Plate = Annotated[
    list[Path] | None,
    typer.Option(metavar="FOLDER", help="Scan of the plate at one place; repeatable."),
]


def accept(
    output: Output,
    calibration: Calibration,
    artefact: Artefact = None,
    spheres: Spheres = None,
    plate: Plate = None,
    limit: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME=MM", help="A limit, such as flatness_mm=0.5; repeatable."),
    ] = None,
    out: Annotated[
        Path | None, typer.Option(help="Default: `acceptance` beside the calibration.")
    ] = None,
    overwrite: Overwrite = False,
) -> None:
    """Measure spheres and a plate of known size at several places, and judge the figures."""
    from bodyscan.evaluation.acceptance import load_acceptance
    from bodyscan.registration.storage import load_calibration
    from bodyscan.report.acceptance_page import NO_STANDARD, make_screen_table
    from bodyscan.report.page import is_synthetic
    from bodyscan.workflows.accept_rig import judge_readings, read_captures, refuse_existing_test

    captured = [*(spheres or ()), *(plate or ())]
    if not captured:
        raise BadInput("there is nothing to measure", remedy="give --spheres and --plate folders")
    file = load_acceptance(artefact, limit or ())
    place = calibration if calibration.is_dir() else calibration.parent
    folder = out or place.parent / "acceptance"
    require_writable(folder, *captured, calibration)
    refuse_existing_test(folder, overwrite)
    rig = load_calibration(calibration)
    with output.stages() as progress:
        readings = read_captures(rig, spheres or [], plate or [], file, progress)
    synthetic = any(map(is_synthetic, captured))
    found = judge_readings(readings, file, rig, calibration, folder, synthetic=synthetic)
    with output.optional("table"):
        output.show(make_screen_table(found.figures, synthetic))
    output.figures(**{one.name: one.value_mm for one in found.figures})
    output.notes([NO_STANDARD, *found.notes])
    output.notes(readings.problems, "problem")
    output.verdict(found.verdict)
    output.add_files("figures", found.file)
    if found.page is not None:
        output.add_files("report", found.page)
    output.exit_code = 1 if found.verdict.grade == "not accepted" else 0


def reproduce(
    output: Output,
    out: Annotated[Path, typer.Option(help="Folder for the text and the figures.")],
    seed: Annotated[int, typer.Option(help="Seed of all noise.")] = 0,
    real_light: Annotated[
        bool,
        typer.Option(
            "--real-light",
            help="Add a bowed board, speckle, jitter, the laser line's smile, defocus.",
        ),
    ] = False,
) -> None:
    """Simulate the chapter's own set-up: Tables 1 and 2, Fig. 6 and 7, and all rival models."""
    from bodyscan.laboratory.reproduce import reproduce as run

    require_writable(out)
    with output.stages() as progress:
        text, names = run(out, seed=seed, real_light=real_light, progress=progress)
    output.say(*text.splitlines())
    output.add_files("written", *(out / name for name in names))
