"""A report as a page: sections of numbers, tables, pictures and models, in one HTML file."""

from __future__ import annotations

import base64
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files
from itertools import chain
from pathlib import Path
from typing import Any

from jinja2 import Environment, StrictUndefined
from markupsafe import Markup

from bodyscan.optional import optional
from bodyscan.verdict import Verdict
from bodyscan.version import __version__

Value = float | str | None


@dataclass(frozen=True)
class Column:
    """A figure, or a table's column of them: its name, unit, what it holds, and its limit."""

    name: str
    unit: str = ""
    meaning: str = ""
    limit: float | None = None
    at_least: bool = False
    digits: int = 3

    def mark(self, value: Value) -> str:
        """Whether a value keeps the limit, good or bad; "" without a limit or a value."""
        if self.limit is None or not isinstance(value, float | int):
            return ""
        kept = value >= self.limit if self.at_least else value <= self.limit
        return "good" if kept else "bad"

    def text(self, value: Value) -> str:
        return format_value(value, self.digits)

    @property
    def limit_text(self) -> str:
        if self.limit is None:
            return "–"
        return f"{'at least' if self.at_least else 'at most'} {self.text(self.limit)}"


@dataclass(frozen=True)
class Numbers:
    """A list of figures that explain themselves."""

    items: tuple[tuple[Column, Value], ...]


@dataclass(frozen=True)
class Table:
    columns: tuple[Column, ...]
    rows: tuple[tuple[Value, ...], ...]


@dataclass(frozen=True)
class Lines:
    """Sentences, one per line."""

    lines: tuple[str, ...]
    are_notes: bool = False  # also for whoever has it written


@dataclass(frozen=True, eq=False)
class Picture:
    """An image as its file's bytes, PNG or SVG."""

    title: str
    caption: str
    data: bytes

    @property
    def source(self) -> str:
        media = "png" if self.data.startswith(b"\x89PNG") else "svg+xml"
        return f"data:image/{media};base64,{base64.b64encode(self.data).decode('ascii')}"


@dataclass(frozen=True, eq=False)
class Viewer:
    """A rotatable model: see `model.py`."""

    title: str
    caption: str
    model: dict[str, Any]

    @property
    def json(self) -> Markup:
        """The model for a script element, which no `<` in it can end."""
        text = json.dumps(self.model, separators=(",", ":"), allow_nan=False)
        return Markup(text.replace("<", "\\u003c"))


Block = str | Numbers | Table | Lines | Picture | Viewer
"""A paragraph, or something else that a section holds."""


@dataclass(frozen=True, eq=False)
class Section:
    title: str
    blocks: Sequence[Block]


def make_sections(parts: Mapping[str, Callable[[], Sequence[Block]]]) -> list[Section]:
    """Make the sections of a report, by title; one that cannot be made holds the reason."""
    sections: list[Section] = []
    for title, make in parts.items():
        blocks: Sequence[Block] = ()
        notes: list[str] = []
        with optional(title, notes.append):
            blocks = make()
        sections.append(Section(title, [Lines(tuple(notes), are_notes=True)] if notes else blocks))
    return sections


@dataclass(frozen=True, eq=False)
class Page:
    """A whole report."""

    title: str
    verdict: Verdict
    synthetic: bool  # whether what is reported was simulated
    facts: tuple[tuple[str, str], ...]  # what it is, as (name, value)
    axes: str  # where the rig frame lies, in words
    sections: Sequence[Section] = ()
    subject: str | None = None  # pseudonym of the person shown

    @property
    def notes(self) -> list[str]:
        """For whoever has it written: what was assumed, and which parts could not be made."""
        blocks = (block for section in self.sections for block in section.blocks)
        noted = (one.lines for one in blocks if isinstance(one, Lines) and one.are_notes)
        return [*chain.from_iterable(noted)]


def is_synthetic(folder: Path) -> bool:
    """Whether the simulator's truth lies beside a result or above it."""
    above = (folder.resolve(), *folder.resolve().parents[:3])  # a batch's results are deepest
    return any((parent / "truth" / "truth.json").is_file() for parent in above)


def render(page: Page) -> str:
    """One self-contained HTML document, including style, script, pictures and models."""
    here = files("bodyscan.report")
    environment = Environment(
        autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    template = environment.from_string((here / "page.html.j2").read_text("utf-8"))
    return template.render(
        page=page,
        style=Markup((here / "page.css").read_text("utf-8")),
        script=Markup((here / "viewer.js").read_text("utf-8")),
        software=f"bodyscan {__version__}",
    )


def format_value(value: Value, digits: int = 3) -> str:
    """A value as people read it."""
    if value is None:
        return "–"
    if isinstance(value, str):
        return value
    whole = isinstance(value, int)
    return f"{value:,}".replace(",", "\u202f") if whole else f"{value:.{digits}f}"
