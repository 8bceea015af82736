"""Freed memory is used again, in a process that asks for it."""

from __future__ import annotations

import os
import platform
import subprocess
import sys
from pathlib import Path

import pytest
from made_scan import make_scan
from small_workspace import run

PROGRAM = """
import resource, sys
import numpy as np
from bodyscan.memory import keep_freed_memory

if sys.argv[1] == "keep":
    keep_freed_memory()

def faults():
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt

def use():
    images = [np.ones(size << 20, np.uint8) for size in (40, 5, 20)]
    return [image.sum() for image in images]

use()
before = faults()
use()
print(faults() - before)
"""


def faults(word: str) -> int:
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM, word], capture_output=True, text=True, check=True
    )
    return int(done.stdout)


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="only glibc's malloc is told")
def test_pages_are_fetched_once() -> None:
    # 65 MiB are 16640 pages of 4 KiB, or 32 of 2 MiB where the kernel hands those out.
    fetched, kept = faults("leave"), faults("keep")
    assert kept <= max(0.1 * fetched, 10)


LIMITED = """
import resource, sys
import numpy as np
from scipy.linalg.lapack import dpotrf
from bodyscan.memory import reserve_blas_memory

def leave(megabytes):
    used = int(open("/proc/self/statm").read().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + int(megabytes * 1e6), -1))

matrix = np.eye(600, order="F")
leave(float(sys.argv[1]))
reserve_blas_memory(1)
leave(20.0)
print(dpotrf(matrix, overwrite_a=True)[1])
"""


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux limits address space so")
@pytest.mark.parametrize(("megabytes", "expected"), [(400, "0"), (30, "MemoryError")])
def test_a_small_address_space_is_an_error_and_no_hang(megabytes: int, expected: str) -> None:
    line = [sys.executable, "-c", LIMITED, str(megabytes)]
    alone = os.environ | {"OPENBLAS_NUM_THREADS": "1"}
    done = subprocess.run(line, capture_output=True, text=True, check=False, timeout=60, env=alone)
    assert expected in done.stdout + done.stderr


@pytest.mark.parametrize("command", ["measure", "export", "report"])
def test_small_results_are_read_without_open3d_and_colmap(command: str, tmp_path: Path) -> None:
    make_scan(tmp_path)
    program = (
        "import sys; sys.modules |= {'open3d': None, 'pycolmap': None}\n"
        f"from bodyscan.cli.main import app; app([{command!r}, {str(tmp_path)!r}])"
    )
    done = subprocess.run([sys.executable, "-c", program], check=True, capture_output=True)
    for name in ("scan.json", "mesh.ply", "captures.yaml") if command != "export" else ():
        other = run(command, tmp_path, "--out", tmp_path / name)
        own = command == "measure" and name == "scan.json"
        assert ("is of the result itself" if own else "cannot be written as") in str(
            other.exception
        )
    assert b"verdict: usable" in done.stdout  # which whoever takes the result ought to know
