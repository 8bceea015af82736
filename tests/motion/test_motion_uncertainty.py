"""What a followed person's sigmas hold."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from living_body import LivingScan

from bodyscan.alignment.overlaps import OverlapPoints
from bodyscan.geometry.robust import rms
from bodyscan.motion.body_cells import BodyCells
from bodyscan.motion.body_motion import BodyMotion, girth_sigmas, shape_sigmas
from bodyscan.settings import AlignmentSettings


@pytest.fixture(scope="module")
def cells(standing: LivingScan) -> BodyCells:
    """Of a person, as all pairs together show them."""
    spacing_mm = AlignmentSettings().spacing_mm
    both = [
        (standing.rig_from_camera[one.pair], OverlapPoints.from_image(one, spacing_mm))
        for one in standing.exact
    ]
    points = [place.apply(seen.inner.points) for place, seen in both]
    normals = [place.rotate(seen.inner.normals) for place, seen in both]
    return BodyCells.from_points(np.concatenate(points), np.concatenate(normals))[0]


def test_a_girth_is_uncertain_by_what_all_around_it_shares() -> None:
    """Errors of many cells, each by itself, cancel around a girth; one of them all does not."""
    height = np.repeat([1000.0, 1200.0], 50)
    alone, together = np.eye(100), np.ones((100, 1))
    np.testing.assert_allclose(girth_sigmas(together, height), 1.0)
    np.testing.assert_allclose(girth_sigmas(alone, height), 50.0**-0.5)


def certain(motion: BodyMotion) -> BodyMotion:
    """With amplitudes that are known."""
    pose, *others = motion.kinds
    known = (replace(kind, precision=1e8 * np.eye(kind.count)) for kind in others)
    return replace(motion, kinds=(pose, *known))


def test_a_place_that_two_saw_alike_is_as_uncertain_as_one_and_one_that_errs_by_itself_less(
    cells: BodyCells,
) -> None:
    """Pairs' own errors average out over those who saw a place."""
    boards = np.diag(np.tile([1e-12] * 3 + [0.1**2] * 3, 4))
    motion = certain(
        BodyMotion.at_rest(cells, [0.0, 0.0, 0.0, 0.0], 0.0, boards, np.full(6, 1e-3))
    )._solve()
    seen = np.zeros((4, len(cells.centres)), bool)
    left = cells.centres[:, 1] > 0.0
    seen[0, left], seen[1, ~left] = True, True
    once, girth = shape_sigmas(motion, cells, seen)
    seen[2, left], seen[3, ~left] = True, True
    twice, _ = shape_sigmas(motion, cells, seen)
    assert 0.0 < rms(girth) < rms(once)
    assert rms(twice) == pytest.approx(rms(once) / np.sqrt(2.0), rel=0.05)
