"""Scans that arrive image by image are fused as a batch would; killed, it goes on."""

from __future__ import annotations

import json
import shutil
import signal
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

import pytest
from small_workspace import run

from bodyscan.captures.folder import ImageSequence, open_scan
from bodyscan.errors import ImageError
from bodyscan.files.hashing import file_hash, list_files
from bodyscan.workflows.range_images import Preparation

SMALL = ("--set", "fusion.points=20000", "--set", "mesh.depth=6", "--set", "export.formats=glb")
STORED = Path(__file__).parents[1] / "data" / "stored-0.1.0" / "calibration"
OWN = {"state.json", "log.txt", "lock", "batch.lock", "summary.csv"}
"""What tells of times and attempts."""


@pytest.fixture(scope="module")
def day(example: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    day = tmp_path_factory.mktemp("watched")
    shutil.copytree(example / "made" / "calibration", day / "calibration")
    return day


def watch(day: Path, out: str, *more: str) -> subprocess.Popen[str]:
    at = [str(day / "inbox"), "--calibration", str(day / "calibration"), "--out", str(day / out)]
    line = [sys.executable, "-m", "bodyscan", "watch", *at, "--json", "--quiet-s", "600", *SMALL]
    return subprocess.Popen([*line, *more], stdout=subprocess.PIPE, text=True)


def events(process: subprocess.Popen[str], until: str) -> list[dict[str, Any]]:
    """All to the first of that kind."""
    assert process.stdout is not None
    found: list[dict[str, Any]] = []
    for line in process.stdout:
        found.append(json.loads(line))
        if found[-1]["event"] == until:
            break
    return found


def feed(person: Path, scan: Path) -> None:
    """captures.yaml first, then every image, as a rig would write them."""
    scan.mkdir(parents=True)
    shutil.copy(person / "captures.yaml", scan)
    for path in sorted(person.rglob("*.png")):
        place = scan / path.relative_to(person)
        place.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(path, place)


def test_what_arrives_is_fused_as_a_batch_would_and_never_twice(example: Path, day: Path) -> None:
    (day / "inbox").mkdir()
    process = watch(day, "out")
    feed(example / "pole" / "captures" / "person", day / "inbox" / "anna")
    stages = [e for e in events(process, "stage") if e["event"] == "stage"]
    assert stages[0]["stage"] == "scan"
    process.send_signal(signal.SIGKILL)
    process.wait()

    process = watch(day, "out", "--once")
    told = events(process, "summary")
    code = process.wait()
    verdicts = [e for e in told if e["event"] == "verdict"]
    assert [e["final"] for e in verdicts] == [False, True]
    assert code == (1 if verdicts[1]["grade"] == "repeat" else 0)
    assert set(verdicts[0]["reasons"]) <= set(verdicts[1]["reasons"])
    meshed = [e.get("part") for e in told].index("meshing")
    assert told.index(verdicts[0]) < meshed < told.index(verdicts[1])
    names = [e["event"] for e in told]
    assert names.index("verdict") < names.index("summary")
    assert (told[-1]["done"], told[-1]["set_aside"]) == (1, [])

    again = watch(day, "out", "--once")
    assert again.stdout is not None
    assert again.stdout.read() == "", "what is done was done again"
    assert again.wait() == code

    pipeline = Path(__file__).parents[2] / "pipelines" / "fuse.yaml"
    own = ("--calibration", day / "calibration", "--scans", day / "inbox", "--json")
    result = run("batch", pipeline, *own, "--out", day / "batched", *SMALL)
    assert result.exit_code == code
    assert _bytes(day / "out" / "anna") == _bytes(day / "batched" / "anna")
    assert run("verify", day / "out").exit_code == 0


def _bytes(folder: Path) -> dict[str, str]:
    paths = [path for path in list_files(folder) if path.name not in OWN | {"job.json"}]
    return {str(path.relative_to(folder)): file_hash(path) for path in paths}


def test_pairs_that_come_one_by_one_are_decoded_side_by_side(
    example: Path, day: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    preparation = Preparation(day / "calibration")
    person = example / "pole" / "captures" / "person"
    captures = open_scan(preparation.calibration.rig, person)
    both, met = threading.Barrier(2, timeout=60.0), list[str]()

    def decode(_: object, __: object, sequence: ImageSequence, **___: object) -> None:
        both.wait()
        met.append(sequence.pair)
        raise ImageError("is left to the scan")

    monkeypatch.setattr("bodyscan.workflows.range_images.reconstruct_sequence", decode)
    pairs = sorted({sequence.pair for sequence in captures.sequences})[:2]
    for pair in pairs:
        preparation.prepare(person, [pair])
    assert preparation.take(captures) == {}
    assert sorted(met) == pairs


def test_a_calibration_that_cannot_be_used_is_said_at_once(tmp_path: Path) -> None:
    shutil.copytree(STORED, tmp_path / "calibration")
    (tmp_path / "calibration" / "calibration.npz").write_bytes(b"no arrays")
    (tmp_path / "inbox").mkdir()
    assert watch(tmp_path, "out").wait(timeout=120) == 2
