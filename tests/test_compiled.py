"""Compiled loops: arithmetic as in numpy, and no need of a place to keep them."""

from __future__ import annotations

import math

import numpy as np

from bodyscan.compiled import compiled

SOURCE = """
def share(values, whole):
    total = 0.0
    for value in values:
        total += value
    return total / whole
"""


def test_a_function_whose_file_cannot_keep_it_is_compiled_all_the_same() -> None:
    names: dict = {}
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
