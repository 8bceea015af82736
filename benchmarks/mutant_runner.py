"""Runs pytest in forks of a process with all heavy imports done, so that a mutant's run starts at
once.

`python benchmarks/mutant_runner.py LOGS`, in a copy of the project that is changed from outside.
Each line read is JSON: `tests` (files or single tests, the nearest first), `slow` (whether slow
tests are run) and `cache`, the folder for Numba's compiled code. Each line written names the test
that failed first: "" if none did, the file if one could not be imported. A test that works for
longer than PATIENCE_S hangs and counts as failed.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import json
import signal
import sys
import time
from pathlib import Path

import numba
import pytest
from hypothesis import Phase, settings

PATIENCE_S = 150.0
"""Processor time for one test including its fixtures: compiling takes a minute at worst."""
PATIENCE_WALL_S = 300.0
"""Wall-clock time for one test on a machine shared with others: one that crashed may wait for ever."""
HEAVY = (
    "cv2", "networkx", "open3d", "pycolmap", "pydantic", "scipy.interpolate", "scipy.ndimage",
    "scipy.optimize", "scipy.sparse.linalg", "scipy.spatial", "scipy.stats", "typer", "yaml",
)  # fmt: skip


class FirstFailure:
    """Runs quick tests before slow ones, nearest files
    first; writes the first failure to a file."""

    def __init__(self, answer: Path) -> None:
        self.answer = answer

    @pytest.hookimpl(tryfirst=True)
    def pytest_configure(self) -> None:
        """Let Hypothesis try as few examples as in `make test-quick`, the same every time, and not
        shrink failures."""
        settings.register_profile(
            "mutants",
            deadline=None,
            derandomize=True,
            database=None,
            max_examples=20,
            phases=(Phase.explicit, Phase.generate),
        )

    @pytest.hookimpl(trylast=True)
    def pytest_collection_modifyitems(
        self, config: pytest.Config, items: list[pytest.Item]
    ) -> None:
        files = [Path(one.partition("::")[0]).resolve() for one in config.args]
        items.sort(key=lambda one: (bool(one.get_closest_marker("slow")), files.index(one.path)))

    def pytest_runtest_logstart(self, nodeid: str) -> None:
        self.answer.write_text(nodeid, "utf-8")  # this remains if a test never ends
        signal.setitimer(signal.ITIMER_PROF, PATIENCE_S)

    def pytest_collectreport(self, report: pytest.CollectReport) -> None:
        if report.failed:
            self.answer.write_text(report.nodeid, "utf-8")


def _first_failure(tests: list[str], slow: bool, cache: str, logs: Path) -> str:
    answer = logs / "answer"
    answer.write_text("", "utf-8")
    child = os.fork()
    if not child:
        os._exit(_run(tests, slow, cache, logs, answer))
    done, status = os.waitpid(child, os.WNOHANG)
    while not done:
        time.sleep(0.02)
        if time.time() - answer.stat().st_mtime > PATIENCE_WALL_S:
            os.killpg(child, signal.SIGKILL)
        done, status = os.waitpid(child, os.WNOHANG)
    none = (pytest.ExitCode.OK, pytest.ExitCode.NO_TESTS_COLLECTED)
    if os.WIFEXITED(status) and os.WEXITSTATUS(status) in none:
        return ""
    return answer.read_text("utf-8") or tests[0]


def _run(tests: list[str], slow: bool, cache: str, logs: Path, answer: Path) -> int:
    """pytest's exit code from a fork, which has a session of
    its own that can be killed as a whole."""
    try:
        os.setsid()
        log = os.open(logs / "log", os.O_CREAT | os.O_WRONLY | os.O_TRUNC)
        os.dup2(log, 1)
        os.dup2(log, 2)
        os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
        os.environ["NUMBA_CACHE_DIR"] = numba.config.CACHE_DIR = cache
        options = ["-x", "-q", "--tb=short", "-p", "no:cacheprovider", "-p", "no:xdist"]
        options += [] if slow else ["-m", "not slow"]
        options += ["--hypothesis-profile=mutants", f"--basetemp={logs / 'made'}"]
        return int(pytest.main([*options, *tests], [FirstFailure(answer)]))
    except BaseException:  # whatever a mutant does, the fork must not go on as its parent
        return 1


def main() -> None:
    """Answer line by line until there are no more."""
    logs = Path(sys.argv[1])
    for name in HEAVY:
        __import__(name)
    for line in sys.stdin:
        asked = json.loads(line)
        print(json.dumps(_first_failure(**asked, logs=logs)), flush=True)


if __name__ == "__main__":
    main()
