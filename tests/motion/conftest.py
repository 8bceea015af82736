"""A living person before sixteen pairs, cast once for all tests that follow her."""

from __future__ import annotations

import pytest
from living_body import STANDING, LivingScan, cast_living
from made_once import value_made_once
from ray_cast_scan import load_rig


@pytest.fixture(scope="session")
def standing(tmp_path_factory: pytest.TempPathFactory) -> LivingScan:
    """Standing; pixels of 4 mm."""
    return value_made_once(
        tmp_path_factory,
        "standing",
        lambda: cast_living(load_rig("four-pole-16"), STANDING, seed=2, scale=0.25),
    )
