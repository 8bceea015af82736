"""A small simulated rig, and bodyscan's commands as typed."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import yaml
from typer.testing import CliRunner, Result

from bodyscan.cli.main import app

PROJECT = Path(__file__).parents[2]


@dataclass(frozen=True)
class Workspace:
    """Folder of a simulated rig of four pairs, and what the commands printed on it."""

    folder: Path
    outputs: dict[str, str]


def run(*arguments: object) -> Result:
    """A bodyscan command, as typed."""
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


def small_rig(folder: Path) -> Path:
    """Two poles of three-pole-12, two pairs each, the frame held by one pair."""
    rig = yaml.safe_load((PROJECT / "rigs" / "three-pole-12.yaml").read_text("utf-8"))
    rig["name"] = "small"
    wanted = ("p1-2", "p1-3", "p2-2", "p2-3")
    rig["pairs"] = [pair for pair in rig["pairs"] if pair["name"] in wanted]
    rig["rig_frame"] = {"pair": "p1-2"}
    path = folder / "small.yaml"
    path.write_text(yaml.safe_dump(rig, sort_keys=False), "utf-8")
    return path
