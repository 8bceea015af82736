"""Sizes that nobody's rig has are asked about."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml
from ray_cast_scan import ROOT

from bodyscan.rig.rig import Rig
from bodyscan.rig.sizes import odd_sizes

RIGS = sorted((ROOT / "rigs").glob("*.yaml"))


@pytest.mark.parametrize("path", RIGS, ids=lambda path: path.stem)
def test_shipped_rigs_are_not_asked_about(path: Path) -> None:
    assert not list(odd_sizes(Rig.model_validate(yaml.safe_load(path.read_text()))))


def test_metres_and_centimetres_are_asked_about() -> None:
    told = yaml.safe_load((ROOT / "rigs" / "three-pole-12.yaml").read_text())
    told["boards"][0] |= {"square_mm": 0.07, "marker_mm": 0.05}
    told["volume"] = {"radius_mm": 0.7, "bottom_mm": 0.0, "top_mm": 2.2}
    told["pairs"][0]["nominal"] = {"position_mm": [0.65, 1.1, 0.7], "look_at_mm": [0, 0, 0.3]}
    asked = list(odd_sizes(Rig.model_validate(told)))
    assert len(asked) == 4
    assert "square_mm is 0.07 mm" in asked[0]
    assert "radius_mm is 0.7 mm" in asked[1]
    assert "pair p1-1" in asked[3]
