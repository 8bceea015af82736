"""Kept messages name files by where they lie in their folder."""

from __future__ import annotations

from pathlib import Path

from bodyscan.files.relative_text import relative_text


def test_a_path_is_given_from_its_folder() -> None:
    base = Path("/home/anna.miller/scans")
    said = f"{base}/person/p1/lit.png (pair p1): is missing; so is {base}/person/p1/dark.png"
    kept = relative_text(said, base, [base / "person"])
    assert kept == "person/p1/lit.png (pair p1): is missing; so is person/p1/dark.png"


def test_a_folder_beside_is_named_from_there() -> None:
    kept = relative_text("/a/boards/b01/lit.png: is black", Path("/a/rig"), [Path("/a/boards")])
    assert kept == "../boards/b01/lit.png: is black"


def test_the_end_of_another_path_is_left_alone() -> None:
    assert relative_text("data/x.png, a/y.png", Path("a")) == "data/x.png, y.png"


def test_a_relative_path_to_here_stays() -> None:
    assert relative_text("captures/b01/lit.png", Path()) == "captures/b01/lit.png"
