"""The command line as a user meets it: exit codes, plain errors, quick help."""

from __future__ import annotations

import inspect
import json
import os
import re
import runpy
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from bodyscan.cli.main import app, main
from bodyscan.jobs.pipeline import load_pipeline
from bodyscan.rig.rig import load_rig
from bodyscan.settings import ExportSettings, RigExportSettings, ScanSettings

RIGS = Path(__file__).parents[1] / "rigs"
HEAVY = ("open3d", "pycolmap", "cv2", "scipy", "numba")


Done = subprocess.CompletedProcess[str]
Command = Callable[..., Done]


def in_a_process(*arguments: object) -> Done:
    line = [sys.executable, "-m", "bodyscan", *map(str, arguments)]
    return subprocess.run(line, capture_output=True, text=True, check=False, timeout=120)


@pytest.fixture
def bodyscan(monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> Command:
    """The command line without the second that a process of its own takes to begin."""
    monkeypatch.setattr("bodyscan.cli.main.run_interruptibly", lambda work: work())
    monkeypatch.setattr("bodyscan.cli.main.keep_freed_memory", lambda: None)
    monkeypatch.setenv("OPENBLAS_NUM_THREADS", "2")

    def run(*arguments: object) -> Done:
        line = ["bodyscan", *map(str, arguments)]
        monkeypatch.setattr(sys, "argv", line)
        mask = os.umask(0o077)
        capfd.readouterr()
        with pytest.raises(SystemExit) as end:
            main()
        os.umask(mask)
        assert os.environ["OPENBLAS_NUM_THREADS"] == "1"  # results would depend on it
        said = capfd.readouterr()
        return subprocess.CompletedProcess(line, int(str(end.value.code)), said.out, said.err)

    return run


def test_bad_input_exits_with_2_and_no_traceback(tmp_path: Path) -> None:
    rig = tmp_path / "rig.yaml"
    rig.write_text("version: 1\nname: x\nboards: []\npears: []\n")
    done = in_a_process("calibrate-rig", rig)
    assert done.returncode == 2
    assert "Traceback" not in done.stderr
    assert f"{rig}:4" in done.stderr
    assert "pairs" in done.stderr


def test_debug_shows_the_traceback(tmp_path: Path) -> None:
    done = in_a_process("check", tmp_path / "missing.yaml", "--debug")
    assert done.returncode != 0
    assert "Traceback" in done.stderr


def test_a_wrong_setting_is_named_before_the_work(tmp_path: Path, bodyscan: Command) -> None:
    done = bodyscan("scan", tmp_path, "--calibration", tmp_path, "--set", "mesh.deth=8")
    assert done.returncode == 2
    assert "--set mesh.deth: is not a key known here (did you mean 'depth'?)" in done.stderr


def test_check_and_help_import_nothing_heavy() -> None:
    for arguments in (["--help"], ["check", str(RIGS / "three-pole-12.yaml")]):
        program = (
            f"import sys; sys.argv = ['bodyscan', *{arguments!r}]\n"
            "from bodyscan.cli.main import app\n"
            "try:\n    app()\nexcept SystemExit:\n    pass\n"
            f"print('heavy:', [m for m in {HEAVY!r} if m in sys.modules])"
        )
        done = subprocess.run(
            [sys.executable, "-c", program], capture_output=True, text=True, check=True
        )
        assert done.stdout.rstrip().endswith("heavy: []"), done.stdout


COMMANDS = {command.name: command for command in app.registered_commands}


def parameters(name: str) -> dict[str, inspect.Parameter]:
    command = COMMANDS[name].callback
    assert command is not None
    return dict(inspect.signature(command).parameters)


def test_commands_stand_in_three_groups(bodyscan: Command) -> None:
    assert bodyscan("--version").stdout.startswith("bodyscan ")
    said = bodyscan("--help").stdout
    places = [said.index(group) for group in ("Builder", "Operator", "Laboratory")]
    assert places == sorted(places)
    assert "--install-completion" in said


def test_defaults_are_those_of_the_settings() -> None:
    scan = ScanSettings()
    assert parameters("scan")["points"].default == scan.fusion.points
    assert parameters("scan")["align"].default == scan.alignment.matching
    assert parameters("export")["formats"].default == ",".join(ExportSettings().formats)
    assert parameters("export-rig")["formats"].default == ",".join(RigExportSettings().formats)


def test_the_page_of_commands_is_as_the_commands_are() -> None:
    docs = RIGS.parent / "docs"
    page = runpy.run_path(str(docs / "write_commands.py"))["page"]
    assert page() == (docs / "commands.md").read_text("utf-8"), "run docs/write_commands.py"


def test_json_is_one_document_that_says_what_was_made(tmp_path: Path, bodyscan: Command) -> None:
    done = bodyscan("patterns", RIGS / "one-pair.yaml", "--out", tmp_path, "--width", 300,
                    "--height", 48, "--json")  # fmt: skip
    assert done.returncode == 0, done.stderr
    document = json.loads(done.stdout)
    assert document["command"] == "patterns"
    assert document["exit_code"] == 0
    assert document["error"] is None
    (order,) = next(iter(document["made"].values()))
    assert Path(order).is_file()
    assert document["notes"]  # stripes that cannot be equally wide on so few pixels


def test_json_says_what_went_wrong_too(tmp_path: Path, bodyscan: Command) -> None:
    done = bodyscan("scan", tmp_path, "--calibration", tmp_path, "--json")
    assert done.returncode == 2
    document = json.loads(done.stdout)
    assert document["exit_code"] == 2
    assert "calibration.json" in document["error"]["where"]
    assert "calibrate-rig" in document["error"]["remedy"]


def test_quiet_says_nothing_but_errors(tmp_path: Path, bodyscan: Command) -> None:
    done = bodyscan("patterns", RIGS / "one-pair.yaml", "--out", tmp_path, "--width", 300,
                    "--height", 48, "--quiet")  # fmt: skip
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
    wrong = bodyscan("check", RIGS / "three-pole-12.yaml", "--quiet")
    assert (wrong.returncode, wrong.stdout) == (2, "")
    assert "captures/calibration" in wrong.stderr


def test_libraries_that_print_do_not_spoil_the_document(capfd: pytest.CaptureFixture[str]) -> None:
    from bodyscan.cli.console import Output

    with Output("x", json=True):
        subprocess.run(["echo", "a library's warning"], check=True)
    said = capfd.readouterr()
    assert json.loads(said.out)["command"] == "x"
    assert "a library's warning" in said.err


@pytest.mark.parametrize("answer", ["n\n", "y\n", ""])
def test_nobody_is_forgotten_unasked(answer: str, tmp_path: Path) -> None:
    scan = tmp_path / "anna"
    scan.mkdir()
    (scan / "captures.yaml").write_text("kind: scan\nsubject: mallow\n")
    line = [sys.executable, "-m", "bodyscan", "forget", "mallow", "--workspace", str(tmp_path)]

    def forget(*more: str) -> Done:
        return subprocess.run(
            [*line, *more], input=answer, capture_output=True, text=True, check=False, timeout=120
        )

    refused = forget()
    assert refused.returncode == 2
    assert "1 files of mallow" in refused.stderr
    assert "--yes" in refused.stderr
    assert "--dry-run" in refused.stderr
    assert forget("--dry-run").returncode == 0
    assert scan.exists()
    assert forget("--yes").returncode == 0
    assert not scan.exists()


def test_rows_of_a_summary_are_not_forgotten_unasked(tmp_path: Path, bodyscan: Command) -> None:
    (tmp_path / "batch.lock").touch()
    (tmp_path / "summary.csv").write_text("job,subject,when,\na,mallow,,\n")
    done = bodyscan("forget", "mallow", "--workspace", tmp_path)
    assert (done.returncode, "--yes" in done.stderr) == (2, True)
    assert "mallow" in (tmp_path / "summary.csv").read_text()


def test_a_new_folder_has_a_rig_and_the_first_commands(tmp_path: Path, bodyscan: Command) -> None:
    made = bodyscan("init", tmp_path / "new", "--rig", "one-pair")
    assert made.returncode == 0, made.stderr
    assert load_rig(tmp_path / "new" / "rig.yaml").name == "one-pair"
    assert load_pipeline(tmp_path / "new" / "fuse.yaml").kind == "fuse"
    text = (tmp_path / "new" / "first-commands.txt").read_text("utf-8")
    typed = re.findall(r"\n    bodyscan (\S+)", text)
    assert {"simulate", "check", "calibrate-rig", "scan", "batch"} <= set(typed) <= set(COMMANDS)
    assert "holds rig.yaml" in bodyscan("init", tmp_path / "new").stderr


def test_a_terminal_without_our_signs_ends_no_command(tmp_path: Path) -> None:
    line = [sys.executable, "-m", "bodyscan", "init", str(tmp_path / "±")]
    ascii_only = os.environ | {"PYTHONIOENCODING": "ascii", "PYTHONUTF8": "0"}
    done = subprocess.run(line, capture_output=True, check=False, timeout=60, env=ascii_only)
    assert (done.returncode, b"\\xb1" in done.stdout) == (0, True), done.stderr
