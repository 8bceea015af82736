"""What a body mesh says of itself, on a ball."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from small_bodies import ball

from bodyscan.mesh.body import BodyMesh, BreathAt
from bodyscan.mesh.regions import (
    DARK_CLOTH,
    HAIR,
    SKIN,
    UNSURE,
    covered_shares,
    of_faces,
    regions_at,
    shares,
)


def test_what_is_filled_is_told_by_its_area() -> None:
    whole = ball(radius_mm=100.0)
    height = whole.vertices[whole.faces][..., 2].mean(axis=1)
    half = replace(whole, filled=height < 100.0)
    assert half.filled_share == pytest.approx(0.5, abs=0.02)
    assert replace(whole, filled=height < 0.0).filled_share == 0.0
    nothing = whole.part(
        whole.vertices, whole.faces[:0], np.arange(len(whole.vertices)), half.filled[:0]
    )
    assert nothing.filled_share == 0.0


def test_what_was_measured_is_left_without_the_faces_that_fill() -> None:
    whole = ball()
    part = whole.measured_part()
    assert len(part.faces) == np.count_nonzero(~whole.filled)
    assert not part.filled.any()
    kept = np.unique(whole.faces[~whole.filled])
    np.testing.assert_array_equal(part.vertices, whole.vertices[kept])
    np.testing.assert_array_equal(part.colours, whole.colours[kept])
    np.testing.assert_array_equal(
        part.vertices[part.faces], whole.vertices[whole.faces[~whole.filled]]
    )


def breathing(mesh: BodyMesh) -> BodyMesh:
    count = len(mesh.vertices)
    breath = BreathAt(np.full(count, 2.0, np.float32), np.full(count, 0.5, np.float32))
    return replace(mesh, breath=breath)


@pytest.mark.parametrize(("sigmas", "out_mm"), [(None, 2.0), (1.0, 2.5), (-2.0, 1.0)])
def test_at_mean_breath_a_body_is_carried_along_its_normals(
    sigmas: float | None, out_mm: float
) -> None:
    mesh = ball()
    full = breathing(mesh)
    found = full.at_mean_breath() if sigmas is None else full.at_mean_breath(sigmas)
    np.testing.assert_allclose(found.vertices - mesh.vertices, out_mm * mesh.normals, atol=1e-5)
    assert found.breath is None
    assert mesh.at_mean_breath() is mesh


def test_shares_of_regions_are_those_of_their_sizes() -> None:
    regions = np.array([SKIN, SKIN, HAIR, UNSURE, HAIR, SKIN, SKIN, SKIN], np.uint8)
    assert shares(regions) == {"unsure": 0.125, "skin": 0.625, "hair": 0.25, "dark cloth": 0.0}
    sizes = np.array([0.0, 0.0, 0.3, 0.1, 0.0, 0.0, 0.0, 0.1])
    assert list(shares(regions, sizes).values()) == pytest.approx([0.2, 0.2, 0.6, 0.0])
    assert list(shares(regions, 0.0 * sizes).values()) == [0.0] * 4
    many = np.repeat(np.array([SKIN, HAIR, UNSURE], np.uint8), [990, 6, 4])
    assert covered_shares(many) == {"hair": 0.006}
    assert covered_shares(None) == {}


def test_a_face_is_what_two_of_its_corners_are() -> None:
    regions = np.array([SKIN, SKIN, HAIR, DARK_CLOTH], np.uint8)
    faces = np.array([[0, 1, 2], [0, 2, 1], [2, 0, 1], [0, 2, 3], [2, 2, 2]])
    assert of_faces(regions, faces).tolist() == [SKIN, SKIN, SKIN, UNSURE, HAIR]
    found = regions_at(regions, np.array([3, -1, 0]))
    assert found is not None
    assert found.tolist() == [DARK_CLOTH, UNSURE, SKIN]
    assert regions_at(None, np.array([3])) is None
