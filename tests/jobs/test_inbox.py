"""When an image, a pair and a scan are taken to be there, and the process that works on them."""

from __future__ import annotations

import json
import sys
import time
from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
import pytest

from bodyscan.errors import BadInput, FailedWork
from bodyscan.files.atomic import write_json
from bodyscan.jobs.job import Job, make_job
from bodyscan.jobs.pipeline import Pipeline
from bodyscan.jobs.stages import KINDS
from bodyscan.jobs.supervision import JobResult, ignore_events
from bodyscan.jobs.watching import (
    STABLE_S,
    Arrival,
    IncomingScan,
    ResidentProcess,
    Watched,
    find_earlier,
    find_retake_time,
    put_image,
)
from bodyscan.rig.rig import Rig
from bodyscan.settings import Resources

QUIET_S = 30.0
IMAGE = np.arange(64, dtype=np.uint8).reshape(8, 8)


@pytest.fixture(scope="module")
def rig() -> Rig:
    """Two pairs with Gray code of 4 stripes and inverses: 6 images each."""
    board = {"name": "b", "kind": "checkerboard", "columns": 5, "rows": 4, "square_mm": 30}
    pair = {
        "camera": {"width": 8, "height": 8},
        "projector": {"code": "gray", "stripes": 4, "direction": "vertical"},
    }
    return Rig.model_validate(
        {
            "version": 1,
            "name": "two",
            "boards": [board],
            "pairs": [{"name": name, **pair} for name in ("a", "b")],
            "files": "{shot}/{pair}/{frame}.png",
        }
    )


def frames(rig: Rig) -> list[str]:
    projector = rig.pairs[0].projector
    assert projector is not None
    return ["lit", "dark", *rig.frames.code_names(projector)]


def test_pairs_are_whole_one_by_one_and_then_the_scan(rig: Rig, tmp_path: Path) -> None:
    scan = IncomingScan(tmp_path / "anna", rig)
    assert not scan.look(0.0, QUIET_S).complete  # the folder is not even there
    *first, last = frames(rig)
    for frame in first:
        put_image(tmp_path, rig, "anna", "a", frame, IMAGE)
        found = scan.look(0.1, QUIET_S)
        assert (found.whole, found.complete) == ((), False)
    put_image(tmp_path, rig, "anna", "a", last, IMAGE)
    found = scan.look(0.1, QUIET_S)
    assert (found.whole, found.complete) == (("a",), False)
    for frame in frames(rig):
        put_image(tmp_path, rig, "anna", "b", frame, IMAGE)
    for job, name, why in (("../x", frame, r"'\.\./x' is no"), ("anna", "bit99", "lit, dark, bit")):
        with pytest.raises(BadInput, match=why):  # it would lie outside the inbox, or unread in it
            put_image(tmp_path, rig, job, "a", name, IMAGE)
    found = scan.look(0.1, QUIET_S)
    assert (found.whole, found.complete) == (("a", "b"), True)


def test_half_an_image_is_waited_for(rig: Rig, tmp_path: Path) -> None:
    """One that does not end as it should counts once it has not grown for a while: its scan says
    what is wrong with it."""
    scan = IncomingScan(tmp_path / "anna", rig)
    path = [put_image(tmp_path, rig, "anna", "a", frame, IMAGE) for frame in frames(rig)][-1]
    content = path.read_bytes()
    path.write_bytes(content[:-20])
    assert scan.look(0.0, QUIET_S).whole == ()
    path.write_bytes(content[:-10])
    assert scan.look(STABLE_S + 0.1, QUIET_S).whole == ()
    assert scan.look(2 * STABLE_S + 0.2, QUIET_S).whole == ("a",)
    path.write_bytes(content)
    assert scan.look(2 * STABLE_S + 0.3, QUIET_S).whole == ("a",)


def test_a_scan_with_images_missing_is_taken_when_marked_or_quiet(rig: Rig, tmp_path: Path) -> None:
    scan = IncomingScan(tmp_path / "anna", rig)
    put_image(tmp_path, rig, "anna", "a", "lit", IMAGE)
    assert not scan.look(0.0, QUIET_S).complete
    put_image(tmp_path, rig, "anna", "a", "dark", IMAGE)
    assert not scan.look(20.0, QUIET_S).complete
    assert not scan.look(20.0 + QUIET_S - 0.1, QUIET_S).complete, "it was quiet for less"
    assert scan.look(20.0 + QUIET_S, QUIET_S).complete
    other = IncomingScan(tmp_path / "bert", rig)
    put_image(tmp_path, rig, "bert", "a", "lit", IMAGE)
    assert not other.look(0.0, QUIET_S).complete
    (tmp_path / "bert" / "done").touch()
    assert other.look(0.0, QUIET_S).complete


def test_a_retake_waits_until_every_image_is_new(rig: Rig, tmp_path: Path) -> None:
    """Half of each would be two persons in one."""
    for pair, frame in product(("a", "b"), frames(rig)):
        put_image(tmp_path, rig, "anna", pair, frame, IMAGE)
    state = tmp_path / "out" / "anna" / "state.json"
    write_json(state, {"state": "set aside", "job": "anna"})
    assert find_retake_time(tmp_path / "anna", state) == 0
    assert find_earlier(tmp_path / "anna", state) is None, "perhaps the disk was full: try again"
    time.sleep(0.02)
    *first, last = frames(rig)
    for pair, frame in [*product("a", frames(rig)), *product("b", first)]:
        put_image(tmp_path, rig, "anna", pair, frame, IMAGE)
    since = find_retake_time(tmp_path / "anna", state)
    assert since > 0
    assert find_earlier(tmp_path / "anna", state) is None
    scan = IncomingScan(tmp_path / "anna", rig, since)
    images = dict.fromkeys("ab", (len(frames(rig)), len(frames(rig))))  # old and new
    assert scan.look(0.0, QUIET_S) == Arrival(("a",), False, images)
    put_image(tmp_path, rig, "anna", "b", last, IMAGE)
    assert scan.look(0.1, QUIET_S) == Arrival(("a", "b"), True, images)


def test_a_result_that_is_gone_or_was_changed_is_made_again(tmp_path: Path) -> None:
    source, job = tmp_path / "anna", tmp_path / "out" / "anna"
    source.mkdir()
    for stage in (each.name for each in KINDS["fuse"]):
        write_json(job / stage / "stage.json", {"outputs": {"a.ply": "sha"}})
        (job / stage / "a.ply").write_text("x")
    (job / "scan" / "measurements.json").write_text("{}")  # a person's
    write_json(job / "state.json", {"state": "done", "job": "anna"})
    assert find_earlier(source, job / "state.json") == JobResult("anna", "done")
    time.sleep(0.02)
    (job / "scan" / "measurements.json").write_text("{ }")
    assert find_earlier(source, job / "state.json") is not None
    (job / "export" / "a.ply").write_text("y")
    assert find_earlier(source, job / "state.json") is None
    write_json(job / "state.json", {"state": "done", "job": "anna"})
    (job / "export" / "a.ply").unlink()
    assert find_earlier(source, job / "state.json") is None


def test_pairs_that_captures_yaml_leaves_out_are_not_waited_for(rig: Rig, tmp_path: Path) -> None:
    folder = tmp_path / "anna"
    folder.mkdir()
    listed = "version: 1\nkind: scan\nshots: [{name: s01, stripes: [a]}]\n"
    (folder / "captures.yaml").write_text(listed)
    scan = IncomingScan(folder, rig)
    for frame in frames(rig):
        assert not scan.look(0.0, QUIET_S).complete
        put_image(tmp_path, rig, "anna", "a", frame, IMAGE)
    assert scan.look(0.0, QUIET_S).complete


def test_images_for_pairs_or_names_that_are_not_there_are_refused(rig: Rig, tmp_path: Path) -> None:
    with pytest.raises(BadInput, match="no pair c"):
        put_image(tmp_path, rig, "anna", "c", "lit", IMAGE)
    for template in ("{shot}/{pair}/*{frame}.png", "{shot}/{pair}/{frame}.jpg"):
        other = rig.model_copy(update={"files": template})
        with pytest.raises(BadInput, match="no image can be written"):
            put_image(tmp_path, other, "anna", "a", "lit", IMAGE)
    assert not list(tmp_path.iterdir())


READY = 'print("{\\"ready\\": true}", flush=True)'


def resident(folder: Path, program: str) -> tuple[ResidentProcess, Job]:
    """A process that does what a program says, and a job for it that may take 1.5 s."""
    soon = Pipeline(name="watch", kind="fuse", resources=Resources(limit_minutes=0.025))
    watched = Watched(folder, folder, folder, soon, command=("-c", program))
    job = make_job(folder / "anna", soon, folder, folder, "scan")
    return ResidentProcess(watched), job


def test_a_job_at_which_the_process_is_stuck_is_ended(tmp_path: Path) -> None:
    """It is then tried again; were it not seen, watch would wait for it for ever."""
    process, job = resident(tmp_path, f"import time; {READY}; time.sleep(600)")
    process.start()
    try:
        reason, stages = process.attempt(job, ignore_events)
    finally:
        process.stop()
    assert reason == "was stopped: it took longer than 0.025 minutes"
    assert stages == ()


def test_a_process_that_died_is_started_again_for_the_next_job(tmp_path: Path) -> None:
    answer = json.dumps({"ended": "anna", "failed": ""})
    process, job = resident(tmp_path, f"{READY}; input(); print({answer!r}, flush=True); input()")
    slow = replace(job, pipeline=Pipeline(name="watch", kind="fuse"))
    process.start()
    try:
        assert process.attempt(slow, ignore_events)[0] == ""
        assert "ended with 0" in process.attempt(slow, ignore_events)[0]
        assert process.attempt(slow, ignore_events)[0] == ""
    finally:
        process.stop()
    with pytest.raises(FailedWork):
        process.start()


ON_LINUX = pytest.mark.skipif(sys.platform != "linux", reason="only Linux limits memory so")
LIMITED = """
from resource import RLIMIT_AS, setrlimit
from bodyscan.jobs.worker import stay
setrlimit(RLIMIT_AS, (600_000_000, -1))
raise SystemExit(stay())
"""


@pytest.mark.parametrize(
    ("program", "error", "reason"),
    [
        ('print(\'{"unusable": "no file", "exit_code": 2}\')', BadInput, "no file"),
        ("raise SystemExit(3)", FailedWork, "exit status 3"),
        pytest.param(LIMITED, FailedWork, "there is not enough memory", marks=ON_LINUX),
    ],
)
def test_a_process_that_cannot_start_ends_the_watch(
    tmp_path: Path, program: str, error: type[Exception], reason: str
) -> None:
    process, _ = resident(tmp_path, program)
    with pytest.raises(error, match=reason):
        process.start()
    process.stop()
