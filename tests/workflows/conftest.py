"""A small simulated rig, calibrated and scanned once for all tests of the whole way."""

from __future__ import annotations

import pytest
from small_workspace import PROJECT, Workspace, run, small_rig


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
