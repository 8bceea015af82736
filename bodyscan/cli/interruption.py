"""Ctrl-C ends a command at once, whatever it is in the middle of.

Python hears of a signal between two of its own instructions, and libraries that mesh or solve stay
away for many seconds, all threads of Python with them. So the work runs in a process of its own, and
the one that the shell waits for only waits: it asks the other to end, and soon makes it.
"""

from __future__ import annotations

import os
import signal
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from types import FrameType
from typing import NoReturn

STOPPED = 130  # as shells have it: 128 + SIGINT
GRACE_S = 1.0  # for taking away what is half written
LOOK_S = 0.02


ASKED = signal.SIGUSR1
"""By which the child is asked: COLMAP, where it is imported, answers a SIGTERM with a stack trace."""
ENDING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
SHOW_CURSOR = "\x1b[?25h"


class _Asked(Exception):
    """Someone wants the command to end, by a signal of that number."""


def run_interruptibly(work: Callable[[], int]) -> int:
    """The exit code of `work`, run in a child; of a signal 128 and its number, and a line that says so.

    It returns in the parent alone; the child ends with the code.
    """
    if not hasattr(os, "fork"):
        return work()
    sys.stdout.flush()
    sys.stderr.flush()
    heard = [number for number in ENDING if signal.getsignal(number) != signal.SIG_IGN]
    for number in heard:
        signal.signal(number, _ask)
    parent = os.getpid()
    child = os.fork()
    if child == 0:
        _work(work, parent)
    try:
        return _code(os.waitpid(child, 0)[1])
    except _Asked as asked:
        for number in heard:
            signal.signal(number, signal.SIG_IGN)
        _stop(child)
        return 128 + int(asked.args[0])


def _work(work: Callable[[], int], parent: int) -> NoReturn:
    """In the child: a Ctrl-C of the terminal reaches both, so only the parent's word counts."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    for number in (ASKED, signal.SIGTERM):
        signal.signal(number, _interrupt)
    _end_with(parent)
    try:
        code = work()
    except KeyboardInterrupt:
        code = STOPPED
    if code == STOPPED:
        _say_stopped()
    with suppress(OSError):  # nobody reads it any more
        sys.stdout.flush()
        sys.stderr.flush()
    # Without waiting for threads, of which nobody wants anything any more, and for Python to give back
    # memory and modules one by one: half a second after a scan.
    os._exit(code)


def _code(status: int) -> int:
    code = os.waitstatus_to_exitcode(status)
    if code < 0:
        name = signal.Signals(-code).name
        print(f"error: the work was ended by {name} (out of memory?)", file=sys.stderr)
        return 128 - code
    return code


def _stop(child: int) -> None:
    """Asks the child to end, and ends it if it does not."""
    os.kill(child, ASKED)
    until = time.monotonic() + GRACE_S
    while os.waitpid(child, os.WNOHANG)[0] == 0:
        if time.monotonic() > until:
            os.kill(child, signal.SIGKILL)
            os.waitpid(child, 0)
            _say_stopped()
            return
        time.sleep(LOOK_S)


def _say_stopped() -> None:
    cursor = SHOW_CURSOR if sys.stderr.isatty() else ""  # progress bars hide it
    print(f"{cursor}stopped", file=sys.stderr, flush=True)


def _ask(number: int, frame: FrameType | None) -> None:
    raise _Asked(number)


def _interrupt(number: int, frame: FrameType | None) -> None:
    signal.signal(number, signal.SIG_IGN)  # once is enough: what tidies up is not to be disturbed
    raise KeyboardInterrupt


def _end_with(parent: int) -> None:
    """Linux ends this process when its parent is gone, even by `kill -9`."""
    if sys.platform == "linux":
        import ctypes

        set_parent_death_signal = 1
        ctypes.CDLL(None).prctl(set_parent_death_signal, signal.SIGKILL)
        if os.getppid() != parent:
            os._exit(STOPPED)
