"""Thinning by voxels: how many, how even, and who is chosen."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from flat_walls import ASIDE, WALL_MM, wall
from hypothesis import given, settings
from hypothesis import strategies as st

from bodyscan.errors import ScanFailed
from bodyscan.fusion.voxel_thinning import find_voxel_size, select_per_voxel, take_samples
from bodyscan.geometry.transforms import RigidTransform


def sphere(count: int, seed: int = 0) -> np.ndarray:
    points = np.random.default_rng(seed).normal(size=(count, 3))
    return (300.0 * points / np.linalg.norm(points, axis=1, keepdims=True)).astype(np.float32)


def cells(points: np.ndarray, voxel_mm: float) -> np.ndarray:
    return np.floor((points - points.min(axis=0)) / np.float32(voxel_mm)).astype(int)


@pytest.mark.parametrize("wanted", [20_000, 100_000])
def test_as_many_as_wanted(wanted: int) -> None:
    points = sphere(600_000)
    size = find_voxel_size(points, wanted)
    chosen = select_per_voxel(points, np.zeros(len(points), bool), size)
    # One voxel in eight is counted: their number scatters by 1.5 %, and the law is not exact.
    assert abs(len(chosen) / wanted - 1.0) < 0.06


@settings(max_examples=25, deadline=None)
@given(count=st.integers(1, 300), size=st.floats(0.5, 50.0), seed=st.integers(0, 1000))
def test_one_from_each_voxel_and_the_best(count: int, size: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    points = rng.uniform(-40.0, 40.0, (count, 3)).astype(np.float32)
    poor = rng.random(count) < 0.5
    chosen = select_per_voxel(points, poor, size)
    where = cells(points, size)
    mine = {tuple(cell) for cell in where[chosen]}
    assert len(mine) == len(chosen)
    assert mine == {tuple(cell) for cell in where}
    for index in chosen[poor[chosen]]:
        # A poor point stands only where there is no better one.
        assert poor[(where == where[index]).all(axis=1)].all()


def test_small_voxels_in_a_large_box() -> None:
    """Many more voxels than points: only occupied ones take memory."""
    points = np.concatenate([sphere(2000), sphere(2000, seed=1) + np.float32(3000.0)])
    chosen = select_per_voxel(points, np.zeros(len(points), bool), 1.0)
    assert len(chosen) == len(np.unique(cells(points, 1.0), axis=0))


def test_evenly_spread() -> None:
    points = sphere(600_000)
    size = find_voxel_size(points, 40_000)
    thin = points[select_per_voxel(points, np.zeros(len(points), bool), size)]
    # The same number on each octant and each band of the sphere: cubes cut by a surface number
    # 1 to 1.5 times its area over theirs, as it runs along them or askew.
    octant = (thin > 0) @ [1, 2, 4]
    assert np.bincount(octant, minlength=8).std() < 0.02 * len(thin) / 8
    bands = np.histogram(thin[:, 2], bins=10)[0]
    assert bands.max() / bands.min() < 1.5


def test_no_sample_is_of_a_rim_where_another_surface_goes_on() -> None:
    surfaces = [wall(WALL_MM, 100, placing) for placing in (RigidTransform.identity(), ASIDE)]
    samples = take_samples(surfaces, 5000)
    left, right = surfaces[1].points[:, 0].min(), surfaces[0].points[:, 0].max()
    across, up = samples.points[:, 0], samples.points[:, 1]
    # The rim's half is five pixels of 0.7 mm; voxels, 2 mm wide, may reach beyond it.
    for beside in (np.abs(across - left) < 2.0, np.abs(across - right) < 2.0):
        beside &= np.abs(up) < 20.0
        inner = 0 if across[beside].mean() < 0.5 * (left + right) else 1
        own = np.flatnonzero(beside)
        assert np.all((own >= samples.starts[inner]) & (own < samples.starts[inner + 1]))
        assert len(own) > 20


def numbered(*counts: int) -> tuple[list[Any], np.ndarray]:
    """Surfaces of so many points each, anywhere in a box of their own; their sigma is their number
    among those of all; and all points."""
    rng, surfaces, number = np.random.default_rng(0), [], 0
    for k, count in enumerate(counts):
        points = rng.uniform([300.0 * k, 0, 0], [300.0 * k + 200.0, 200, 200], (count, 3))
        own = np.arange(number, number + count)
        surfaces.append(
            SimpleNamespace(
                points=points.astype(np.float32),
                normals=points[:, ::-1].astype(np.float32),
                sigma_mm=own.astype(np.float32),
                weight=-own.astype(np.float32),
                colours=(own[:, None] % 256).astype(np.uint8),
                rim=np.ones(count, np.float32),
            )
        )
        number += count
    return surfaces, np.concatenate([each.points for each in surfaces])


@pytest.mark.parametrize("wanted", [5000, 800])
def test_a_sample_has_all_that_belongs_to_its_point_surface_by_surface(wanted: int) -> None:
    """All points where they are no more than wanted, else a part of each surface."""
    surfaces, points = numbered(700, 500, 900)
    found = take_samples(surfaces, wanted)
    number = found.sigma_mm.astype(int)
    assert len(np.unique(number)) == len(number)
    assert (len(number) == 2100) is (wanted == 5000)
    np.testing.assert_array_equal(found.points, points[number])
    np.testing.assert_array_equal(found.normals, points[number, ::-1])
    np.testing.assert_array_equal(found.weight, -found.sigma_mm)
    np.testing.assert_array_equal(found.colours[:, 0], number % 256)
    assert (found.starts[0], found.starts[-1], len(found.starts)) == (0, len(number), 4)
    for k, (first, end) in enumerate(((0, 700), (700, 1200), (1200, 2100))):
        own = number[found.starts[k] : found.starts[k + 1]]
        assert len(own) > 0.3 * (end - first) * min(wanted / 2100.0, 1.0)
        assert (own >= first).all()
        assert (own < end).all()


def test_a_thousand_points_are_a_subject() -> None:
    assert len(take_samples(numbered(600, 400)[0], 5000).points) == 1000
    with pytest.raises(ScanFailed, match=r"next to nothing of a subject \(999 points\)"):
        take_samples(numbered(600, 399)[0], 5000)
