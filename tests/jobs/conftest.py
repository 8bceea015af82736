"""A folder of cheap scans, and one with what a batch made of them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from cheap_batch import run_cheap, write_scans


@pytest.fixture
def make_scans(tmp_path: Path) -> Callable[..., Path]:
    """Writes scans; each keyword is a scan's name and what its stage is to do."""
    return lambda **todo: write_scans(tmp_path / "scans", **todo)


@pytest.fixture(scope="session")
def batched(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Anna's and Bert's scans, and in `out` what a batch made of them: to be copied, not changed."""
    day = tmp_path_factory.mktemp("batched")
    scans = write_scans(day / "scans", anna="nothing", bert="nothing")
    assert run_cheap(scans, day / "out").code == 0
    return day
