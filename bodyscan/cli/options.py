"""Options and arguments that several commands share: each is declared once."""

from __future__ import annotations

import inspect
from pathlib import Path
from typing import Annotated

import typer

RigFile = Annotated[Path, typer.Argument(metavar="RIG.YAML", help="The rig file.")]
ScanFolder = Annotated[Path, typer.Argument(metavar="FOLDER", help="One scan's captures.")]
Result = Annotated[Path, typer.Argument(metavar="RESULT", help="What `scan` wrote.")]
CalibrationArgument = Annotated[
    Path, typer.Argument(metavar="CALIBRATION", help="What calibrate-rig wrote.")
]
Calibration = Annotated[Path, typer.Option("--calibration", help="What calibrate-rig wrote.")]
OutFolder = Annotated[Path, typer.Option("--out", help="Folder to write into.")]
Overwrite = Annotated[
    bool, typer.Option("--overwrite", help="Replace what lies there, with all that was made of it.")
]
Changes = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="KEY=VALUE",
        help="Change a setting, such as mesh.depth=8; repeatable. docs/formats.md has them all.",
    ),
]
OverwriteCalibration = Annotated[
    bool,
    typer.Option(
        "--overwrite", help="Replace the calibration that lies there; it is kept in `history`."
    ),
]
CalibrationOut = Annotated[
    Path | None, typer.Option("--out", help="Default: `calibration` beside the rig file.")
]
FollowLinks = Annotated[
    bool, typer.Option("--follow-links", help="Images may be links that lead out of FOLDER.")
]
Anyway = Annotated[
    bool, typer.Option("--anyway", help="Even of a scan whose verdict is to repeat it.")
]

Json = Annotated[
    bool, typer.Option("--json", help="Print one JSON document: what was made, notes, verdict.")
]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="Print errors only.")]
Verbose = Annotated[bool, typer.Option("--verbose", "-v", help="Print times, and notes in full.")]

SHARED = [
    inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=False, annotation=option)
    for name, option in {"json": Json, "quiet": Quiet, "verbose": Verbose}.items()
]
"""What every command takes."""
