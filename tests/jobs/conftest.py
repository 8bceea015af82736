"""A folder of cheap scans."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest


@pytest.fixture
def make_scans(tmp_path: Path) -> Callable[..., Path]:
    """Writes scans; each keyword is a scan's name and what its stage is to do."""

    def make(**todo: str) -> Path:
        for name, what in todo.items():
            folder = tmp_path / "scans" / name
            folder.mkdir(parents=True)
            (folder / "do.txt").write_text(what)
            (folder / "image.txt").write_text(f"image of {name}")
        return tmp_path / "scans"

    return make
