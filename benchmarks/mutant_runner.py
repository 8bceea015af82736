"""Runs pytest in forks of one process that has imported what is heavy: a mutant's run starts at once.

`python benchmarks/mutant_runner.py LOGS`, in a copy of the project that is changed from outside. Each
line read is JSON: `tests` (files or single tests, the nearest first), `slow` (whether slow tests are
run) and `cache`, the folder in which Numba keeps what it compiled. Each line written says which test
failed first: "" where none did, the file where one could not be imported. A test at work for longer
than PATIENCE_S hangs: it failed.
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
"""Of processor time, for one test with what it makes for others: compiling takes a minute at worst."""
PATIENCE_WALL_S = 1200.0
"""For all of a mutant's tests, asleep or awake, on a machine that others share."""
HEAVY = (
    "cv2", "networkx", "open3d", "pycolmap", "pydantic", "scipy.interpolate", "scipy.ndimage",
    "scipy.optimize", "scipy.sparse.linalg", "scipy.spatial", "scipy.stats", "typer", "yaml",
)  # fmt: skip


class FirstFailure:
    """Quick tests before slow ones, nearest files first; says in a file where the first one failed."""

    def __init__(self, answer: Path) -> None:
        self.answer = answer

    @pytest.hookimpl(tryfirst=True)
    def pytest_configure(self) -> None:
        """Hypothesis tries as few examples as in `make test-quick`, the same every time, and does not
        simplify what fails."""
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
        self.answer.write_text(nodeid, "utf-8")  # what stands there where a test never ends
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
    until = time.monotonic() + PATIENCE_WALL_S
    done, status = os.waitpid(child, os.WNOHANG)
    while not done:
        time.sleep(0.02)
        if time.monotonic() > until:
            os.killpg(child, signal.SIGKILL)
            until += PATIENCE_WALL_S
        done, status = os.waitpid(child, os.WNOHANG)
    none = (pytest.ExitCode.OK, pytest.ExitCode.NO_TESTS_COLLECTED)
    if os.WIFEXITED(status) and os.WEXITSTATUS(status) in none:
        return ""
    return answer.read_text("utf-8") or tests[0]


def _run(tests: list[str], slow: bool, cache: str, logs: Path, answer: Path) -> int:
    """In a fork, in a session of its own that can be ended as a whole: pytest's exit code."""
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
    except BaseException:  # whatever a mutant does, the fork does not go on as its parent
        return 1


def main() -> None:
    """Answers line by line until there are no more."""
    logs = Path(sys.argv[1])
    for name in HEAVY:
        __import__(name)
    for line in sys.stdin:
        asked = json.loads(line)
        print(json.dumps(_first_failure(**asked, logs=logs)), flush=True)


if __name__ == "__main__":
    main()
