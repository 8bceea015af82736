"""What is asked of an alignment on a rigid object, and what is said of it."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from living_body import STANDING, STILL, boards, cast_living, images_of
from ray_cast_scan import load_rig

from bodyscan.alignment.sway_prior import SwayPrior
from bodyscan.errors import FailedWork
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.motion import object_refinement
from bodyscan.motion.object_refinement import ObjectRefinement, refine_on_object
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
    still = SimpleNamespace(motion=None)
    monkeypatch.setattr(object_refinement, "align_person", lambda *_: still)
    nothing: Any = None
    found = refine_on_object([], {"a": HERE, "b": HERE}, nothing, {})
    assert found.rig_from_camera == {"a": THERE, "b": HERE}
    # By a ten thousandth of a millimetre at the body's centre, so that matrices have an inverse.
    assert np.abs(SwayPrior.from_settings(asked[0]).pair_covariance()[3:, 3:]).max() < 1e-7
    monkeypatch.setattr(object_refinement, "align", lambda *_: alignment(0.2))
    with pytest.raises(FailedWork, match="no two pairs see the same part"):
        refine_on_object([], {"a": HERE}, nothing, {})


def test_it_is_better_where_overlaps_lie_closer_together_by_a_twentieth() -> None:
    """Of 0.3 mm."""
    assert ObjectRefinement(alignment(0.284, "o"), {}).better
    assert not ObjectRefinement(alignment(0.286, "o"), {}).better


def test_what_it_did_is_said_with_who_moved_farthest_and_who_would_have() -> None:
    moved = alignment(0.2, "o", "p", motion_mm={"b": 0.1, "a": 0.4}, refused={"c": 7.26})
    assert ObjectRefinement(moved, {}).lines == [
        "2 overlaps: 0.300 mm RMS before, 0.200 after",
        "farthest moved: a, 0.400 mm",
        "c would move by 7.3 sigmas of the calibration: its pose was kept",
    ]
    assert len(ObjectRefinement(alignment(0.2, "o"), {}).lines) == 1


@pytest.mark.parametrize("timed", [True, False])
def test_who_moved_is_no_object(timed: bool) -> None:
    """Overlaps of a person come closer too, by moving cameras that stood right."""
    scan = cast_living(load_rig(), STANDING, seed=2, scale=0.25)
    images = images_of(scan, timed=timed)
    with pytest.raises(
        FailedWork, match=r"moved by up to \d+\.\d mm \(.*\) during the scan"
    ) as caught:
        refine_on_object(images, scan.rig_from_camera, boards(scan), {})
    assert "stands still" in caught.value.remedy


def test_a_mannequin_is_one() -> None:
    scan = cast_living(load_rig(), STILL, seed=1, scale=0.125)
    found = refine_on_object(images_of(scan), scan.rig_from_camera, boards(scan), {})
    assert len(found.alignment.overlaps) > 10
    for name, placed in found.rig_from_camera.items():
        # A few of the sigmas, 0.03 mm, to which boards know it.
        assert placed.translation == pytest.approx(scan.rig_from_camera[name].translation, abs=0.2)
