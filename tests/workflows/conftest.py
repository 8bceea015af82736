"""A small simulated rig, calibrated and scanned once for all tests of the whole way."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from made_once import folder_made_once, value_made_once
from small_workspace import Detected, Workspace, detect, make_workspace


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
