"""The command line as a user meets it: exit codes, plain errors, quick help."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

RIGS = Path(__file__).parents[1] / "rigs"
HEAVY = ("open3d", "pycolmap", "cv2", "scipy")


def bodyscan(*arguments: object) -> subprocess.CompletedProcess[str]:
    line = [sys.executable, "-m", "bodyscan", *map(str, arguments)]
    return subprocess.run(line, capture_output=True, text=True, check=False, timeout=120)


def test_bad_input_exits_with_2_and_no_traceback(tmp_path):
    rig = tmp_path / "rig.yaml"
    rig.write_text("version: 1\nname: x\nboards: []\npears: []\n")
    done = bodyscan("calibrate-rig", rig)
    assert done.returncode == 2
    assert "Traceback" not in done.stderr
    assert f"{rig}:4" in done.stderr
    assert "pairs" in done.stderr


def test_debug_shows_the_traceback(tmp_path):
    done = bodyscan("calibrate-rig", tmp_path / "missing.yaml", "--debug")
    assert done.returncode != 0
    assert "Traceback" in done.stderr


def test_a_missing_calibration_is_bad_input(tmp_path):
    done = bodyscan("scan", tmp_path, "--calibration", tmp_path)
    assert done.returncode == 2
    assert "calibration.json" in done.stderr
    assert "calibrate-rig" in done.stderr


def test_check_and_help_import_nothing_heavy():
    for arguments in (["--help"], ["check", str(RIGS / "three-pole-12.yaml")]):
        program = (
            f"import sys; sys.argv = ['bodyscan', *{arguments!r}]\n"
            "from bodyscan.cli.main import main\n"
            "try:\n    main()\nexcept SystemExit:\n    pass\n"
            f"print('heavy:', [m for m in {HEAVY!r} if m in sys.modules])"
        )
        done = subprocess.run(
            [sys.executable, "-c", program], capture_output=True, text=True, check=True
        )
        assert done.stdout.rstrip().endswith("heavy: []"), done.stdout


def test_no_captures_is_named():
    done = bodyscan("check", RIGS / "three-pole-12.yaml")
    assert done.returncode == 2
    assert "captures/calibration" in done.stdout


def test_the_version_needs_no_command():
    done = bodyscan("--version")
    assert done.returncode == 0
    assert done.stdout.startswith("bodyscan ")
