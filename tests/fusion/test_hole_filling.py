"""Harmonic filling of holes, and the coarse grid that it is done on."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from ball import range_image_of
from made_bodies import cloud_of
from meshed import mesh
from ray_cast_scan import looking, nominal_camera

from bodyscan.arrays import Array
from bodyscan.fusion.hole_filling import CELL_MM, fill_distances, fill_harmonically
from bodyscan.fusion.signed_distances import (
    Distances,
    find_crossed_bricks,
    interpolate_distances,
    splat_planes,
)
from bodyscan.mesh.body import BodyCloud
from bodyscan.mesh.surface_nets import SIDE, Bricks, join_bricks
from bodyscan.mesh.topology import compute_topology
from bodyscan.rig.pair import NominalPose
from bodyscan.settings import MeshSettings


def ball(centre: tuple[float, float, float], radius: float, count: int) -> BodyCloud:
    ways = np.random.default_rng(0).normal(size=(count, 3))
    ways /= np.linalg.norm(ways, axis=1, keepdims=True)
    return cloud_of(centre + radius * ways, ways)


@pytest.mark.parametrize("shape", [(32, 48, 64), (34, 34, 34)])
def test_the_zero_set_of_a_linear_field_is_filled_exactly(shape: tuple[int, int, int]) -> None:
    """Linear values are harmonic: whatever part of them is missing comes back, exactly where they
    change their sign, and elsewhere with the right sign. 34 nodes are halved once only."""
    i, j, k = np.indices(shape).astype(np.float32)
    truth = 0.2 * (i - 15.0) - 0.1 * (j - 20.0) + 0.05 * (k - 30.0)
    fixed = np.ones(truth.shape, bool)
    fixed[4:28, 6:-8, 8:-14] = False
    nowhere = np.full(truth.shape, -np.inf, np.float32)
    found = fill_harmonically(np.where(fixed, truth, 99.0), fixed, nowhere, certain=100.0)
    near = np.abs(truth) < 0.4  # two nodes, at 0.2 a node
    # Sixteen sweeps after the coarser grids: a quarter of a node.
    assert np.abs(found - truth)[near].max() < 0.05
    assert (np.sign(found) == np.sign(truth))[~near].all()
    np.testing.assert_array_equal(found[fixed], truth[fixed])


def test_bounds_hold_and_reach_no_farther_than_they_must() -> None:
    fixed = np.ones((32, 32, 32), bool)
    fixed[1:-1, 1:-1, 1:-1] = False
    values, least = (np.full(fixed.shape, value, np.float32) for value in (-1.0, -np.inf))
    least[12:20, 12:20, 12:20] = 0.5
    found = fill_harmonically(values, fixed, least, certain=10.0)
    assert (found >= least).all()
    assert found.max() == pytest.approx(0.5, abs=1e-6)
    assert found[2, 2, 2] < -0.9


def test_a_bound_too_narrow_for_coarser_grids_pushes_the_surface_as_far_as_a_wide_one() -> None:
    """Between plates at -1 values fall from a bound of one node, 16 nodes away from either: no coarser
    grid knows of the bound."""
    fixed = np.ones((32, 64, 32), bool)
    fixed[1:-1, 1:-1, 1:-1] = False
    fixed[:, [16, 48]] = True
    values, least = (np.full(fixed.shape, value, np.float32) for value in (-1.0, -np.inf))
    least[1:-1, 32, 1:-1] = 1.0
    found = fill_harmonically(values, fixed, least, certain=10.0)
    # Halfway it would be 8 nodes away; the rims, 16 away too, and sixteen sweeps alone leave four.
    # A surface that hugs the bound is less than one away.
    inside = np.flatnonzero(found[16, :, 16] > 0.0)
    assert 4 <= 32 - inside.min() <= 8
    assert 4 <= inside.max() - 32 <= 8


def test_splatted_distances_are_those_of_the_surface() -> None:
    bricks = Bricks.from_mask(np.ones((4, 4, 4), bool), np.full(3, -48.0), 3.0)
    cloud = ball((0.0, 0.0, 0.0), 30.0, 20_000)
    values, weights = (join_bricks(part, (4, 4, 4)) for part in splat_planes(cloud, bricks))
    index = np.moveaxis(np.indices(values.shape), 0, -1)
    truth = np.linalg.norm(bricks.origin + 3.0 * index, axis=-1) - 30.0
    near = np.abs(truth) < 2.0
    assert (weights[near] > 1.0).all()
    # Tangent planes of points a cell to the side lie 3^2 / 60 mm over the ball.
    assert np.abs(values - truth)[near].max() < 0.15
    assert (weights[np.abs(truth) > 1.3 * 3.0 + 0.1] == 0.0).all()
    assert values.shape == (4 * SIDE,) * 3


@pytest.mark.parametrize(("share", "dent_mm"), [(0.55, 125.0), (0.9, 12.0)])
def test_a_ball_seen_in_part_is_closed(share: float, dent_mm: float) -> None:
    """Only the lowest part is missing, or nearly half: one closed piece without a handle."""
    whole = ball((0.0, 0.0, 600.0), 150.0, 100_000)
    seen = whole.points[:, 2] > 600.0 + 150.0 * (1.0 - 2.0 * share)
    found = mesh(cloud_of(whole.points[seen], whole.normals[seen]), MeshSettings())
    shape = compute_topology(found.vertices, found.faces)
    assert (shape.manifold, shape.components, shape.euler) == (True, 1, 2)
    off = np.linalg.norm(found.vertices - [0.0, 0.0, 600.0], axis=1) - 150.0
    measured = np.unique(found.faces[~found.filled])
    assert np.abs(off[measured]).max() < 0.1
    assert found.filled_share == pytest.approx(1.0 - share, abs=0.15)
    # What is missing is no bag, and no dent: a cap is made whole by two thirds, half a ball does
    # not end flat (135 mm under the whole one).
    assert off.max() < 5.0
    assert off.min() > -dent_mm


def test_two_limbs_close_to_each_other_stay_two() -> None:
    """Two balls 4 mm apart, a little more than a cell: each closed along itself, no bridge."""
    one, other = (ball((0.0, y, 600.0), 80.0, 60_000) for y in (-82.0, 82.0))
    both = cloud_of(
        np.concatenate([one.points, other.points]), np.concatenate([one.normals, other.normals])
    )
    found = mesh(both, MeshSettings())
    shape = compute_topology(found.vertices, found.faces)
    assert (shape.components, shape.euler) == (1, 2)
    assert np.ptp(found.vertices[:, 1]) == pytest.approx(160.0, abs=1.0)


def test_what_was_seen_through_is_half_a_cell_outside() -> None:
    """The outer sides of two upright rods, which filling makes one; a wall shows between them."""
    rng = np.random.default_rng(1)
    angle, z = rng.uniform(-0.5 * np.pi, 0.5 * np.pi, 40_000), rng.uniform(800.0, 1000.0, 40_000)
    side = np.where(np.arange(40_000) % 2 == 0, 1.0, -1.0)
    normals = np.stack([np.sin(angle), side * np.cos(angle), np.zeros_like(angle)], axis=1)
    rods = cloud_of(40.0 * normals + np.stack([0.0 * z, 50.0 * side, z], axis=1), normals)
    camera = nominal_camera(320, 256)
    pose = looking(NominalPose(position_mm=(1500.0, 0.0, 900.0), look_at_mm=(0.0, 0.0, 900.0)))
    rays = camera.pixel_rays()
    between = np.abs(1500.0 * rays[..., 0]) < 25.0
    wall = range_image_of(camera, np.where(between[..., None], 3000.0 * rays, np.nan))
    guessed, seen = (fill_distances(rods, 1.0, images, {"p": pose}) for images in ([], [wall]))
    _, y, height = guessed.origin[:, None, None, None] + CELL_MM * np.indices(guessed.values.shape)
    gap = (np.abs(y) < 20.0) & (np.abs(height - 900.0) < 60.0) & (guessed.values < 0.0)
    assert gap.sum() > 500
    # So the surface lies between such nodes and the rods.
    assert 0.49 * CELL_MM <= seen.values[gap].min() < CELL_MM


@pytest.mark.parametrize(("sigmas", "times"), [((0.1, 0.2), 4.0), ((0.01, 1.0), 9.0)])
def test_a_point_says_the_more_the_better_it_is_known_but_nine_times_the_usual_at_most(
    sigmas: tuple[float, float], times: float
) -> None:
    """A node between two planes, as far before one as it is behind the other; the middle one of three
    points, far off, is what is usual."""
    bricks = Bricks.from_mask(np.ones((2, 2, 2), bool), np.zeros(3), 4.0)
    points = np.array([[20.0, 20.0, 18.0], [20.0, 20.0, 22.0], [40.0, 40.0, 40.0]])
    usual = sigmas[1] if times == 4.0 else np.sqrt(sigmas[0] * sigmas[1])
    cloud = replace(
        cloud_of(points, np.tile([0.0, 0.0, 1.0], (3, 1))),
        sigma_mm=np.array([*sigmas, usual], np.float32),
    )
    values, weights = (join_bricks(part, (2, 2, 2)) for part in splat_planes(cloud, bricks))
    more = times if times == 4.0 else times**2
    # 2 mm over the first, 2 mm under the other; single precision.
    assert values[5, 5, 5] == pytest.approx(2.0 * (more - 1.0) / (more + 1.0), rel=1e-5)
    # Half a cell from a node a point has lost (0.5 / 1.3)^2 of its weight, to the fourth power.
    near = (1.0 - (0.5 / 1.3) ** 2) ** 4
    assert weights[5, 5, 5] == pytest.approx(
        near * (times + (1.0 if times == 4.0 else 1.0 / 9.0)), rel=1e-5
    )
    assert weights[10, 10, 10] == pytest.approx(1.0), (
        "right at the node, and as well known as usual"
    )


FINE_MM = 3.0
ORIGIN = np.array([-40.0, 15.0, -3.5])
SHAPE = (20, 17, 23)


def nodes(shape: tuple[int, ...], cell_mm: float) -> Array:
    return np.asarray(ORIGIN + cell_mm * np.moveaxis(np.indices(shape), 0, -1))


def distances(values: Array) -> Distances:
    return Distances(values.astype(np.float32), ORIGIN, CELL_MM)


def test_between_nodes_it_is_linear_and_beyond_the_grid_as_at_its_rim() -> None:
    def field(places: Array) -> Array:
        x, y, z = np.moveaxis((places - ORIGIN) / CELL_MM, -1, 0)
        return np.asarray(3.0 * x - 2.0 * y + 1.0 * z + 4.0)

    bricks = Bricks.from_mask(np.ones((6, 5, 7), bool), ORIGIN, FINE_MM)
    found = interpolate_distances(distances(field(nodes(SHAPE, CELL_MM))), bricks)
    index = SIDE * bricks.indices[:, None, None, None] + np.moveaxis(np.indices((SIDE,) * 3), 0, -1)
    last = ORIGIN + CELL_MM * (np.array(SHAPE) - 1.0)
    truth = field(np.minimum(ORIGIN + FINE_MM * index, last))
    assert (ORIGIN + FINE_MM * index > last).any()
    np.testing.assert_allclose(found, truth, atol=1e-4)


def test_the_surface_passes_through_the_bricks_that_it_does_and_some_beside() -> None:
    """Of a ball; a brick with the cells around it, and as far as coarse nodes say more."""
    shape = (6, 5, 7)
    centre = ORIGIN + [62.0, 55.0, 70.0]

    def ball(places: Array) -> Array:
        return np.asarray(np.linalg.norm(places - centre, axis=-1) - 33.0)

    found = find_crossed_bricks(distances(ball(nodes(SHAPE, CELL_MM))), FINE_MM, shape)
    inside = np.zeros(shape, bool)
    clear = np.zeros(shape, bool)
    for brick in np.ndindex(shape):
        steps = np.arange(-1, SIDE + 1)
        places = np.stack(
            np.meshgrid(*(FINE_MM * (SIDE * k + steps) for k in brick), indexing="ij"), axis=-1
        )
        values = ball(ORIGIN + places)
        inside[brick] = values.min() < 0.0 <= values.max()
        clear[brick] = np.abs(values).min() > 2.0 * CELL_MM * np.sqrt(3.0)
    assert found[inside].all()
    assert not found[clear].any()
    assert inside.sum() > 20
    assert clear.sum() > 20
