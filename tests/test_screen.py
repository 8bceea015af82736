"""What a person sees: colours only where they are wanted, tables that fit the screen."""

from __future__ import annotations

import os
import pty
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

import pytest
from rich.console import Console
from rich.table import Table

from bodyscan.cli import console
from bodyscan.cli.console import Output


def on_a_terminal(*arguments: str, **environment: str) -> str:
    """What a command writes to a terminal."""
    ours, theirs = pty.openpty()
    settings = {k: v for k, v in os.environ.items() if k not in ("NO_COLOR", "FORCE_COLOR")}
    settings |= {"TERM": "xterm"} | environment
    command = [sys.executable, "-m", "bodyscan", *arguments]
    subprocess.run(command, stdout=theirs, stderr=theirs, env=settings, timeout=120, check=False)
    os.close(theirs)
    said = b""
    with suppress(OSError):  # Linux says so where a terminal has been closed
        while part := os.read(ours, 65536):
            said += part
    os.close(ours)
    return said.decode()


def test_no_color_is_obeyed(tmp_path: Path) -> None:
    command = ("check", str(tmp_path / "missing.yaml"))
    assert "\x1b[31m" in on_a_terminal(*command)
    assert "\x1b[31m" not in on_a_terminal(*command, NO_COLOR="1")


def test_closed_streams_are_no_error(tmp_path: Path) -> None:
    command = f"exec {sys.executable} -m bodyscan init '{tmp_path}/new' <&- >&- 2>&-"
    assert subprocess.run(["sh", "-c", command], check=False, timeout=120).returncode == 0


@pytest.mark.parametrize(("width", "whole"), [(100, True), (40, False)])
def test_a_table_wider_than_the_screen_is_a_list(
    width: int, whole: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    screen = Console(width=width, record=True)
    monkeypatch.setattr(console, "CONSOLE", screen)
    table = Table("pair", "position mm (x, y, z)", "sigma mm", title="rig")
    table.add_row("p1-1", "650.0 1126.0 950.0", "0.102 0.104 0.099")
    Output("x").show(table)
    lines = screen.export_text().splitlines()
    assert all(len(line) <= width for line in lines)
    if whole:
        assert any("p1-1" in line and "0.099" in line for line in lines)
    else:
        assert "p1-1: position mm (x, y, z) 650.0 1126.0" in " ".join(lines)
        assert "sigma mm 0.102 0.104 0.099" in lines[2]
