"""What is asked of an alignment on a rigid object, and what is said of it."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from bodyscan.alignment import object_refinement
from bodyscan.alignment.object_refinement import ObjectRefinement, refine_on_object
from bodyscan.alignment.sway_prior import SwayPrior
from bodyscan.errors import FailedWork
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.settings import AlignmentSettings

HERE = RigidTransform.identity()
THERE = RigidTransform(np.eye(3), np.array([1.0, 0.0, 0.0]))


def alignment(after_mm: float = 0.2, *overlaps: str, **more: Any) -> Any:
    found = {"motion_mm": {}, "refused": {}, "rig_from_camera": {"a": THERE}, **more}
    return SimpleNamespace(overlaps=overlaps, rms_before_mm=0.3, rms_after_mm=after_mm, **found)


def test_an_object_does_not_sway(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[AlignmentSettings] = []

    def align(images: Any, placed: Any, prior: Any, settings: AlignmentSettings) -> Any:
        asked.append(settings)
        return alignment(0.2, "overlap")

    monkeypatch.setattr(object_refinement, "align", align)
    nothing: Any = None
    found = refine_on_object([], {"a": HERE, "b": HERE}, nothing)
    assert found.rig_from_camera == {"a": THERE, "b": HERE}
    # By a ten thousandth of a millimetre at the body's centre, so that matrices have an inverse.
    assert np.abs(SwayPrior.of(asked[0]).of_one()[3:, 3:]).max() < 1e-7
    monkeypatch.setattr(object_refinement, "align", lambda *_: alignment(0.2))
    with pytest.raises(FailedWork, match="no two pairs see the same part"):
        refine_on_object([], {"a": HERE}, nothing)


def test_it_is_better_where_overlaps_lie_closer_together() -> None:
    assert ObjectRefinement(alignment(0.29, "o"), {}).better
    assert not ObjectRefinement(alignment(0.31, "o"), {}).better


def test_what_it_did_is_said_with_who_moved_farthest_and_who_would_have() -> None:
    moved = alignment(0.2, "o", "p", motion_mm={"b": 0.1, "a": 0.4}, refused={"c": 7.26})
    assert ObjectRefinement(moved, {}).lines == [
        "2 overlaps: 0.300 mm RMS before, 0.200 after",
        "farthest moved: a, 0.400 mm",
        "c would have moved by 7.3 sigmas, more than the boards allow: left as is",
    ]
    assert len(ObjectRefinement(alignment(0.2, "o"), {}).lines) == 1
