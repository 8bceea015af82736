"""Report a command's work: to a person as text, to another program as one JSON document.

Text and documents go to standard output, errors and progress to standard error.  A command is a
function whose first parameter is its `Output`; `add_command` gives it the options that all share.
"""

from __future__ import annotations

import inspect
import math
import os
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from dataclasses import asdict, dataclass, field
from functools import wraps
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any

import typer
from rich.console import Console, RenderableType
from rich.measure import Measurement
from rich.table import Table
from rich.text import Text

from bodyscan.cli.options import SHARED
from bodyscan.errors import BodyscanError
from bodyscan.files.messages import translate_failure
from bodyscan.memory import reserve_blas_memory
from bodyscan.optional import optional
from bodyscan.progress import THREADS
from bodyscan.verdict import STYLES, Verdict

if TYPE_CHECKING:
    from rich.progress import Progress as Bar


# Tables keep their lines whole when the output goes into a file.
CONSOLE = Console(width=None if sys.stdout.isatty() or "COLUMNS" in os.environ else 120)
ERRORS = Console(stderr=True)


@dataclass
class Output:
    """Collects files, findings and figures; shows them as they come, or as JSON."""

    command: str
    json: bool = False
    quiet: bool = False
    verbose: bool = False
    exit_code: int = 0  # 1 where the work came to its end but its result must not be used as it is
    _files: dict[str, list[str]] = field(default_factory=dict)
    _figures: dict[str, Any] = field(default_factory=dict)
    _lines: list[str] = field(default_factory=list)
    _notes: list[str] = field(default_factory=list)
    _failures: dict[str, str] = field(default_factory=dict)
    _verdict: Verdict | None = None
    _seconds: dict[str, float] = field(default_factory=dict)
    _standard_output: int | None = None
    _events: bool = False

    @property
    def silent(self) -> bool:
        """Whether nothing is shown to a person."""
        return self.json or self.quiet

    def add_files(self, what: str, *paths: Path) -> None:
        """Report files or folders that were written."""
        self._files.setdefault(what, []).extend(str(path) for path in paths)
        self._print(f"{what}: {', '.join(map(str, paths))}")

    def say(self, *lines: str, wrong: bool = False) -> None:
        """Report findings; `wrong`: --quiet shows them too, because they are why the command fails."""
        self._lines += lines
        for line in lines:
            self._print(line, wrong=wrong)

    def show(self, *tables: RenderableType) -> None:
        """Show tables, which --json leaves to `figures`."""
        if not self.silent:
            CONSOLE.print(*map(_fitting, tables), sep="\n")

    def figures(self, **values: Any) -> None:
        """Numbers for --json; people see them in tables."""
        self._figures |= values

    def notes(self, notes: Iterable[str], what: str = "note") -> None:
        """Report notes; without --verbose the first line of the first 20."""
        every = list(notes)
        self._notes += every
        shown = every if self.verbose else [note.partition("\n")[0] for note in every[:20]]
        for note in shown:
            self._print(f"{what}: {note}", style="yellow")
        if len(every) > 20 and not self.verbose:
            self._print(f"and {len(every) - 20} more: see --verbose", style="yellow")

    def failures(self, failures: Mapping[str, str], what: str = "left out") -> None:
        """Report pairs that were lost, with the reason."""
        self._failures |= failures
        parts = {name: reason.partition("\n") for name, reason in failures.items()}
        for name, (reason, _, _) in parts.items():
            self._print(f"{what}: {name}: {reason}", style="red")
        for remedy in dict.fromkeys(remedy for _, _, remedy in parts.values() if remedy):
            self._print(remedy, style="red")  # once, however many it would help

    def optional(self, what: str) -> AbstractContextManager[None]:
        """Turn a failure of the block, whose work is not essential, into a note."""
        return optional(what, lambda line: self.notes([line]))

    def verdict(self, verdict: Verdict, failed: Mapping[str, str] | None = None) -> None:
        """A grade and its reasons, which tell people of `failed` pairs; --json lists these."""
        self._verdict = verdict
        self._failures |= failed or {}
        self._print(str(verdict), style=STYLES[verdict.mark], wrong=verdict.mark == "bad")

    @contextmanager
    def stages(self) -> Iterator[StageClock]:
        """Draw a bar for each stage of the work; --verbose shows their times."""
        from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeElapsedColumn
        from rich.progress import Progress as Bar

        reserve_blas_memory(THREADS)
        columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn())
        with Bar(*columns, TimeElapsedColumn(), console=ERRORS, disable=self.quiet) as bar:
            clock = StageClock(bar)
            try:
                yield clock
            finally:
                clock.finish()
                self._seconds |= clock.seconds
        if self.verbose:
            for stage, taken in {**clock.seconds, "all": sum(clock.seconds.values())}.items():
                self._print(f"{taken:8.1f} s  {stage}")

    def as_document(self, error: BodyscanError | None = None) -> dict[str, Any]:
        """What --json prints; docs/commands.md says what each key holds."""
        return {
            "command": self.command,
            "exit_code": error.exit_code if error else self.exit_code,
            "made": self._files,
            "figures": _replace_nonfinite(self._figures),
            "lines": self._lines,
            "notes": self._notes,
            "failures": self._failures,
            "verdict": asdict(self._verdict) if self._verdict else None,
            "seconds": {stage: round(taken, 3) for stage, taken in self._seconds.items()},
            "error": error and {"what": error.what, "where": error.where, "remedy": error.remedy},
        }

    def stream_events(self) -> None:
        """The command writes JSON of its own to standard output, event by event."""
        self._give_back()
        self._events = True

    def __enter__(self) -> Output:
        if self.json:
            # Libraries print what they like on standard output, which is for the document alone.
            sys.stdout.flush()
            self._standard_output = os.dup(1)
            os.dup2(2, 1)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._give_back()
        known = error if isinstance(error, BodyscanError) else None
        if self.json and not self._events and (known or error is None):
            from bodyscan.files.atomic import format_json

            sys.stdout.write(format_json(self.as_document(known)))

    def _give_back(self) -> None:
        if self._standard_output is not None:
            os.dup2(self._standard_output, 1)
            os.close(self._standard_output)
            self._standard_output = None

    def _print(self, text: str, style: str | None = None, wrong: bool = False) -> None:
        if self.json or (self.quiet and not wrong):
            return
        console = ERRORS if self.quiet else CONSOLE
        console.print(text, style=style, highlight=False, markup=False, soft_wrap=True)


@dataclass
class StageClock:
    """Draws one bar a stage and keeps how long each took, in seconds."""

    bar: Bar
    seconds: dict[str, float] = field(default_factory=dict)
    _stage: str | None = None
    _since: float = 0.0
    _tasks: dict[str, Any] = field(default_factory=dict)

    def __call__(self, stage: str, done: int, total: int) -> None:
        self.finish(following=stage)
        if stage not in self._tasks:
            self._tasks[stage] = self.bar.add_task(stage, total=total)
        self.bar.update(self._tasks[stage], completed=done, total=total)

    def finish(self, following: str | None = None) -> None:
        """Count the time since the last report to its stage."""
        now = time.perf_counter()
        if self._stage is not None:
            self.seconds[self._stage] = self.seconds.get(self._stage, 0.0) + now - self._since
        self._stage, self._since = following, now


def complain(text: str) -> None:
    """Print an error, in red unless NO_COLOR forbids it."""
    try:
        ERRORS.print(text, style="red", highlight=False, markup=False, soft_wrap=True)
    except MemoryError:  # which may be what the text is about
        os.write(2, f"{text}\n".encode())


def _fitting(table: RenderableType) -> RenderableType:
    """Turn a table that is wider than the screen into a list of rows: folded numbers are unreadable."""
    if not isinstance(table, Table):
        return table
    whole = CONSOLE.options.update(max_width=10_000)  # no table is as wide
    if Measurement.get(CONSOLE, whole, table).maximum <= CONSOLE.width:
        return table
    headings = [str(column.header) for column in table.columns]
    lines = [str(table.title)] if table.title else []
    for row in zip(*(column.cells for column in table.columns), strict=True):
        name, *values = map(str, row)
        named = zip(headings[1:], values, strict=True)
        cells = [f"{heading} {value}" if heading else value for heading, value in named if value]
        lines.append(f"{name}: {', '.join(cells)}")
    return Text("\n".join(lines))


def _replace_nonfinite(value: Any) -> Any:
    """Replace NaN and infinity by None: JSON has neither."""
    if isinstance(value, Mapping):
        return {key: _replace_nonfinite(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [_replace_nonfinite(one) for one in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def add_command(app: typer.Typer, panel: str, function: Callable[..., None]) -> None:
    """Add `function` to the commands under its own name, with --json, --quiet and --verbose.

    Its first parameter is the Output to which it reports; the others are its options.
    """
    name = function.__name__.rstrip("_").replace("_", "-")
    _, *options = inspect.signature(function, eval_str=True).parameters.values()
    keywords = (one.replace(kind=inspect.Parameter.KEYWORD_ONLY) for one in options)
    parameters = [*keywords, *SHARED]

    @wraps(function)
    def run(*, json: bool, quiet: bool, verbose: bool, **given: Any) -> None:
        with Output(name, json, quiet, verbose) as output:
            try:
                function(output, **given)
            except BodyscanError:
                raise
            except Exception as error:
                known = translate_failure(error)
                if known is None:
                    raise
                raise known from error
        raise typer.Exit(output.exit_code)

    # What typer reads is the wrapped function's parameters, without the Output, and the shared.
    del run.__wrapped__
    run.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    run.__annotations__ = {one.name: one.annotation for one in parameters}
    app.command(name, rich_help_panel=panel)(run)
