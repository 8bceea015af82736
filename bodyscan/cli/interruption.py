"""End a command at once on Ctrl-C, whatever it is doing.

Python handles a signal between two of its own instructions, and libraries that mesh or solve block it
for many seconds. So the work runs in a child process, and the parent, for which the shell waits,
tells the child to end, and kills it after a second.
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
STOP_SIGNAL = signal.SIGUSR1
"""Stops the child: COLMAP, where it is imported, answers a SIGTERM with a stack trace."""


SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
"""Signals that ask a command to end."""


class _StopRequest(Exception):
    """The command is to end, because of a signal of that number."""


def run_interruptibly(work: Callable[[], int]) -> int:
    """Run `work` in a child and return its exit code; after a signal, 128 and its number.

    It returns in the parent alone; the child ends with the code.
    """
    if not hasattr(os, "fork"):
        return work()
    sys.stdout.flush()
    sys.stderr.flush()
    # Until both processes know what to do.
    signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS)
    for number in SIGNALS:
        if signal.getsignal(number) != signal.SIG_IGN:
            signal.signal(number, _raise_request)
    parent = os.getpid()
    child = os.fork()
    if child == 0:
        _work(work, parent)
    try:
        signal.pthread_sigmask(signal.SIG_UNBLOCK, SIGNALS)
        return _compute_exit_code(os.waitpid(child, 0)[1])
    except _StopRequest as request:
        with suppress(ChildProcessError, ProcessLookupError):  # it has ended meanwhile
            _stop(child)
        return 128 + int(request.args[0])


def _work(work: Callable[[], int], parent: int) -> NoReturn:
    """Run in the child: a Ctrl-C of the terminal reaches both, so only the parent's signal counts."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    for number in (STOP_SIGNAL, signal.SIGTERM):
        signal.signal(number, _interrupt)
    _end_with(parent)
    try:
        signal.pthread_sigmask(signal.SIG_UNBLOCK, SIGNALS)
        code = work()
    except KeyboardInterrupt:
        code = STOPPED
    if code == STOPPED:
        _say_stopped()
    with suppress(OSError):  # nobody reads it any more
        sys.stdout.flush()
        sys.stderr.flush()
    # Without waiting for threads, or for Python to free memory piece by piece: 0.5 s after a scan.
    os._exit(code)


def _compute_exit_code(status: int) -> int:
    code = os.waitstatus_to_exitcode(status)
    if code < 0:
        name = signal.Signals(-code).name
        print(f"error: the work was ended by {name} (possibly out of memory)", file=sys.stderr)
        return 128 - code
    return code


def _stop(child: int) -> None:
    """Tell the child to end, and kill it if it does not."""
    os.kill(child, STOP_SIGNAL)
    until = time.monotonic() + 1.0  # to remove what is half written
    while os.waitpid(child, os.WNOHANG)[0] == 0:
        if time.monotonic() > until:
            os.kill(child, signal.SIGKILL)
            os.waitpid(child, 0)
            _say_stopped()
            return
        time.sleep(0.02)


def _say_stopped() -> None:
    cursor = "\x1b[?25h" if sys.stderr.isatty() else ""  # progress bars hide it
    print(f"{cursor}stopped", file=sys.stderr, flush=True)


def _raise_request(number: int, frame: FrameType | None) -> None:
    _hear_no_more()
    raise _StopRequest(number)


def _interrupt(number: int, frame: FrameType | None) -> None:
    _hear_no_more()
    raise KeyboardInterrupt


def _hear_no_more() -> None:
    """Once is enough. With SIG_IGN Python would report signals that are pending."""
    for number in (*SIGNALS, STOP_SIGNAL):
        if signal.getsignal(number) in (_raise_request, _interrupt):
            signal.signal(number, lambda number, frame: None)


def _end_with(parent: int) -> None:
    """Linux ends this process when its parent is gone, even by `kill -9`."""
    if sys.platform == "linux":
        import ctypes

        set_parent_death_signal = 1
        ctypes.CDLL(None).prctl(set_parent_death_signal, signal.SIGKILL)
        if os.getppid() != parent:
            os._exit(STOPPED)
