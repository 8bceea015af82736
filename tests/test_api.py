"""The front door: quick to open, the same for type checkers and at run time, its examples run."""

from __future__ import annotations

import doctest
import subprocess
import sys
from inspect import signature
from pathlib import Path
from typing import get_type_hints

import pytest

import bodyscan
from bodyscan import api

PROJECT = Path(__file__).parents[1]
HEAVY = ("numpy", "open3d", "pycolmap", "cv2", "scipy", "numba", "pydantic")


def python(program: str) -> subprocess.CompletedProcess[str]:
    line = [sys.executable, "-c", program]
    return subprocess.run(line, capture_output=True, text=True, check=True, cwd=PROJECT)


def test_importing_it_costs_nothing() -> None:
    said = python(f"import bodyscan, sys; print([m for m in {HEAVY} if m in sys.modules])")
    assert said.stdout == "[]\n"


def test_a_rig_is_loaded_without_what_fuses() -> None:
    said = python(
        "import bodyscan, sys; bodyscan.load_rig('rigs/one-pair.yaml')\n"
        "print([m for m in ('open3d', 'pycolmap', 'cv2', 'numba') if m in sys.modules])"
    )
    assert said.stdout == "[]\n"


@pytest.mark.parametrize("name", api.__all__)
def test_every_name_is_there_and_says_what_it_is(name: str) -> None:
    assert getattr(bodyscan, name) is getattr(api, name)
    assert getattr(bodyscan, name).__doc__


@pytest.mark.parametrize("name", [name for name in api.__all__ if name.islower()])
def test_programs_can_ask_for_the_types_of_every_function(name: str) -> None:
    function = getattr(bodyscan, name)
    assert get_type_hints(function).keys() == {*signature(function).parameters, "return"}


def test_the_list_is_sorted_short_and_all_that_shows() -> None:
    given: dict[str, object] = {}
    exec("from bodyscan import *", given)
    assert set(api.__all__) <= set(given)
    assert dir(bodyscan) == sorted([*api.__all__, "__version__"])
    assert api.__all__ == sorted(api.__all__)
    assert (Path(bodyscan.__file__).parent / "py.typed").is_file()


def test_no_name_is_that_of_a_room() -> None:
    """Once a room is imported it would stand before the name of the same word."""
    rooms = {path.stem for path in Path(bodyscan.__file__).parent.iterdir()}
    assert not rooms & set(api.__all__)


@pytest.mark.parametrize("word", ["scann", "Path", "silent"])
def test_a_word_that_is_no_name_is_refused(word: str) -> None:
    with pytest.raises(AttributeError, match=word):
        getattr(bodyscan, word)


def test_the_examples_run(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(PROJECT)
    found = doctest.testmod(api)
    assert found.attempted >= 5
    assert found.failed == 0


def test_the_page_names_every_name() -> None:
    page = (PROJECT / "docs" / "api.md").read_text("utf-8")
    assert [name for name in api.__all__ if f"`{name}`" not in page] == []
