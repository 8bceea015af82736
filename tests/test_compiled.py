"""Compiled loops: arithmetic as in numpy, and no need of a place to keep them."""

from __future__ import annotations

import math
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bodyscan.compiled import compiled

SOURCE = """
def share(values, whole):
    total = 0.0
    for value in values:
        total += value
    return total / whole
"""


def test_a_function_whose_file_cannot_keep_it_is_compiled_all_the_same() -> None:
    names: dict[str, Any] = {}
    exec(compile(SOURCE, "<nowhere>", "exec"), names)
    share = compiled(names["share"])
    assert share(np.array([1.0, 2.0, 3.0]), 4.0) == 1.5
    assert share.signatures  # it was compiled, not merely called


@compiled
def _ratio(one: float, other: float) -> float:
    return one / other


def test_division_by_zero_is_that_of_numpy() -> None:
    assert _ratio(1.0, 0.0) == math.inf
    assert math.isnan(_ratio(0.0, 0.0))


CALLED = """
from bodyscan.compiled import compiled

@compiled
def step():
    return {step}
"""
CALLING = """
from called import step
from bodyscan.compiled import compiled

@compiled
def twice():
    return 2 * step()

print(twice())
"""


@pytest.mark.slow
def test_a_change_of_a_called_function_in_another_file_is_noticed(tmp_path: Path) -> None:
    def says(step: int) -> int:
        (tmp_path / "called.py").write_text(CALLED.format(step=step))
        os.utime(tmp_path / "called.py", (step, step))  # a file system's clock may be coarse
        environment = {**os.environ, "PYTHONDONTWRITEBYTECODE": "1"}
        done = subprocess.run(
            [sys.executable, "calling.py"],
            cwd=tmp_path,
            env=environment,
            capture_output=True,
            text=True,
            check=True,
        )
        return int(done.stdout)

    (tmp_path / "calling.py").write_text(CALLING)
    assert says(3) == 6
    assert says(4) == 8
    assert list((tmp_path / "__pycache__").glob("calling.twice*.nbc"))  # it was kept
