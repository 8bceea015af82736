"""A disk that fills up: said in plain words, and the batch goes on when there is room again."""

from __future__ import annotations

import os
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from cheap_batch import results, run_cheap


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
    aside = [name for name, end in ends.items() if end["state"] == "set aside"]
    assert aside
    for name in aside:
        reason = ends[name]["reason"]
        assert "disk is full" in reason or "No space" in reason
    for path in out.glob("*/scan"):
        assert (path / "stage.json").exists(), "half-made results under their right name"
    ballast.unlink()
    assert run_cheap(scans, out).code == 0
    assert results(out) == results(tmp_path / "roomy")
