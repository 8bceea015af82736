"""What the documents say of the project's files is true: links and names lead to files."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

PROJECT = Path(__file__).parents[1]
DOCUMENTS = sorted([*PROJECT.glob("*.md"), *PROJECT.glob("docs/**/*.md")])
LINK = re.compile(r"\]\((?!https?:|mailto:|#)([^)#\s]+)")
SOURCE = re.compile(r"`((?:[\w.]+/)*\w+\.py)`")
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
        for room in ("bodyscan", "benchmarks", "tests", "examples", "docs")
        for path in (PROJECT / room).rglob("*.py")
    }
    named = SOURCE.findall(document.read_text("utf-8"))
    assert [n for n in named if not any(path.endswith("/" + n) for path in sources)] == []


@pytest.mark.parametrize("document", DOCUMENTS, ids=by_name)
def test_no_folder_of_the_machine_that_wrote_a_document_is_named(document: Path) -> None:
    assert ELSEWHERE.findall(document.read_text("utf-8")) == []
