"""What is optional fails by itself, in a line that says so; what is not does not hide behind it."""

from __future__ import annotations

import logging
import subprocess
import sys

import pytest

from bodyscan.errors import FailedWork
from bodyscan.optional import optional


def test_a_failure_is_a_line_that_names_it_and_the_work_goes_on(
    caplog: pytest.LogCaptureFixture,
) -> None:
    said: list[str] = []
    with caplog.at_level(logging.DEBUG, "bodyscan"):
        with optional("pictures", said.append):
            raise KeyError("p1-2")
        with optional("halves", said.append):
            raise FailedWork("too few shots", remedy="take more")
        with optional("table", said.append):
            pass
    assert said == [
        "pictures: left out, failed with KeyError: 'p1-2' (the result stands; --debug shows where)",
        "halves: left out: too few shots\n  take more",
    ]
    assert "Traceback" in caplog.text


@pytest.mark.parametrize("debug", [False, True])
def test_debug_shows_where_it_failed(debug: bool) -> None:
    code = (
        "import sys\n"
        "from bodyscan.cli import main as entry\n"
        "def app(args):\n"
        "    from bodyscan.optional import optional\n"
        "    with optional('pictures', print): raise KeyError('p1')\n"
        "entry.app = app\n"
        "entry.main()\n"
    )
    arguments = ["--debug"] if debug else []
    line = [sys.executable, "-c", code, *arguments]
    done = subprocess.run(line, capture_output=True, text=True, check=True, timeout=60)
    assert done.stdout.startswith("pictures: left out")
    assert ("Traceback" in done.stderr) == debug
