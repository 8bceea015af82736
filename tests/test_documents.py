"""What the documents say of the project's files is true: links and names lead to files."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest
from slow_files import SLOW

PROJECT = Path(__file__).parents[1]
DOCUMENTS = sorted([*PROJECT.glob("*.md"), *PROJECT.glob("docs/**/*.md")])
LINK = re.compile(r"\]\((?!https?:|mailto:|#)([^)#\s]+)")
SOURCE = re.compile(r"`((?:[\w.]+/)*\w+\.py)`")
ROOMS = sorted(path.parent for path in (PROJECT / "bodyscan").glob("*/__init__.py"))
ELSEWHERE = re.compile(r"(?<![\w/.])/(?:work|home|root|tmp|Users)/\w+")


def by_name(document: Path) -> str:
    return str(document.relative_to(PROJECT))


@pytest.mark.parametrize("document", DOCUMENTS, ids=by_name)
def test_links_lead_to_files(document: Path) -> None:
    links = LINK.findall(document.read_text("utf-8"))
    assert [link for link in links if not (document.parent / link).exists()] == []


@pytest.mark.parametrize("document", DOCUMENTS, ids=by_name)
def test_source_files_named_are_there(document: Path) -> None:
    sources = {
        "/" + str(path.relative_to(PROJECT))
        for room in ("bodyscan", "benchmarks", "tests", "examples", "docs", "data")
        for path in (PROJECT / room).rglob("*.py")
    }
    named = SOURCE.findall(document.read_text("utf-8"))
    assert [n for n in named if not any(path.endswith("/" + n) for path in sources)] == []


@pytest.mark.parametrize("document", DOCUMENTS, ids=by_name)
def test_no_folder_of_the_machine_that_wrote_a_document_is_named(document: Path) -> None:
    assert ELSEWHERE.findall(document.read_text("utf-8")) == []


@pytest.mark.parametrize("room", ROOMS, ids=lambda room: str(room.name))
def test_a_room_says_where_each_of_its_files_belongs(room: Path) -> None:
    guide = ast.get_docstring(ast.parse((room / "__init__.py").read_text("utf-8"))) or ""
    named = set(re.findall(r"\w+", guide))
    files = {path.stem for path in room.glob("*.py") if not path.stem.startswith("__")}
    folders = {path.name for path in room.iterdir() if path.is_dir()}
    assert files - named == set()
    assert {name for name in named if "_" in name} - files - folders == set()


def test_every_file_in_the_list_of_slow_tests_is_there() -> None:
    assert [name for name in SLOW if not (PROJECT / "tests" / name).is_file()] == []
