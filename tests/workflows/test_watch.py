"""Scans that arrive image by image are fused as a batch would, and shown on the station's page; killed,
both go on."""

from __future__ import annotations

import json
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from concurrent.futures import Future
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest
from browser import Page, browser_page, find_browser
from required import missing
from small_workspace import run

from bodyscan.captures.folder import ImageSequence, open_scan
from bodyscan.errors import CalibrationFileError, ImageError
from bodyscan.files.hashing import hash_file, list_files
from bodyscan.jobs.pipeline import Pipeline
from bodyscan.jobs.stages import read_rig_of
from bodyscan.jobs.supervision import ignore_events
from bodyscan.jobs.watching import IncomingScan, ResidentProcess, Watched, _Watching
from bodyscan.registration.storage import save_calibration
from bodyscan.workflows.range_images import Preparation

SMALL = ("--set", "fusion.points=20000", "--set", "mesh.depth=6", "--set", "export.formats=glb")
STORED = Path(__file__).parents[1] / "data" / "stored-0.1.0" / "calibration"
OWN = {"state.json", "log.txt", "lock", "batch.lock", "summary.csv"}
"""What tells of times and attempts."""


@pytest.fixture(scope="module")
def day(example: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("watched") / "calibration"
    return shutil.copytree(example / "made" / "calibration", place).parent


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
    assert (told[-1]["done"], told[-1]["set_aside"]) == (1, [])

    again = watch(day, "out", "--once")
    assert again.communicate()[0] == "", "what is done was done again"
    assert again.returncode == code

    pipeline = Path(__file__).parents[2] / "pipelines" / "fuse.yaml"
    own = ("--calibration", day / "calibration", "--scans", day / "inbox", "--json")
    result = run("batch", pipeline, *own, "--out", day / "batched", *SMALL)
    assert result.exit_code == code
    assert _bytes(day / "out" / "anna") == _bytes(day / "batched" / "anna")
    assert run("verify", day / "out").exit_code == 0


def test_nobody_waits_for_the_measures_of_the_person_before(example: Path, day: Path) -> None:
    feed(example / "pole" / "captures" / "person", day / "inbox" / "bea")
    told = events(watch(day, "later", "--once"), "never")
    of = [(e.get("job"), e["event"], e.get("state")) for e in told]
    assert of.index(("bea", "verdict", None)) < of.index(("anna", "job", "done"))


def _bytes(folder: Path) -> dict[str, str]:
    paths = [path for path in list_files(folder) if path.name not in OWN | {"job.json"}]
    return {str(path.relative_to(folder)): hash_file(path) for path in paths}


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


def test_what_no_job_can_use_is_dropped(example: Path, tmp_path: Path) -> None:
    shutil.copytree(example / "made" / "calibration", tmp_path, dirs_exist_ok=True)
    preparation = Preparation(tmp_path)
    person = example / "pole" / "captures" / "person"
    captures = open_scan(preparation.calibration.rig, person)
    preparation.prepare(person, [captures.sequences[0].pair])
    preparation.drop(person)
    assert preparation.take(captures) == {}
    preparation.prepare(person, [captures.sequences[0].pair])
    save_calibration(replace(preparation.calibration, notes=("another",)), tmp_path)
    preparation.refresh()
    assert preparation.calibration.notes == ("another",)
    assert preparation.take(captures) == {}
    (tmp_path / "calibration.json").write_text("{")
    for _ in range(2):
        with pytest.raises(CalibrationFileError):
            preparation.refresh()


def test_nobody_waits_for_folders_without_images(
    example: Path, day: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    submitted: dict[str, Future[Any]] = {}
    monkeypatch.setattr(ResidentProcess, "prepare", lambda *_: None)
    pipeline = Pipeline(name="day", kind="fuse")
    watched = Watched(tmp_path, tmp_path / "out", day / "calibration", pipeline, quiet_s=0.0)
    process, submit = ResidentProcess(watched), submitted.setdefault
    watching = _Watching(watched, process, lambda j: submit(j.name, Future()), ignore_events)
    shutil.copytree(example / "pole" / "captures" / "person", tmp_path / "anna")
    for folder in (tmp_path / "1", tmp_path / "2", tmp_path / "anna"):
        watching.look_at(IncomingScan(folder, read_rig_of(watched.calibration)))
    assert [*submitted] == ["1", "anna"]


def test_a_calibration_that_cannot_be_used_is_said_at_once(tmp_path: Path) -> None:
    shutil.copytree(STORED, tmp_path / "calibration")
    (tmp_path / "calibration" / "calibration.npz").write_bytes(b"no arrays")
    (tmp_path / "inbox").mkdir()
    assert watch(tmp_path, "out").wait(timeout=120) == 2


@pytest.fixture
def rig_page(example: Path, tmp_path: Path) -> Iterator[tuple[Page, Path, list[str]]]:
    found = find_browser()
    if found is None or find_spec("uvicorn") is None:
        missing("no chromium, or starlette is not installed")
    (tmp_path / "inbox").mkdir()
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = str(free.getsockname()[1])
    line = [sys.executable, "-m", "bodyscan", "station", "--port", port, "--quiet-s", "600", *SMALL]
    line += ["--calibration", str(example / "made" / "calibration")]
    line += ["--inbox", str(tmp_path / "inbox"), "--out", str(tmp_path / "out")]
    with browser_page(found, tmp_path / "profile") as page:
        yield page, tmp_path, [*line, f"http://127.0.0.1:{port}/"]


def until(page: Page, expression: str, patience_s: float = 240.0) -> Any:
    deadline = time.monotonic() + patience_s
    while not (value := page.evaluate(expression)):
        assert time.monotonic() < deadline, f"never: {expression}"
        time.sleep(0.2)
    return value


def test_a_person_is_scanned_in_front_of_a_browser_and_kept_through_a_kill(
    example: Path, rig_page: tuple[Page, Path, list[str]]
) -> None:
    page, folder, [*line, address] = rig_page
    station = subprocess.Popen(line, stdout=subprocess.PIPE, text=True)
    assert station.stdout is not None
    assert address in station.stdout.readline()
    page.navigate(address, 1280, 900)
    until(page, "document.querySelector('#line').textContent === 'connected'")
    for number in range(30):
        (folder / "inbox" / f"rubbish<b>{number}").mkdir()
    shutil.copytree(example / "pole" / "captures" / "person", folder / "inbox" / "anna")
    until(page, "!document.querySelector('#decide').hidden")
    until(page, "document.querySelector('#body canvas').width > 300")
    grade = page.evaluate("document.querySelector('#verdict').className")
    choice = "document.querySelector('#language')"
    for language, layers in (("ja", "写真形状"), ("en", "photoshape")):
        page.evaluate(f"{choice}.value = '{language}', {choice}.dispatchEvent(new Event('change'))")
        until(page, f"document.querySelector('#body .layers').textContent.startsWith('{layers}')")
    keep = "document.querySelector('[data-decision=keep]')"
    page.evaluate(f"{keep}.click()")
    until(page, f"{keep}.getAttribute('aria-pressed') === 'true'")
    x, y, w, h = page.box("#body .stage")
    assert page.picture((x + 0.3 * w, y + 0.1 * h, 0.4 * w, 0.8 * h)).std() > 12.0, "no body"
    station.send_signal(signal.SIGKILL)
    station.wait()
    until(page, "document.querySelector('#line').classList.contains('lost')")
    station = subprocess.Popen(line, stdout=subprocess.PIPE, text=True)
    try:
        until(page, "document.querySelector('#line').textContent === 'connected'")
        page.evaluate("location.hash = 'today'")
        rows = "[...document.querySelectorAll('#rows tr')]"
        anna = f"{rows}.find(r => r.textContent.includes('anna') && r.textContent.includes('Keep'))"
        until(page, f"!!{anna}?.querySelector('.badge.{grade}')")
        for size in (400, 3840):
            page.navigate(f"{address}#now", size, 900)
            assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")
    finally:
        station.kill()
        station.wait()
    assert [url for url in page.requests if not url.startswith((address, "data:", "about:"))] == []
    assert [e for e in page.errors if "exceptionId" in e or "Security Policy" in e] == []
