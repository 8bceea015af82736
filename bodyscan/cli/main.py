"""The command line: where it is entered, and how errors leave it. See builder, operator, laboratory.

Heavy imports happen inside commands, so that `bodyscan --help` and completion answer at once.
"""

from __future__ import annotations

import io
import logging
import os
import sys
from typing import Annotated

import typer

from bodyscan.cli import builder, laboratory, operator
from bodyscan.cli.console import complain
from bodyscan.cli.interruption import run_interruptibly
from bodyscan.errors import BodyscanError
from bodyscan.files.messages import translate_os_error
from bodyscan.memory import collect_seldom, keep_freed_memory
from bodyscan.version import __version__

app = typer.Typer(
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    epilog="Exit codes: 0 done; 1 the work failed, or its result must not be used as it is (repeat, "
    "not valid, not accepted); 2 the input is wrong. docs/commands.md describes every command.",
)
for _group in (builder, operator, laboratory):
    _group.register(app)


def main() -> None:
    """Entry point: errors are printed without a traceback, 2 for bad input, 1 for failed work."""
    # Stages run threads of their own; BLAS threads inside them get in each other's way (measured:
    # 15 s instead of 1 s for twelve cameras on two cores), and the last bits depend on their number.
    os.environ |= {f"{library}_NUM_THREADS": "1" for library in ("OPENBLAS", "MKL", "NUMBA")}
    if not os.environ.get("OPENCV_FOR_THREADS_NUM", "1").isdecimal():
        del os.environ["OPENCV_FOR_THREADS_NUM"]  # each call to OpenCV would fail
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # a terminal may lack a sign of ours, or of a path
            stream.reconfigure(errors="backslashreplace")
    keep_freed_memory()
    collect_seldom()
    os.umask(0o077)  # images and models of people are for their owner alone
    arguments = [argument for argument in sys.argv[1:] if argument != "--debug"]
    debug = len(arguments) < len(sys.argv) - 1
    if debug:
        logging.basicConfig(format="%(message)s")
        logging.getLogger("bodyscan").setLevel(logging.DEBUG)
        sys.exit(_run(arguments, debug=True))
    sys.exit(run_interruptibly(lambda: _run(arguments, debug=False)))


def _run(arguments: list[str], *, debug: bool) -> int:
    """The exit code of a command, whose error is printed."""
    try:
        app(args=arguments)
        code = 0
    except SystemExit as end:
        code = end.code if isinstance(end.code, int) else int(end.code is not None)
    except BodyscanError as error:
        if debug:
            raise
        complain(f"error: {error}")
        code = error.exit_code
    try:
        sys.stdout.flush()
    except OSError as error:
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)  # for what is flushed when Python ends
        code = code or 1
        complain(f"error: {translate_os_error(error)}")
    return code


def _show_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"bodyscan {__version__}")
        raise typer.Exit


@app.callback()
def _options(
    debug: Annotated[
        bool, typer.Option("--debug", help="Show tracebacks; allowed anywhere on the command line.")
    ] = False,
    version: Annotated[
        bool,
        typer.Option("--version", callback=_show_version, is_eager=True, help="Show the version."),
    ] = False,
) -> None:
    """Calibrate a rig of projector-camera pairs and fuse its scans of a person into a body model."""
