"""Ctrl-C ends a command soon and in one line, whatever it is busy with."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from subprocess import PIPE

import pytest
from processes import has_ended, wait_for

SOON_S = 2.0
BUSY = {
    "waiting": "import time; time.sleep(30)",
    # As a library does that meshes for half a minute: no Python runs meanwhile, in no thread.
    "in a library": "import ctypes; ctypes.PyDLL(None).sleep(30)",
    # As COLMAP does, which answers it with a stack trace.
    "with a library that hears signals": (
        "import signal, time; signal.signal(signal.SIGTERM, signal.SIG_DFL); time.sleep(30)"
    ),
    "in threads": (
        "import ctypes; from concurrent.futures import ThreadPoolExecutor\n"
        "    with ThreadPoolExecutor(2) as pool: list(pool.map(ctypes.CDLL(None).sleep, [30, 30]))"
    ),
}


def start(work: str) -> subprocess.Popen[str]:
    """A process that has told its child's number and is at work."""
    program = (
        "import os, sys\n"
        "from bodyscan.cli.interruption import run_interruptibly\n"
        "def work():\n"
        "    print(os.getpid(), flush=True)\n"
        f"    {work}\n"
        "    return 7\n"
        "sys.exit(run_interruptibly(work))\n"
    )
    # Started in a shell's background, as CI may be, processes inherit that Ctrl-C is ignored.
    heard = "import signal, sys; signal.signal(signal.SIGINT, signal.default_int_handler)\n"
    line = [sys.executable, "-c", heard + program]
    return subprocess.Popen(line, stdout=PIPE, stderr=PIPE, text=True, start_new_session=True)


def child_of(process: subprocess.Popen[str]) -> int:
    assert process.stdout is not None
    return int(process.stdout.readline())


@pytest.mark.parametrize("busy", BUSY)
@pytest.mark.parametrize("whole_group", [True, False])  # as a terminal does, and as `kill` does
def test_ctrl_c_ends_the_work(busy: str, whole_group: bool) -> None:
    process = start(BUSY[busy])
    child_of(process)
    time.sleep(0.1)
    since = time.monotonic()
    (os.killpg if whole_group else os.kill)(process.pid, signal.SIGINT)
    _, errors = process.communicate(timeout=30)
    assert time.monotonic() - since < SOON_S
    assert process.returncode == 130
    assert errors == "stopped\n"


def test_two_signals_at_once_are_one() -> None:
    process = start(BUSY["waiting"])
    child_of(process)
    for number in (signal.SIGSTOP, signal.SIGTERM, signal.SIGINT, signal.SIGHUP, signal.SIGCONT):
        os.killpg(process.pid, number)
    _, errors = process.communicate(timeout=30)
    assert process.returncode in (129, 130, 143)
    assert errors == "stopped\n"


def test_the_work_ends_with_who_waits_for_it() -> None:
    if not Path("/proc").exists():
        pytest.skip("Linux alone ends a process with its parent")
    process = start(BUSY["in a library"])
    child = child_of(process)
    process.kill()
    process.wait()
    wait_for(lambda: has_ended(child), 10.0)


def test_the_exit_code_is_that_of_the_work() -> None:
    process = start("pass")
    process.communicate(timeout=30)
    assert process.returncode == 7


def test_work_that_the_system_kills_is_told() -> None:
    process = start("os.kill(os.getpid(), 9)")
    _, errors = process.communicate(timeout=30)
    assert process.returncode == 137
    assert errors == "error: the work was ended by SIGKILL (possibly out of memory)\n"


def test_ctrl_c_is_heard_while_modules_are_imported() -> None:
    program = (
        "import sys\n"
        "class Slow:\n"
        "    def find_spec(self, name, *_):\n"
        "        if name == 'bodyscan.cli.main': raise KeyboardInterrupt\n"
        "sys.meta_path.insert(0, Slow())\n"
        "from bodyscan.__main__ import start\n"
        "start()\n"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "stopped\n")
