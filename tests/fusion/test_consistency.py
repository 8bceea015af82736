"""What one surface says about another's points, on two flat walls seen by two cameras."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from flat_walls import ASIDE, WALL_MM, wall

from bodyscan.fusion.consistency import Consistency, compare_with_surface
from bodyscan.fusion.smoothing import SmoothSurface
from bodyscan.fusion.voxel_thinning import Samples, take_samples
from bodyscan.geometry.transforms import RigidTransform


def seen_beside(further_mm: float) -> tuple[Samples, list[SmoothSurface], Consistency]:
    """Samples of two walls, the second camera's that much further; what it says about the first's."""
    surfaces = [
        wall(WALL_MM, 100, RigidTransform.identity()),
        wall(WALL_MM + further_mm, 120, ASIDE),
    ]
    samples = take_samples(surfaces, 10**6)
    return samples, surfaces, compare_with_surface(samples, surfaces[1], 1, 1.5, 6.0)


@pytest.mark.parametrize("further_mm", [-1.2, 0.0, 0.8])
def test_near_walls_agree(further_mm: float) -> None:
    samples, surfaces, consistency = seen_beside(further_mm)
    own = np.arange(samples.starts[1])
    assert np.isin(consistency.index, own).all()
    # 40 mm are 54 of 160 pixels: the camera aside shows 66 % of what the other does.
    assert 0.65 < len(consistency.index) / len(own) < 0.68
    assert not consistency.against_index.size
    # Normals look at the cameras: what lies further is behind. float32 at 320 mm, and the lens.
    np.testing.assert_allclose(consistency.shift_mm, -further_mm, atol=1e-3)
    apart = surfaces[1].points[consistency.at] - samples.points[consistency.index]
    # Looked up is the pixel next to the sample: half of 0.75 mm, and the ray's slope (up to 0.4).
    assert np.abs(apart[:, :2]).max() < 0.4 + 0.4 * abs(further_mm)


@pytest.mark.parametrize("further_mm", [3.0, -3.0, 40.0])
def test_second_skins_and_what_is_seen_through_contradict(further_mm: float) -> None:
    samples, _, consistency = seen_beside(further_mm)
    assert not consistency.index.size
    assert len(consistency.against_index) > 0.6 * samples.starts[1]


def test_a_wall_in_front_says_nothing() -> None:
    """Only that the second camera does not see what lies behind."""
    _, _, consistency = seen_beside(-40.0)
    assert not consistency.index.size
    assert not consistency.against_index.size


def test_a_surface_that_was_bent_is_asked_where_its_points_went() -> None:
    """Carried 3 mm aside, which are four pixels: as of a camera that stood so, but for its rim."""
    samples, surfaces, still = seen_beside(0.8)
    aside = np.array([3.0, 0.0, 0.0], np.float32)
    moved = replace(surfaces[1], points=surfaces[1].points + aside, warped=True)
    found = compare_with_surface(samples, moved, 1, 1.5, 6.0)
    assert len(found.index) > 0.95 * len(still.index)
    np.testing.assert_allclose(found.shift_mm, -0.8, atol=2e-3)
    apart = moved.points[found.at] - samples.points[found.index]
    assert np.abs(apart[:, :2]).max() < 0.4 + 0.4 * 0.8 + 0.75
    asked = compare_with_surface(samples, replace(moved, warped=False), 1, 1.5, 6.0)
    off = moved.points[asked.at] - samples.points[asked.index]
    assert np.median(off[:, 0]) > 2.0, "looked up where they were"
