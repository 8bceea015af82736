"""What every test may use."""

from __future__ import annotations

import os

# As the command line does: stages share the cores out, BLAS threads inside them only get in the way.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from pathlib import Path

import pytest
from hypothesis import settings

# What is compiled is compiled at its first call, and machines may be loaded.
settings.register_profile("bodyscan", deadline=None)
settings.load_profile("bodyscan")

PROJECT = Path(__file__).parents[1]


@pytest.fixture(scope="session")
def captures() -> Path:
    """The folder of real captures; tests that need it say so when it is not there."""
    folder = Path(os.environ.get("BODYSCAN_CAPTURES", PROJECT.parent / "shared" / "captures"))
    if not folder.is_dir():
        pytest.skip(f"real captures not found at {folder} (set BODYSCAN_CAPTURES)")
    return folder
