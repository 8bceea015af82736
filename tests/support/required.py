"""What tests need of the machine they run on: where it is missing they are skipped, in CI failed."""

from __future__ import annotations

import os
from typing import NoReturn

import pytest

IN_CI = os.environ.get("CI", "").lower() in ("1", "true", "yes")


def missing(what: str) -> NoReturn:
    """Ends the test that needs it."""
    if IN_CI:
        pytest.fail(what, pytrace=False)
    pytest.skip(what)
