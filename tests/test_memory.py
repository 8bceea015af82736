"""Freed memory is used again, in a process that asks for it."""

from __future__ import annotations

import platform
import subprocess
import sys

import pytest

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
