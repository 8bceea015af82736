"""Two flat walls that two cameras see: what a fused point's sigma is made of, and who contradicts."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from flat_walls import ASIDE, WALL_MM, wall

from bodyscan.fusion.brightness import EqualizedColours
from bodyscan.fusion.consistency import (
    Consistency,
    compare_with_surface,
    estimate_displacement_sigma,
)
from bodyscan.fusion.merging import average, estimate_sigma_inflation
from bodyscan.fusion.smoothing import SmoothSurface
from bodyscan.fusion.voxel_thinning import Samples, take_samples
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.geometry.uncertainty import PoseCovariance
from bodyscan.mesh.body import BodyCloud


def as_seen(samples: Samples, surfaces: list[SmoothSurface]) -> EqualizedColours:
    """Grey levels as the cameras gave them."""
    own = [surface.colours.astype(np.float32) for surface in surfaces]
    return EqualizedColours(samples.colours.astype(np.float32), own)


def known_to(surface: SmoothSurface, sigma_mm: float, rim: float = 1.0) -> SmoothSurface:
    """The surface with the same sigma and weight everywhere."""
    sigma = np.full(len(surface.points), sigma_mm, np.float32)
    return replace(surface, sigma_mm=sigma, weight=np.float32(rim) / sigma**2)


def compared(surfaces: list[SmoothSurface]) -> tuple[Samples, list[Consistency]]:
    samples = take_samples(surfaces, 10**6)
    return samples, [
        compare_with_surface(samples, surface, k, 1.5, 6.0) for k, surface in enumerate(surfaces)
    ]


def fused(
    further_mm: float, sigmas: tuple[float, float], rim: float = 1.0
) -> tuple[BodyCloud, Samples, list[SmoothSurface], list[Consistency]]:
    """Two walls, the second so much further and with a rim's weight, made one."""
    surfaces = [
        known_to(wall(WALL_MM, 100, RigidTransform.identity()), sigmas[0]),
        known_to(wall(WALL_MM + further_mm, 120, ASIDE), sigmas[1], rim),
    ]
    samples, consistency = compared(surfaces)
    cloud = average(samples, surfaces, consistency, as_seen(samples, surfaces))
    return cloud, samples, surfaces, consistency


@pytest.mark.parametrize(("sigmas", "rim"), [((0.1, 0.2), 1.0), ((0.1, 0.1), 0.25)])
def test_two_that_agree_are_known_better_by_their_weights(
    sigmas: tuple[float, float], rim: float
) -> None:
    """At a rim a surface counts for less, and so it does in the sigma."""
    cloud = fused(0.0, sigmas, rim)[0]
    both = cloud.pairs_seen == 2
    weights = np.array([1.0, rim]) / np.square(sigmas)
    expected = np.linalg.norm(weights * sigmas) / weights.sum()
    assert cloud.sigma_mm[both] == pytest.approx([expected] * both.sum(), rel=1e-3)
    assert set(cloud.sigma_mm[~both].round(4)) == set(np.array(sigmas, np.float32).round(4))


def test_where_a_surface_ends_there_is_no_step() -> None:
    """Its weight rises from near 0 at its rim to that of its sigma over a window."""
    surfaces = [wall(WALL_MM, 100, RigidTransform.identity()), wall(WALL_MM + 0.5, 100, ASIDE)]
    samples, consistency = compared(surfaces)
    cloud = average(samples, surfaces, consistency, as_seen(samples, surfaces))
    left, right = surfaces[1].points[:, 0].min(), surfaces[0].points[:, 0].max()
    middle = np.abs(cloud.points[:, 1]) < 20.0
    x, z = cloud.points[middle, 0], cloud.points[middle, 2]
    # A pixel of 0.7 mm or two inside, a tenth or two of the weight: less than 0.5 * 0.2 / 1.2 mm.
    assert abs(z[np.abs(x - left - 0.7) < 0.5].mean() - WALL_MM) < 0.085
    assert abs(z[np.abs(x - right + 0.7) < 0.5].mean() - WALL_MM - 0.5) < 0.085


def test_the_mean_lies_where_the_weights_say() -> None:
    cloud, *_ = fused(0.1, (0.1, 0.2))
    # Of 0.1 mm between them a fifth, by weights 4 and 1.
    assert cloud.points[cloud.pairs_seen == 2, 2] == pytest.approx(WALL_MM + 0.02, abs=2e-3)


def test_pairs_that_disagree_everywhere_are_all_less_certain() -> None:
    cloud, samples, surfaces, consistency = fused(0.5, (0.1, 0.1))
    # 0.5 mm apart, with 0.14 expected: 3.5 times, over 0.6745 since a median is compared.
    times = estimate_sigma_inflation(samples, surfaces, consistency)
    assert times == pytest.approx(0.5 / np.hypot(0.1, 0.1) / 0.6745, rel=0.01)
    mean = cloud.sigma_mm[cloud.pairs_seen == 2]
    np.testing.assert_allclose(mean, times[0] * 0.1 / np.sqrt(2.0), rtol=0.01)


def test_pairs_that_stand_apart_as_their_poses_are_known_are_no_less_certain() -> None:
    """Of 0.5 mm along z, 0.48 are explained by how well the two poses are known; a turn about z, which
    moves no point of the wall along its normal, explains nothing."""
    _, samples, surfaces, consistency = fused(0.5, (0.1, 0.1))
    first, second = (
        replace(surface, pair=name) for surface, name in zip(surfaces, "ab", strict=True)
    )
    along_z = np.diag([0.0, 0.0, 0.0, 0.0, 0.0, 0.48**2])
    about_z = np.diag([0.0, 0.0, 1.0, 0.0, 0.0, 0.0])
    unknown = estimate_sigma_inflation(samples, [first, second], consistency)
    for turned, expected in ((along_z, 0.5 / 0.5 / 0.6745), (about_z, unknown)):
        both = np.zeros((12, 12))
        both[6:, 6:] = turned
        poses = PoseCovariance(("a", "b"), both)
        found = estimate_sigma_inflation(samples, [first, second], consistency, poses)
        assert found == pytest.approx(expected, rel=0.01)
    # Errors that both share set nothing apart.
    alike = PoseCovariance(("a", "b"), np.tile(along_z, (2, 2)))
    assert estimate_sigma_inflation(samples, [first, second], consistency, alike) == pytest.approx(
        unknown, rel=1e-6
    )


def test_a_place_where_pairs_disagree_by_more_than_elsewhere_is_less_certain() -> None:
    """A strip of 20 mm, like a hem, 0.5 mm apart where 0.14 are expected."""
    surfaces = fused(0.0, (0.1, 0.1))[2]
    points = surfaces[1].points
    points[np.abs(points[:, 0]) < 10.0, 2] += 0.5
    samples, consistency = compared(surfaces)
    times, x = estimate_sigma_inflation(samples, surfaces, consistency), samples.points[:, 0]
    assert np.all(times[np.abs(x) > 31.0] == 1.0)
    assert 2.2 < times[np.abs(x) < 1.0].min() <= 2.5  # a cube may hold half of the strip
    cloud = average(samples, surfaces, consistency, as_seen(samples, surfaces))
    assert cloud.sigma_mm[np.abs(cloud.points[:, 0]) < 1.0].min() > 2.2 * 0.1 / np.sqrt(2.0)


def test_surfaces_that_look_other_ways_are_not_one() -> None:
    """The two sides of a thin wall."""
    surfaces = fused(0.0, (0.1, 0.1))[2]
    turned = replace(surfaces[1], normals=-surfaces[1].normals)
    samples = take_samples([surfaces[0], turned], 10**6)
    found = compare_with_surface(samples, turned, 1, 1.5, 6.0)
    assert not np.any(found.index < samples.starts[1])


def seen_beside(further_mm: float) -> tuple[Samples, list[SmoothSurface], Consistency]:
    """Samples of two walls, the second camera's that much further; what it says about the first's."""
    _, samples, surfaces, (_, second) = fused(further_mm, (0.1, 0.1))
    return samples, surfaces, second


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


@pytest.mark.parametrize("further_mm", [4.0, 20.0])
def test_where_surfaces_contradict_either_may_be_right(further_mm: float) -> None:
    _, samples, surfaces, (one, other) = fused(further_mm, (0.1, 0.1))
    # Those of a pole fired together: that they agree changes nothing.
    alike = replace(one, index=np.tile(np.arange(samples.starts[1]), 30))
    sigma_mm, places = estimate_displacement_sigma(samples, surfaces, [alike, other])
    assert places > 2
    near = np.all(samples.points < samples.points.min(axis=0) + 60.0, axis=1)
    few = [replace(x, against_index=x.against_index[near[x.against_index]]) for x in (alike, other)]
    assert not estimate_displacement_sigma(samples, surfaces, few)[0].any()
    # To points one in 8 of which are looked at; at the rims they are beside.
    assert 0.95 * further_mm < sigma_mm.min() < np.median(sigma_mm) < 1.4 * further_mm


def test_rims_contradict_nothing() -> None:
    for further_mm in (3.0, 0.5):
        _, surfaces, found = seen_beside(further_mm)
        inside = found.leave_out_rims(surfaces[1])
        left = len(inside.index) + len(inside.against_index)
        assert 0 < left < len(found.index) + len(found.against_index)
        assert surfaces[1].rim[[*inside.at, *inside.against_at]].min() == 1.0


def test_a_wall_in_front_says_nothing() -> None:
    """Only that the second camera does not see what lies behind."""
    _, _, consistency = seen_beside(-40.0)
    assert not consistency.index.size + consistency.against_index.size


def test_a_surface_that_was_bent_is_asked_where_its_points_went() -> None:
    """Carried 3 mm aside, which are four pixels: as of a camera that stood so, but for its rim."""
    samples, surfaces, still = seen_beside(0.8)
    moved = replace(surfaces[1], points=surfaces[1].points + np.array([3, 0, 0], "f4"), warped=True)
    found = compare_with_surface(samples, moved, 1, 1.5, 6.0)
    assert len(found.index) > 0.95 * len(still.index)
    np.testing.assert_allclose(found.shift_mm, -0.8, atol=2e-3)
    apart = moved.points[found.at] - samples.points[found.index]
    assert np.abs(apart[:, :2]).max() < 0.4 + 0.4 * 0.8 + 0.75
    asked = compare_with_surface(samples, replace(moved, warped=False), 1, 1.5, 6.0)
    off = moved.points[asked.at] - samples.points[asked.index]
    assert np.median(off[:, 0]) > 2.0, "looked up where they were"
