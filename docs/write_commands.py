"""The list in docs/commands.md, from the commands themselves: `python docs/write_commands.py`."""

from __future__ import annotations

import inspect
import sys
from pathlib import Path
from typing import Any, get_args

from typer.models import ArgumentInfo, OptionInfo

# The tree that this file lies in, not another one that is installed.
sys.path.insert(0, str(Path(__file__).parents[1]))

from bodyscan.cli.main import app
from bodyscan.cli.options import SHARED

PAGE = Path(__file__).with_name("commands.md")
MARK = "<!-- From here on written by `python docs/write_commands.py`; a test compares. -->\n"


def page() -> str:
    """The whole page: what stands above the mark as it is, every command below it."""
    parts, panel = [PAGE.read_text("utf-8").partition(MARK)[0] + MARK], None
    for command in app.registered_commands:
        if command.rich_help_panel != panel:
            panel = command.rich_help_panel
            parts.append(f"## {panel}\n")
        parts.append(section(str(command.name), command.callback))
    return "\n".join(parts)


def section(name: str, function: Any) -> str:
    """One command: what it does, its arguments and its own options."""
    own = [
        (parameter, *get_args(parameter.annotation)[:2])
        for parameter in inspect.signature(function).parameters.values()
        if parameter not in SHARED
    ]
    arguments = [one for one in own if isinstance(one[2], ArgumentInfo)]
    rows = [(info.metavar, info, parameter) for parameter, _, info in arguments]
    rows += [(typed(*one), one[2], one[0]) for one in own if one not in arguments]
    usage = [f"[{shown}]" if p.default is None else shown for shown, _, p in rows[: len(arguments)]]
    return "\n".join(
        [
            *(f"### {name}", "", " ".join(["    bodyscan", name, *usage, "[OPTIONS]"]), ""),
            *(" ".join(function.__doc__.split()), "", "| | | default |", "|---|---|---|"),
            *(f"| `{shown}` | {info.help or ''} | {default(p)} |" for shown, info, p in rows),
            "",
        ]
    )


def typed(parameter: inspect.Parameter, kind: Any, info: OptionInfo) -> str:
    """An option as typed, with what it takes."""
    declared = [name for name in (info.default, *(info.param_decls or ())) if name is not ...]
    names = ", ".join(declared or ["--" + parameter.name.replace("_", "-")])
    if kind is bool:
        return names
    kinds = [one for one in get_args(kind) or (kind,) if one is not type(None)]
    if isinstance(kinds[0], str):
        return f"{names} {'/'.join(kinds)}"
    inner = (get_args(kinds[0]) or kinds)[0]
    return f"{names} {info.metavar or inner.__name__.upper()}"


def default(parameter: inspect.Parameter) -> str:
    """What a parameter is where it is not given; whether it must be."""
    if parameter.default is inspect.Parameter.empty:
        return "must be given"
    return "" if parameter.default in (None, False) else f"`{parameter.default}`"


if __name__ == "__main__":
    PAGE.write_text(page(), "utf-8")
