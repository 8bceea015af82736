"""A small simulated rig, and bodyscan's commands as typed."""

from __future__ import annotations

import shutil
from collections.abc import Collection
from dataclasses import dataclass, replace
from pathlib import Path

import yaml
from typer.testing import CliRunner, Result

from bodyscan.boards.view import BoardView, ViewKey
from bodyscan.calibration.boundary_points import BoardBoundaries
from bodyscan.captures.folder import Captures, open_captures
from bodyscan.cli.main import app
from bodyscan.rig.rig import Rig, load_rig
from bodyscan.simulation import compose_settings, simulate
from bodyscan.simulation.settings import Person
from bodyscan.workflows.decode import decode_on_boards
from bodyscan.workflows.find_boards import find_all_boards

PROJECT = Path(__file__).parents[2]
SCALE = 0.4
COARSE = ("--set", "mesh.depth=8", "--set", "mesh.reach_mm=8")
"""A mesh half as fine as the default, which takes four times as long."""
COARSER = ("--points", 50_000, "--set", "mesh.depth=7", "--set", "mesh.reach_mm=16")


@dataclass(frozen=True)
class Workspace:
    """Folder of a simulated rig of four pairs, and what the commands printed on it."""

    folder: Path
    outputs: dict[str, str]


@dataclass(frozen=True)
class Detected:
    """What the workspace's images show: boards, and the boundaries of stripes on them."""

    rig: Rig
    captures: Captures
    boards: tuple[BoardView, ...]
    boundaries: dict[ViewKey, BoardBoundaries]


def detect(workspace: Workspace) -> Detected:
    rig = load_rig(workspace.folder / "rig.yaml")
    captures = open_captures(rig, workspace.folder / "rig.yaml")
    boards = find_all_boards(rig, captures).value
    boundaries = decode_on_boards(rig, captures, boards).value
    return Detected(rig, captures, tuple(boards), boundaries)


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
    return _write_yaml(folder / "small.yaml", rig)


def copy_pairs(workspace: Path, names: Collection[str], out: Path) -> Path:
    """Rig file and captures of only these pairs, copied into the folder `out`; the rig file."""
    rig = yaml.safe_load((workspace / "rig.yaml").read_text("utf-8"))
    rig["pairs"] = [pair for pair in rig["pairs"] if pair["name"] in names]
    for kind in ("calibration", "person"):
        listed = yaml.safe_load(
            (workspace / "captures" / kind / "captures.yaml").read_text("utf-8")
        )
        for shot in listed["shots"]:
            for part in ("stripes", "lit"):
                shot[part] = [name for name in shot.get(part, ()) if name in names]
                for name in shot[part]:
                    place = Path("captures", kind, shot["name"], name)
                    shutil.copytree(workspace / place, out / place)
        listed["shots"] = [shot for shot in listed["shots"] if shot["stripes"] or shot["lit"]]
        _write_yaml(out / "captures" / kind / "captures.yaml", listed)
    return _write_yaml(out / "rig.yaml", rig)


def _write_yaml(path: Path, content: object) -> Path:
    path.write_text(yaml.safe_dump(content, sort_keys=False), "utf-8")
    return path


def simulate_subject(
    folder: Path, subject: Path, board_shots: int, person: Person | None = None
) -> None:
    """Simulate the small rig, with 2 x 2 rays a pixel for the simulator's 3 x 3: less than half the
    time, and the corners are found as well."""
    settings = compose_settings("mirror")
    settings = replace(
        settings, optics=replace(settings.optics, samples=2), person=person or settings.person
    )
    rig = small_rig(folder.parent)
    simulate(rig, folder, subject=subject, scale=SCALE, board_shots=board_shots, settings=settings)


def make_workspace(folder: Path) -> dict[str, str]:
    """The small rig with ten shots of its board and a person: simulated, calibrated, scanned and
    exported into `folder`. What each command printed, by its name.
    """
    simulate_subject(folder, PROJECT / "data" / "subjects" / "woman_average.ply", 10)
    scan = folder / "scan"
    at = ("--calibration", folder / "calibration")
    commands: dict[str, tuple[object, ...]] = {
        "check": (folder / "rig.yaml",),
        "calibrate-rig": (folder / "rig.yaml",),
        "scan": (folder / "captures" / "person", *at, "--out", scan, "--points", 110_000, *COARSE),
        "export": (scan, "--out", folder / "export"),
        "evaluate": (folder,),
    }
    outputs = {}
    for name, arguments in commands.items():
        result = run(name, *arguments)
        assert result.exit_code == 0, f"{name}: {result.output}\n{result.exception!r}"
        outputs[name] = result.output
    return outputs
