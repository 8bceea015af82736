"""What tests cost: `pytest --processor-seconds` says it at the end, of whole files and of tests.

Beside other work on the same cores times on the wall say nothing. Counted is what the process and
those that it started and waited for spent, fixtures and compiling included.
"""

from __future__ import annotations

import os
from collections import defaultdict
from collections.abc import Generator

import pytest

NAME = "processor seconds"
MOST = 20


class ProcessorSeconds:
    """A plugin of pytest: each worker measures, the process that hands tests out adds up."""

    def __init__(self) -> None:
        self.began = 0.0
        self.of_tests: dict[str, float] = {}

    @pytest.hookimpl(tryfirst=True)
    def pytest_runtest_logstart(self) -> None:
        self.began = spent()

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_makereport(
        self, call: pytest.CallInfo[None]
    ) -> Generator[None, pytest.TestReport, pytest.TestReport]:
        report = yield
        if call.when == "teardown":
            report.user_properties.append((NAME, spent() - self.began))
        return report

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        for name, value in report.user_properties:
            if name == NAME and report.when == "teardown":
                self.of_tests[report.nodeid] = float(str(value))

    def pytest_terminal_summary(self, terminalreporter: pytest.TerminalReporter) -> None:
        for line in summary(self.of_tests):
            terminalreporter.write_line(line)


def spent() -> float:
    """By this process and by those of its children that have ended, s."""
    times = os.times()
    return times.user + times.system + times.children_user + times.children_system


def summary(of_tests: dict[str, float]) -> list[str]:
    """All, the dearest files and the dearest tests, s."""
    of_files: dict[str, float] = defaultdict(float)
    for name, seconds in of_tests.items():
        of_files[name.split("::")[0]] += seconds
    lines = [f"{NAME}: {sum(of_tests.values()):.0f} in {len(of_tests)} tests"]
    for costs in (of_files, of_tests):
        dearest = sorted(costs.items(), key=lambda cost: -cost[1])[:MOST]
        lines += ["", *(f"{seconds:7.1f}  {name}" for name, seconds in dearest)]
    return lines
