"""Bounds on filled surface: space that was seen through, and the crown's tangent planes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import open3d as o3d
import pytest
from ball import range_image_of
from made_bodies import cloud_of
from meshed import mesh
from ray_cast_scan import looking, nominal_camera

from bodyscan.arrays import Array, Mask
from bodyscan.fusion.hole_filling import Crown, PartialSurface, find_free_points, find_gaps
from bodyscan.geometry.camera import Camera
from bodyscan.geometry.lenses.opencv import Radial
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.mesh.body import BodyCloud
from bodyscan.reconstruction.range_image import RangeImage
from bodyscan.rig.pair import NominalPose
from bodyscan.settings import MeshSettings

PLACING = NominalPose(position_mm=(1500.0, 0.0, 900.0), look_at_mm=(0.0, 0.0, 900.0))
CAMERA = nominal_camera(320, 256)
POSE = looking(PLACING)


def seen(depth: np.ndarray) -> RangeImage:
    return range_image_of(CAMERA, CAMERA.pixel_rays() * depth[..., None])


def test_a_wall_and_something_beyond_the_volume_are_seen_through_alike() -> None:
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width]
    body = abs(u - 160) < 60
    nothing = (v > 100) & (v < 120)
    depth = np.where(body, 1400.0, 3000.0)
    depth[nothing] = np.nan
    wall = seen(depth)
    beyond = ~body & ~nothing
    far = replace(seen(np.where(beyond, np.nan, depth)), beyond=beyond)
    sheet = o3d.geometry.TriangleMesh.create_box(10.0, 900.0, 600.0).translate((0, -450, 600))
    vertices, faces = np.asarray(sheet.vertices), np.asarray(sheet.triangles).astype(np.int64)
    guess = PartialSurface(vertices, faces, np.ones(len(faces), bool), np.zeros(len(faces), bool))
    places = np.random.default_rng(0).uniform([-50, -400, 650], [50, 400, 1150], (5000, 3))
    points = places.astype(np.float32)
    through = find_free_points(points, guess, wall, POSE)
    assert 0.2 < through.mean() < 0.8
    np.testing.assert_array_equal(find_free_points(points, guess, far, POSE), through)
    # Without a word of what is behind, only what lies between measured parts can be open.
    blind = find_free_points(points, guess, replace(far, beyond=None), POSE)
    assert blind.sum() < through.sum()


FLAT = Camera(100.0, 100.0, 0.0, 30.0, 10.0, Radial(), 60, 20)
HERE = RigidTransform.identity()


def plates(*parts: tuple[float, float, float, bool]) -> PartialSurface:
    """Upright rectangles across all rows, from one column to another, at a depth; filled or not."""
    vertices, faces, filled = [], [], []
    for k, (left, right, depth, fill) in enumerate(parts):
        corners = [(left, -1.0), (right, -1.0), (right, 21.0), (left, 21.0)]
        rays = [((u - 30.0) / 100.0, (v - 10.0) / 100.0, 1.0) for u, v in corners]
        vertices += [depth * np.array(ray) for ray in rays]
        faces += [[4 * k, 4 * k + 2, 4 * k + 1], [4 * k, 4 * k + 3, 4 * k + 2]]
        filled += [fill, fill]
    nothing = np.zeros(len(faces), bool)
    return PartialSurface(np.array(vertices), np.array(faces), np.array(filled), nothing)


def shown(columns: np.ndarray) -> RangeImage:
    """A wall at 1000 mm, measured in some columns (60,)."""
    depth = np.where(columns, 1000.0, np.nan)[None].repeat(20, axis=0)
    return range_image_of(FLAT, FLAT.pixel_rays() * depth[..., None])


COLUMN = np.arange(60)
BETWEEN = (0.5, 20.5, 1000.0, False), (20.5, 39.5, 1000.0, True), (39.5, 59.5, 1000.0, False)


def open_columns(guess: PartialSurface, columns: np.ndarray, stride: int = 1) -> list[int]:
    blocks = np.s_[0 : 20 // stride], np.s_[0 : 60 // stride]
    found = find_gaps(guess, shown(columns), HERE, stride, blocks)
    assert (found == found[0]).all(), "all rows are alike"
    return np.flatnonzero(found[0]).tolist()


def test_a_gap_is_what_is_made_up_between_what_was_measured_but_for_its_rims() -> None:
    measured = (COLUMN < 21) | (COLUMN > 39)
    assert open_columns(plates(*BETWEEN), measured) == list(range(22, 39))
    # Blocks of three by their middles 1, 4, ..., and no closer to what was measured than one block.
    assert open_columns(plates(*BETWEEN), measured, stride=3) == list(range(8, 12))
    # Of a window the same blocks.
    some = find_gaps(plates(*BETWEEN), shown(measured), HERE, 1, np.s_[5:9, 12:45])
    assert some.shape == (4, 33)
    assert np.flatnonzero(some[0]).tolist() == list(range(10, 27))


@pytest.mark.parametrize("side", [0, 2])
def test_beside_dark_cloth_a_lack_of_points_is_no_gap(side: int) -> None:
    """Of which too little light came back: a pelvis in dark shorts is no hole."""
    guess = plates(*BETWEEN)
    dark = replace(guess, dark=np.arange(6) // 2 == side)
    assert open_columns(dark, (COLUMN < 21) | (COLUMN > 39)) == []
    # Neither is it with a bright hand on the cloth's far side: five litres of pelvis were cut out.
    hand, cloth = (0.5, 9.5, 1000.0, False), (9.5, 20.5, 1000.0, False)
    dark = replace(plates(hand, cloth, *BETWEEN[1:]), dark=np.arange(8) // 2 == 1)
    assert open_columns(dark, (COLUMN < 21) | (COLUMN > 39)) == []


@pytest.mark.parametrize(("rise_mm", "opens"), [(-3.0, True), (3.0, False)])
def test_a_shadow_on_a_thigh_is_no_gap(rise_mm: float, opens: bool) -> None:
    """Round a thigh surfaces turn away from each other; a hand's shadow bored a tunnel through it."""
    guess = plates(*BETWEEN)
    vertices = guess.vertices.copy()
    vertices[[1, 2, 8, 11], 2] -= 10.0 * rise_mm  # the rims of the gap, towards the camera
    found = open_columns(replace(guess, vertices=vertices), (COLUMN < 21) | (COLUMN > 39))
    assert bool(found) == opens


@pytest.mark.parametrize("hand", [0, 2])
def test_the_shadow_of_a_hand_before_a_thigh_is_no_gap(hand: int) -> None:
    """Bored through to the gluteal fold; "more trunks or legs than one has"."""
    parts = [(*part[:2], 850.0 if k == hand else 1000.0, part[3]) for k, part in enumerate(BETWEEN)]
    assert open_columns(plates(*parts), (COLUMN < 21) | (COLUMN > 39)) == []


def test_what_shows_between_two_fingers_is_no_gap() -> None:
    bars = (0.5, 25.5, 1000.0, False), (25.5, 30.5, 1000.0, True), (30.5, 59.5, 1000.0, False)
    measured, window = (COLUMN < 24) | (COLUMN > 32), np.s_[0:4, 0:60]
    assert not find_gaps(plates(*bars), shown(measured), HERE, 1, window).any()


def test_what_was_measured_on_one_side_only_leaves_no_gap() -> None:
    measured = (COLUMN < 21) | (COLUMN > 39)
    assert open_columns(plates(*BETWEEN[:2]), measured) == []
    assert open_columns(plates(*BETWEEN[1:]), measured) == []


def test_what_lies_before_measured_surface_is_a_shadow_and_no_gap() -> None:
    measured = (COLUMN < 21) | (COLUMN > 39)
    behind = (24.5, 29.5, 1100.0, False)
    found = open_columns(plates(*BETWEEN, behind), measured)
    assert found == [22, 23, 24, *range(30, 39)]


def test_what_is_beside_or_behind_the_camera_was_not_seen_through() -> None:
    measured = np.ones(60, bool)
    guess = plates((0.5, 59.5, 500.0, True))
    points = np.array(
        [
            [0, 0, 500],
            [0, 0, 985],
            [0, 0, 995],
            [0, 0, 0.5],
            [0, 0, -500],
            [400, 0, 500],
            [0, 90, 500],
        ],
        np.float32,
    )
    with np.errstate(all="raise"):  # nothing is divided by a depth of 0
        through = find_free_points(points, guess, shown(measured), HERE)
    assert through.tolist() == [True, True, False, False, False, False, False]


RADIUS, TOP = 80.0, 1700.0
MISSING_MM, ASIDE_MM = 28.0, 25.0
"""Radius of what pairs at the height of a man's head see too flat, and how far from the top it lies."""


def head(seen: Callable[[Array], Mask]) -> BodyCloud:
    """A ball, as a cloud of points 2 mm apart, where it was seen."""
    rng = np.random.default_rng(0)
    ways = rng.normal(size=(20_000, 3))
    ways /= np.linalg.norm(ways, axis=1, keepdims=True)
    points = np.array([0.0, 0.0, TOP - RADIUS]) + RADIUS * ways
    kept = seen(points)
    points, ways = points[kept], ways[kept]
    count = len(points)
    points = points + 0.1 * rng.normal(size=(count, 1)) * ways
    normals = ways + 0.02 * rng.normal(size=(count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return cloud_of(points, normals)


def unknown_mm(cloud: BodyCloud) -> float:
    return Crown.from_cloud(cloud.points, cloud.normals).unknown_mm


def beside_a_hole(points: Array) -> Mask:
    """The hole's rim reaches the top."""
    low = points[:, 2] < TOP - RADIUS
    return np.asarray(low | (np.hypot(points[:, 0] - ASIDE_MM, points[:, 1]) > MISSING_MM))


def test_a_head_seen_all_round_ends_where_it_was_measured() -> None:
    assert unknown_mm(head(lambda points: np.ones(len(points), bool))) < 1.0


def test_a_hole_beside_the_top_leaves_little_open() -> None:
    assert unknown_mm(head(beside_a_hole)) < 2.0


@pytest.mark.parametrize(("cut_mm", "least_mm"), [(3.0, 4.0), (10.0, 15.0), (80.0, np.inf)])
def test_a_head_cut_off_or_with_hair_that_gave_no_data_may_go_on(
    cut_mm: float, least_mm: float
) -> None:
    assert unknown_mm(head(lambda points: points[:, 2] < TOP - cut_mm)) >= least_mm


def test_what_is_not_convex_holds_nothing() -> None:
    """A low level ledge beside a column that was cut off, such as a shoulder beside a neck."""
    rng = np.random.default_rng(1)
    ledge = np.column_stack([rng.uniform(-40.0, 40.0, (3000, 2)), np.full(3000, TOP - 50.0)])
    up = np.tile([0.0, 0.0, 1.0], (3000, 1))
    wall = head(lambda points: np.abs(points[:, 2] - TOP + RADIUS) < 20.0)
    raised = wall.points + [0.0, 0.0, 60.0]
    found = Crown.from_cloud(np.concatenate([ledge, raised]), np.concatenate([up, wall.normals]))
    assert found.unknown_mm > 40.0


def test_a_mesh_does_not_bulge_over_a_hole_in_the_crown() -> None:
    """Harmonic distances alone stood 3 mm above it, a stature's whole allowance."""
    found = mesh(head(beside_a_hole), MeshSettings())
    assert found.filled.any()
    assert abs(found.vertices[:, 2].max() - TOP) < 1.0


def roof(top: Array, slopes: tuple[float, float]) -> tuple[Array, Array]:
    """Normals and offsets of four planes that meet in `top` and fall from it by so much to a side."""
    ways = np.array([(x, y, 1.0) for x in (-slopes[0], slopes[0]) for y in (-slopes[1], slopes[1])])
    normals = ways / np.linalg.norm(ways, axis=1, keepdims=True)
    return normals, normals @ top


@pytest.mark.parametrize("aside", [(37.0, -21.0), (-80.0, 5.0), (0.0, 0.0)])
def test_a_head_may_reach_where_its_planes_meet(aside: tuple[float, float]) -> None:
    highest = np.array([100.0, 50.0, TOP])
    normals, offsets = roof(highest + [*aside, 12.345], (0.2, 0.5))
    # The finest grid is 100 mm * 0.3^9 / 10 wide: a few ten-thousandths.
    assert Crown(highest, normals, offsets).unknown_mm == pytest.approx(12.345, abs=1e-3)
    lower = offsets - 20.0
    assert Crown(highest, normals, lower).unknown_mm == 0.0
    assert Crown(highest, normals[:0], offsets[:0]).unknown_mm == np.inf


def test_what_lies_above_the_planes_of_a_crown_is_outside() -> None:
    highest = np.array([100.0, 50.0, TOP])
    normals, offsets = roof(highest, (0.0, 0.75))  # a ridge along x
    crown = Crown(highest, normals, offsets)
    off = np.array(
        [[30, 0, 0], [30, 0, 3], [0, 20, -15], [0, 20, -10], [0, -20, -10], [0, 0, -5], [0, 60, -19],
         [0, 60, -21], [98, 0, 5], [102, 0, 5]], float,
    )  # fmt: skip
    # Of planes (0, 0.6, 0.8); 20 mm below the top and 100 mm aside the head ends.
    wanted = [0.0, 2.4, 0.0, 4.0, 4.0, -4.0, 20.8, -np.inf, 4.0, -np.inf]
    np.testing.assert_allclose(crown.compute_heights_above(highest + off), wanted, atol=1e-9)
    np.testing.assert_array_equal(
        Crown(highest, normals[:0], offsets[:0]).compute_heights_above(highest + off), -np.inf
    )
