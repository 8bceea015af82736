"""Body meshes: filled parts, mean breath, regions."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from small_bodies import ball

from bodyscan.mesh.body import (
    DARK_CLOTH,
    HAIR,
    SKIN,
    UNSURE,
    BodyMesh,
    BreathAt,
    compute_cover_shares,
    compute_face_regions,
    compute_region_shares,
    find_filled_patches,
    select_regions,
)


def test_the_filled_share_is_weighted_by_area() -> None:
    whole = ball(radius_mm=100.0)
    height = whole.vertices[whole.faces][..., 2].mean(axis=1)
    half = replace(whole, filled=height < 100.0)
    assert half.filled_share == pytest.approx(0.5, abs=0.02)
    assert replace(whole, filled=height < 0.0).filled_share == 0.0
    used = np.arange(len(whole.vertices))
    assert whole.part(whole.vertices, whole.faces[:0], used, half.filled[:0]).filled_share == 0.0


def test_the_measured_part_has_no_filled_faces() -> None:
    whole = ball()
    part = whole.measured_part()
    assert len(part.faces) == np.count_nonzero(~whole.filled)
    assert not part.filled.any()
    kept = np.unique(whole.faces[~whole.filled])
    np.testing.assert_array_equal(part.vertices, whole.vertices[kept])
    np.testing.assert_array_equal(part.colours, whole.colours[kept])
    expected = whole.vertices[whole.faces[~whole.filled]]
    np.testing.assert_array_equal(part.vertices[part.faces], expected)


@pytest.mark.parametrize(("sigmas", "out_mm"), [((), 2.0), ((1.0,), 2.5), ((-2.0,), 1.0)])
def test_mean_breath_displaces_vertices_along_their_normals(
    sigmas: tuple[float, ...], out_mm: float
) -> None:
    mesh = ball()
    count = len(mesh.vertices)
    breath = BreathAt(np.full(count, 2.0, np.float32), np.full(count, 0.5, np.float32))
    found = replace(mesh, breath=breath).at_mean_breath(*sigmas)
    np.testing.assert_allclose(found.vertices - mesh.vertices, out_mm * mesh.normals, atol=1e-5)
    assert found.breath is None
    assert mesh.at_mean_breath() is mesh


def test_region_shares_are_weighted_by_size() -> None:
    regions = np.array([SKIN, SKIN, HAIR, UNSURE, HAIR, SKIN, SKIN, SKIN], np.uint8)
    found = compute_region_shares(regions)
    assert found == {"unsure": 0.125, "skin": 0.625, "hair": 0.25, "dark cloth": 0.0}
    sizes = np.array([0.0, 0.0, 0.3, 0.1, 0.0, 0.0, 0.0, 0.1])
    found = compute_region_shares(regions, sizes)
    assert list(found.values()) == pytest.approx([0.2, 0.2, 0.6, 0.0])
    assert list(compute_region_shares(regions, 0.0 * sizes).values()) == [0.0] * 4
    many = np.repeat(np.array([SKIN, HAIR, UNSURE], np.uint8), [990, 6, 4])
    assert compute_cover_shares(many) == {"hair": 0.006}
    assert compute_cover_shares(None) == {}


def test_a_face_has_the_region_of_two_of_its_corners() -> None:
    regions = np.array([SKIN, SKIN, HAIR, DARK_CLOTH], np.uint8)
    faces = np.array([[0, 1, 2], [0, 2, 1], [2, 0, 1], [0, 2, 3], [2, 2, 2]])
    assert compute_face_regions(regions, faces).tolist() == [SKIN, SKIN, SKIN, UNSURE, HAIR]
    found = select_regions(regions, np.array([3, -1, 0]))
    assert found is not None
    assert found.tolist() == [DARK_CLOTH, UNSURE, SKIN]
    assert select_regions(None, np.array([3])) is None


def box(*filled: str) -> BodyMesh:
    """A box of 200 x 100 x 400 mm, two faces a side, some sides filled."""
    corners = np.array([[i, j, k] for i in (0, 1) for j in (0, 1) for k in (0, 1)], float)
    quads = {
        "back": (0, 1, 3, 2), "front": (4, 6, 7, 5), "right": (0, 4, 5, 1),
        "left": (2, 3, 7, 6), "down": (0, 2, 6, 4), "up": (1, 5, 7, 3),
    }  # fmt: skip
    faces = [[q[0], q[m], q[m + 1]] for q in quads.values() for m in (1, 2)]
    return BodyMesh(
        corners * [200.0, 100.0, 400.0],
        np.array(faces),
        normals=np.zeros((8, 3), np.float32),
        sigma_mm=np.zeros(8, np.float32),
        colours=np.zeros((8, 3), np.uint8),
        filled=np.isin(np.repeat(list(quads), 2), filled),
    )


@pytest.mark.parametrize(
    ("side", "area_mm2", "centre"),
    [
        ("front", 40000.0, (200, 50, 200)),
        ("back", 40000.0, (0, 50, 200)),
        ("left", 80000.0, (100, 100, 200)),
        ("right", 80000.0, (100, 0, 200)),
        ("up", 20000.0, (100, 50, 400)),
        ("down", 20000.0, (100, 50, 0)),
    ],
)
def test_a_filled_patch_has_area_and_centre(
    side: str, area_mm2: float, centre: tuple[float, float, float]
) -> None:
    mesh = box(side)
    (patch,) = find_filled_patches(mesh)
    assert patch.area_mm2 == pytest.approx(area_mm2)
    np.testing.assert_allclose(patch.centre, centre)


def test_the_largest_patch_comes_first_and_patches_that_touch_are_one() -> None:
    for scale, order in ((0.5, ["down", "up"]), (2.0, ["up", "down"])):
        tapered = box("up", "down")
        tapered.vertices[tapered.vertices[:, 2] > 0.0, :2] *= scale
        heights = [400.0 * (side == "up") for side in order]
        assert [patch.centre[2] for patch in find_filled_patches(tapered)] == heights
    (patch,) = find_filled_patches(box("up", "left"))
    assert patch.area_mm2 == pytest.approx(100000.0)
    np.testing.assert_allclose(patch.centre, [100.0, 90.0, 240.0])  # weighted by area
    assert find_filled_patches(box()) == []
