"""A report as a page: sections of numbers, tables, pictures and models, in one HTML file."""

from __future__ import annotations

import base64
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any, Literal

from jinja2 import Environment, StrictUndefined
from markupsafe import Markup

from bodyscan.optional import optional
from bodyscan.verdict import Verdict
from bodyscan.version import __version__


@dataclass(frozen=True)
class Number:
    """One figure that explains itself: what it is, its unit, and its limit."""

    name: str
    value: float | str | None
    unit: str
    meaning: str
    limit: float | None = None
    at_least: bool = False
    digits: int = 3

    @property
    def within_limit(self) -> bool | None:
        """Whether the limit is kept; None without a limit or a value."""
        if self.limit is None or not isinstance(self.value, float | int):
            return None
        return self.value >= self.limit if self.at_least else self.value <= self.limit

    @property
    def mark(self) -> str:
        return {None: "", True: "good", False: "bad"}[self.within_limit]

    @property
    def text(self) -> str:
        return format_value(self.value, self.digits)

    @property
    def limit_text(self) -> str:
        if self.limit is None:
            return "–"
        side = "at least" if self.at_least else "at most"
        return f"{side} {format_value(self.limit, self.digits)}"


@dataclass(frozen=True)
class Column:
    """A table's column: its heading, unit, and what it holds."""

    name: str
    unit: str = ""
    meaning: str = ""
    limit: float | None = None
    at_least: bool = False
    digits: int = 3

    def cell(self, value: float | str | None) -> Number:
        return Number(self.name, value, self.unit, "", self.limit, self.at_least, self.digits)

    @property
    def limit_text(self) -> str:
        return self.cell(None).limit_text


@dataclass(frozen=True)
class Numbers:
    items: tuple[Number, ...]
    kind: Literal["numbers"] = "numbers"


@dataclass(frozen=True)
class Table:
    columns: tuple[Column, ...]
    rows: tuple[tuple[float | str | None, ...], ...]
    kind: Literal["table"] = "table"

    @property
    def cells(self) -> list[list[Number]]:
        return [[c.cell(v) for c, v in zip(self.columns, row, strict=True)] for row in self.rows]

    @property
    def definitions(self) -> list[Column]:
        return [column for column in self.columns if column.meaning]


@dataclass(frozen=True)
class Paragraph:
    text: str
    kind: Literal["paragraph"] = "paragraph"


@dataclass(frozen=True)
class Lines:
    """Sentences, one per line."""

    lines: tuple[str, ...]
    kind: Literal["lines"] = "lines"


@dataclass(frozen=True, eq=False)
class Picture:
    """An image as its file's bytes, PNG or SVG."""

    title: str
    caption: str
    data: bytes
    kind: Literal["picture"] = "picture"

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
    kind: Literal["viewer"] = "viewer"

    @property
    def json(self) -> Markup:
        """The model for a script element, which no `<` in it can end."""
        text = json.dumps(self.model, separators=(",", ":"), allow_nan=False)
        return Markup(text.replace("<", "\\u003c"))


Block = Paragraph | Numbers | Table | Lines | Picture | Viewer


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
        sections.append(Section(title, [Lines(tuple(notes))] if notes else blocks))
    return sections


@dataclass(frozen=True, eq=False)
class Page:
    """A whole report.

    synthetic: whether what is reported was simulated.
    facts: what it is, as (name, value).
    axes: where the rig frame lies, in words.
    subject: pseudonym of the person shown.
    """

    title: str
    verdict: Verdict
    synthetic: bool
    facts: tuple[tuple[str, str], ...]
    axes: str
    sections: Sequence[Section] = ()
    subject: str | None = None


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


def format_value(value: float | str | None, digits: int = 3) -> str:
    """A value as people read it."""
    if value is None:
        return "–"
    if isinstance(value, str):
        return value
    if isinstance(value, int):
        return f"{value:,}".replace(",", "\u202f")
    return f"{value:.{digits}f}"
