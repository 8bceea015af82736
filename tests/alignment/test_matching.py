"""Spots that two cameras see of one wavy surface, and who is tied to whom by what they share."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import networkx as nx
import numpy as np
import pytest
from ball import ball_points, range_image_of
from ring import looking_at

from bodyscan.alignment import overlaps
from bodyscan.alignment.matching import Matches, SampledPoints, match_projected, sample_points
from bodyscan.alignment.overlaps import OverlapPoints, map_overlaps, match_overlap
from bodyscan.geometry.camera import Camera
from bodyscan.geometry.lenses.opencv import Radial
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.reconstruction.range_image import RangeImage
from bodyscan.rig.rig import find_connected_groups

CAMERA = Camera(400.0, 404.0, -1.0, 158.0, 130.0, Radial(-0.12, 0.03), 320, 256)
CENTRE, RADIUS = np.array([0.0, 0.0, 900.0]), 250.0
SIGMA_MM = 0.2
HOLE = np.s_[100:130, 150:190]


def seen(name: str, rig_from_camera: RigidTransform) -> RangeImage:
    """A ball of 250 mm radius, its points and normals exact; a hole in what the camera saw."""
    centre = rig_from_camera.inverse().apply(CENTRE)
    points = ball_points(CAMERA, centre, RADIUS)
    points[HOLE] = np.nan
    normals = (points - centre) / RADIUS
    return range_image_of(CAMERA, points, normals, sigma_mm=SIGMA_MM, pair=name, grey=150)


Two = list[tuple[SampledPoints, RigidTransform]]


@pytest.fixture(scope="module")
def two() -> Two:
    places = [
        looking_at([1300.0 * np.cos(a), 1300.0 * np.sin(a), 950.0], CENTRE) for a in (0.2, 0.9)
    ]
    return [(sample_points(seen(f"p{k}", t), 5.0)[0], t) for k, t in enumerate(places)]


def test_a_patch_is_about_evenly_spread(two: Two) -> None:
    for part, _ in two:
        # 1050 mm away a pixel is 2.6 mm: every second one is the nearest to 5 mm.
        gaps = np.linalg.norm(np.diff(part.points, axis=0), axis=1)
        assert np.percentile(gaps, 10) > 4.9
        assert np.median(gaps) < 7.5
        facing = -np.sum(part.points * part.normals, axis=1) / np.linalg.norm(part.points, axis=1)
        assert facing.min() > 0.3
        np.testing.assert_allclose(part.sigma_mm, SIGMA_MM * facing, rtol=1e-6)
        assert 0.0 < part.in_margin.mean() < 0.3


def test_matches_lie_on_the_surface(two: Two) -> None:
    (a, rig_from_a), (b, rig_from_b) = two
    found = match_projected(a, b, rig_from_a, rig_from_b, 6.0)
    assert len(found.distances) > 500
    outward = found.points - CENTRE
    np.testing.assert_allclose(np.linalg.norm(outward, axis=1), RADIUS, atol=1e-3)
    # The mean of two normals of a ball less than 6 mm apart.
    assert np.sum(found.normals * outward, axis=1).min() > 0.999 * RADIUS
    # Along the mean of both normals a ball's points agree to float32, wherever on it they lie.
    assert np.abs(found.distances).max() < 2e-3
    assert np.all((found.sigma_mm > 0.3 * SIGMA_MM) & (found.sigma_mm < 1.5 * SIGMA_MM))


def test_projected_points_are_those_that_the_camera_saw(two: Two) -> None:
    """Each matched point lands, lens and all, on a pixel away from rims and the hole."""
    (a, rig_from_a), (b, rig_from_b) = two
    found = match_projected(a, b, rig_from_a, rig_from_b, 6.0)
    pixels = np.rint(CAMERA.project(rig_from_b.inverse().apply(found.points))).astype(int)
    assert np.all(b.inner[pixels[:, 1], pixels[:, 0]])
    grown = np.zeros_like(b.inner)
    grown[96:134, 146:194] = True
    assert not np.any(grown[pixels[:, 1], pixels[:, 0]])
    # And none is left out without a reason: all that face both cameras and are inside are there.
    rig = rig_from_a.apply(a.points[~a.in_margin])
    local, normals = rig_from_b.inverse().apply(rig), (rig - CENTRE) / RADIUS
    facing = -np.sum(rig_from_b.inverse().rotate(normals) * local, axis=1)
    facing /= np.linalg.norm(local, axis=1)
    columns, rows = np.rint(CAMERA.project(local)).astype(int).T
    inside = (columns >= 0) & (columns < 320) & (rows >= 0) & (rows < 256)
    expected = np.zeros(len(rig), bool)
    expected[inside] = b.inner[rows[inside], columns[inside]] & (facing[inside] > 0.3)
    np.testing.assert_allclose(found.points, rig[expected], atol=1e-9)


@pytest.mark.parametrize(
    "part", [np.s_[130:256, 0:320], np.s_[0:140, 0:320], np.s_[0:256, 130:185]]
)
def test_what_lies_outside_of_the_part_that_was_kept_has_no_match(
    two: Two, part: tuple[slice, slice]
) -> None:
    (a, rig_from_a), (b, rig_from_b) = two
    image, (rows, columns) = b.image, part
    kept = replace(
        image,
        points=image.points[part],
        normals=image.normals[part],
        sigma_mm=image.sigma_mm[part],
        colours=image.colours[part],
        corner=(rows.start, columns.start),
    )
    whole, cut = (
        match_projected(a, one, rig_from_a, rig_from_b, 6.0)
        for one in (b, replace(b, image=kept, inner=b.inner[part]))
    )
    column, row = np.rint(CAMERA.project(rig_from_b.inverse().apply(whole.points))).astype(int).T
    inside = (rows.start <= row) & (row < rows.stop) & (columns.start <= column)
    inside &= column < columns.stop
    assert 0.1 < inside.mean() < 0.9
    np.testing.assert_array_equal(cut.source, whole.source[inside])


def test_a_shift_is_measured_along_the_normals(two: Two) -> None:
    (a, rig_from_a), (b, rig_from_b) = two
    shift = np.array([0.4, -0.3, 0.5])
    away = RigidTransform(rig_from_a.rotation, rig_from_a.translation + shift)
    found = match_projected(a, b, away, rig_from_b, 6.0)
    assert len(found.distances) > 500
    # Of two balls 0.7 mm apart: second order is 0.7^2 / 250 mm.
    np.testing.assert_allclose(found.distances, found.normals @ shift, atol=5e-3)


def test_nothing_farther_than_the_reach(two: Two) -> None:
    (a, rig_from_a), (b, rig_from_b) = two
    inward = 8.0 * rig_from_a.rotation[:, 2]
    away = RigidTransform(rig_from_a.rotation, rig_from_a.translation + inward)
    near, far = (match_projected(a, b, away, rig_from_b, reach) for reach in (5.0, 12.0))
    assert np.abs(near.distances).max(initial=0.0) < 5.0
    assert np.abs(far.distances).max() > 6.0
    assert len(near.distances) < len(far.distances)


def test_cameras_on_opposite_sides_share_nothing(two: Two) -> None:
    (a, rig_from_a), _ = two
    opposite = looking_at(2.0 * CENTRE - rig_from_a.translation, CENTRE)
    other = sample_points(seen("p2", opposite), 5.0)[0]
    assert len(match_projected(a, other, rig_from_a, opposite, 6.0).distances) == 0


def test_groups_are_what_ties_join_by_way_of_any() -> None:
    rng = np.random.default_rng(3)
    for count in range(1, 60):
        names = [f"p{k}" for k in range(rng.integers(1, 12))]
        ties = [(names[a], names[b]) for a, b in rng.integers(len(names), size=(count // 4, 2))]
        graph = nx.Graph(ties)
        graph.add_nodes_from(names)
        found = find_connected_groups(names, ties)
        assert sorted(map(sorted, found)) == sorted(map(sorted, nx.connected_components(graph)))
        assert found == sorted(found, key=lambda group: min(map(names.index, group)))


@pytest.mark.parametrize(
    ("inner", "whole", "found"),
    [(10, 50, 10), (9, 50, 50), (9, 10, 10), (9, 9, None), (0, 0, None)],
)
def test_rims_are_asked_where_the_inner_parts_share_too_little(
    inner: int, whole: int, found: int | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What rims say is believed less: 0.3 mm more."""
    both: Any = OverlapPoints("inner", "whole")  # type: ignore[arg-type]
    here: Any = 1
    there: Any = 2
    counts = {"inner": inner, "whole": whole}

    def match(source: str, target: str, here: int, there: int, reach_mm: float) -> Matches:
        assert (source, here, there, reach_mm) == (target, 1, 2, 5.0)
        count = counts[source]
        nowhere, ones = np.zeros((count, 3)), np.ones(count)
        return Matches(nowhere, nowhere, ones, 0.4 * ones, np.arange(count))

    monkeypatch.setattr(overlaps, "match_projected", match)
    told = match_overlap(both, both, here, there, 5.0, 10)
    assert (None if told is None else len(told.distances)) == found
    if told is not None:
        sigma = 0.4 if inner >= 10 else 0.5
        np.testing.assert_allclose(told.sigma_mm, sigma)


def test_every_two_images_are_asked_both_ways() -> None:
    found = map_overlaps(3, lambda i, j: None if (i, j) == (1, 2) else 10 * i + j)
    assert found == {(0, 1): 1, (0, 2): 2, (1, 0): 10, (2, 0): 20, (2, 1): 21}
