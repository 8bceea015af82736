"""Killed anywhere or out of room, a batch goes on; nothing is done twice, nothing half-made is done."""

from __future__ import annotations

import os
import random
import subprocess
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import pytest
from cheap_batch import batch_command, jobs_of, results, run_cheap
from processes import has_ended, wait_for

from bodyscan.errors import BadInput
from bodyscan.files.atomic import lock_file


def test_ten_kills_leave_the_same_bytes_as_none(
    make_scans: Callable[..., Path], tmp_path: Path
) -> None:
    scans = make_scans(**{f"s{number}": "sleep 0.05" for number in range(6)})
    assert run_cheap(scans, tmp_path / "undisturbed").code == 0
    moments = random.Random(1)
    out = tmp_path / "killed"
    there: dict[str, int] = {}
    for number in range(10):
        process = subprocess.Popen(batch_command(scans, out), stdout=subprocess.DEVNULL)
        if number % 2:  # once something more is there, however busy the machine is
            wait_for(partial(_is_more_there, out, len(there), process))
        else:
            time.sleep(moments.uniform(0.2, 0.7))
        process.kill()
        process.wait()
        wait_for(lambda: not any(_is_held(job.folder / "lock") for job in jobs_of(scans, out)))
        now = _made(out)
        assert there.items() <= now.items(), "what was there was made again"
        there = now
    assert run_cheap(scans, out).code == 0
    assert there.items() <= _made(out).items()
    assert results(out) == results(tmp_path / "undisturbed")
    again = run_cheap(scans, out)
    assert all(ending["stages"] == [] for ending in again.endings().values())


def test_the_processes_of_a_killed_batch_end_with_it(
    make_scans: Callable[..., Path], tmp_path: Path
) -> None:
    scans = make_scans(a="sleep 60")
    process = subprocess.Popen(batch_command(scans, tmp_path / "out"), stdout=subprocess.DEVNULL)
    lock = tmp_path / "out" / "a" / "lock"
    wait_for(lambda: lock.exists() and "process" in lock.read_text())
    child = int(lock.read_text().split()[1])
    process.kill()
    process.wait()
    wait_for(lambda: has_ended(child))
    with lock_file(tmp_path / "out" / "batch.lock", wait=False):  # kill let it go
        pass


def test_a_second_batch_on_the_same_folder_is_refused(
    make_scans: Callable[..., Path], tmp_path: Path
) -> None:
    scans = make_scans(a="sleep 1.5")
    out = tmp_path / "out"
    first = subprocess.Popen(batch_command(scans, out), stdout=subprocess.DEVNULL)
    wait_for(lambda: (out / "a" / "lock").exists())
    second = run_cheap(scans, out)
    assert second.code != 0
    assert f"another batch is running here (process {first.pid}" in second.errors
    assert first.wait(timeout=60) == 0
    assert run_cheap(scans, out).endings()["a"]["stages"] == []


def test_half_made_folders_are_taken_away_and_not_believed(
    make_scans: Callable[..., Path], tmp_path: Path
) -> None:
    scans = make_scans(a="nothing")
    out = tmp_path / "out"
    half = out / "a" / ".making-scan-0123"
    half.mkdir(parents=True)
    (half / "0.bin").write_bytes(b"half")
    for name in (".summary.0123456789ab.tmp.csv", "b/job.json", "b/.station.0123456789ab.tmp.json"):
        (out / name).parent.mkdir(exist_ok=True)
        (out / name).write_text("half")
    (out / "a" / "scan").mkdir()  # without stage.json: nothing vouches for it
    (out / "a" / "scan" / "0.bin").write_bytes(b"half")
    assert run_cheap(scans, out).endings()["a"]["stages"] == ["scan", "export"]
    assert not half.exists()
    assert not list(out.rglob("*.tmp*"))
    assert (out / "a" / "scan" / "0.bin").stat().st_size > 4


def _made(out: Path) -> dict[str, int]:
    """When each stage's results that are in place were made."""
    return {str(path): path.stat().st_mtime_ns for path in out.glob("*/[!.]*/stage.json")}


def _is_more_there(out: Path, before: int, process: subprocess.Popen[bytes]) -> bool:
    return len(_made(out)) > before or process.poll() is not None


def _is_held(lock: Path) -> bool:
    if not lock.exists():
        return False
    try:
        with lock_file(lock, wait=False):
            return False
    except BadInput:
        return True


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of 1 MB."""
    folder = tmp_path / "small"
    folder.mkdir()
    if os.geteuid() != 0:
        pytest.skip("a small tmpfs needs root")
    mount = ["mount", "-t", "tmpfs", "-o", "size=1m", "tmpfs", str(folder)]
    done = subprocess.run(mount, capture_output=True, text=True, check=False)
    if done.returncode:
        pytest.skip(f"a small tmpfs cannot be mounted here: {done.stderr.strip()}")
    yield folder
    subprocess.run(["umount", "-l", str(folder)], check=True)


def test_a_full_disk_is_said_and_survived(
    make_scans: Callable[..., Path], small_disk: Path, tmp_path: Path
) -> None:
    scans = make_scans(**{f"s{number}": "nothing" for number in range(3)})
    assert run_cheap(scans, tmp_path / "roomy").code == 0
    ballast = small_disk / "ballast"
    ballast.write_bytes(bytes(800_000))  # a job takes 200 kB: one fits, three do not
    out = small_disk / "out"
    full = run_cheap(scans, out)
    assert full.code == 1
    assert "Traceback" not in full.errors
    ends = full.endings()
    reasons = [end["reason"] for end in ends.values() if end["state"] == "set aside"]
    assert reasons
    assert all("disk is full" in reason or "No space" in reason for reason in reasons)
    for path in out.glob("*/scan"):
        assert (path / "stage.json").exists(), "half-made results under their right name"
    ballast.unlink()
    assert run_cheap(scans, out).code == 0
    assert results(out) == results(tmp_path / "roomy")
