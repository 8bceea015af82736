"""A small simulated rig, calibrated and scanned once for all tests of the whole way."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import pytest
import yaml
from typer.testing import CliRunner, Result

from bodyscan.cli import app

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


@pytest.fixture(scope="session")
def workspace(tmp_path_factory: pytest.TempPathFactory) -> Workspace:
    base = tmp_path_factory.mktemp("workspace")
    folder = base / "small rig"
    commands = {
        "simulate": (
            small_rig(base),
            "--out",
            folder,
            "--scale",
            0.5,
            "--board-shots",
            10,
            "--subject",
            PROJECT / "data" / "subjects" / "woman_average.ply",
        ),
        "check": (folder / "rig.yaml",),
        "calibrate-rig": (folder / "rig.yaml",),
        "scan": (
            folder / "captures" / "person",
            "--calibration",
            folder / "calibration",
            "--out",
            folder / "scan",
            "--points",
            200_000,
        ),
        "export": (folder / "scan", "--out", folder / "export"),
        "evaluate": (folder,),
    }
    outputs = {}
    for name, arguments in commands.items():
        result = run(name, *arguments)
        assert result.exit_code == 0, f"{name}: {result.output}\n{result.exception!r}"
        outputs[name] = result.output
    return Workspace(folder, outputs)
