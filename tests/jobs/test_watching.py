"""The process that stays, seen from the one that started it."""

from __future__ import annotations

import signal
import time
from pathlib import Path

from bodyscan.jobs.watching import ResidentProcess


def test_a_stuck_process_that_is_killed_is_seen_to_have_ended() -> None:
    """Its job is then tried again; were it not seen, watch would wait for it for ever."""
    process = ResidentProcess(Path("calibration"), 1, ("-c", "import time; time.sleep(600)"))
    process.start()
    try:
        assert process.status() is None
        process.kill()
        until = time.monotonic() + 30.0
        while process.status() is None and time.monotonic() < until:
            time.sleep(0.02)
        assert process.status() == -signal.SIGKILL
    finally:
        process.stop()
