"""Entry point of the command line: handles Ctrl-C even while modules are still being imported."""

from __future__ import annotations

import os
import sys


def start() -> None:
    """Run the command; see `bodyscan.cli.main`."""
    for name in ("stdin", "stdout", "stderr"):
        if getattr(sys, name) is None:  # closed by who started us: a file would take its place
            setattr(sys, name, open(os.devnull, "r+"))  # noqa: SIM115
    os.environ.setdefault("OPENCV_LOG_LEVEL", "SILENT")  # our errors say what is wrong with a file
    try:
        from bodyscan.cli.main import main

        main()
    except KeyboardInterrupt:
        print("stopped", file=sys.stderr, flush=True)
        os._exit(130)  # the shells' convention: 128 + SIGINT


if __name__ == "__main__":
    start()
