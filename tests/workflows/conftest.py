"""A small simulated rig, calibrated and scanned once for all tests of the whole way."""

from __future__ import annotations

import json
import runpy
from contextlib import redirect_stdout
from pathlib import Path

import pytest
from made_once import folder_made_once, value_made_once
from small_workspace import PROJECT, Detected, Workspace, copy_pairs, detect, make_workspace


@pytest.fixture(scope="session")
def workspace(tmp_path_factory: pytest.TempPathFactory) -> Workspace:
    def make(base: Path) -> None:
        outputs = make_workspace(base / "small rig")
        (base / "outputs.json").write_text(json.dumps(outputs), "utf-8")

    base = folder_made_once(tmp_path_factory, "workspace", make)
    outputs = json.loads((base / "outputs.json").read_text("utf-8"))
    return Workspace(base / "small rig", outputs)


@pytest.fixture(scope="session")
def detected(workspace: Workspace, tmp_path_factory: pytest.TempPathFactory) -> Detected:
    """Boards and stripes found once, for whoever solves with parts of them."""
    return value_made_once(tmp_path_factory, "detected", lambda: detect(workspace))


@pytest.fixture(scope="session")
def example(workspace: Workspace, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One pair of each pole, lower body from one side, upper from the other: in `pole` the rig and its
    images, in `made` what the first example made of them, in `said.txt` what it printed."""

    def make(base: Path) -> None:
        copy_pairs(workspace.folder, ("p1-2", "p2-3"), base / "pole")
        script = runpy.run_path(str(PROJECT / "examples" / "calibrate_and_scan.py"))
        with (base / "said.txt").open("w", encoding="utf-8") as said, redirect_stdout(said):
            script["main"](base / "pole", base / "made")

    return folder_made_once(tmp_path_factory, "example", make)
