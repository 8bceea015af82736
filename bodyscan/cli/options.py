"""Options and arguments that several commands share: each is declared once."""

from __future__ import annotations

import inspect
from pathlib import Path
from typing import Annotated

import typer

RigFile = Annotated[Path, typer.Argument(metavar="RIG.YAML", help="The rig file.", dir_okay=False)]
ScanFolder = Annotated[Path, typer.Argument(metavar="FOLDER", help="Captures of one scan.")]
Result = Annotated[Path, typer.Argument(metavar="RESULT", help="Folder that `scan` wrote.")]
CalibrationArgument = Annotated[
    Path,
    typer.Argument(metavar="CALIBRATION", help="What calibrate-rig, import or refine-rig wrote."),
]
Calibration = Annotated[
    Path, typer.Option("--calibration", help="What calibrate-rig, import or refine-rig wrote.")
]
OutFolder = Annotated[Path, typer.Option("--out", help="Folder to write into.")]
Overwrite = Annotated[
    bool, typer.Option("--overwrite", help="Replace what is there, and all that was made from it.")
]
Changes = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="KEY=VALUE",
        help="Change a setting, such as mesh.depth=8; repeatable. docs/formats.md lists them all.",
    ),
]
OverwriteCalibration = Annotated[
    bool,
    typer.Option(
        "--overwrite",
        help="Replace the calibration that is there; the old one is kept in `history`.",
    ),
]
CalibrationOut = Annotated[
    Path | None, typer.Option("--out", help="Default: `calibration` beside the rig file.")
]
FollowLinks = Annotated[
    bool, typer.Option("--follow-links", help="Allow images that are links out of FOLDER.")
]
Anyway = Annotated[
    bool, typer.Option("--anyway", help="Proceed even if the scan's verdict is repeat.")
]

Json = Annotated[
    bool, typer.Option("--json", help="Print one JSON document: what was made, notes, verdict.")
]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="Print errors only.")]
Verbose = Annotated[
    bool,
    typer.Option("--verbose", "-v", help="Print the time of each stage, and all notes in full."),
]

SHARED = [
    inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=False, annotation=option)
    for name, option in {"json": Json, "quiet": Quiet, "verbose": Verbose}.items()
]
"""What every command takes."""
