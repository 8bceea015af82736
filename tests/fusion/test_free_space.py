"""What cameras saw through: the same whether a wall was measured or only known to be far."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import open3d as o3d
from ray_cast_scan import looking, nominal_camera

from bodyscan.fusion.free_space import Guess, _within, sees_through
from bodyscan.reconstruction.range_image import RangeImage
from bodyscan.rig.pair import NominalPose

PLACING = NominalPose(position_mm=(1500.0, 0.0, 900.0), look_at_mm=(0.0, 0.0, 900.0))
CAMERA = nominal_camera(320, 256)
POSE = looking(PLACING)


def seen(depth: np.ndarray) -> RangeImage:
    points = (CAMERA.pixel_rays() * depth[..., None]).astype(np.float32)
    sigma = np.where(np.isfinite(depth), np.float32(0.1), np.float32(np.nan))
    return RangeImage("p", CAMERA, points, points, sigma, np.zeros(depth.shape, np.uint8))


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
    guess = Guess.of(vertices, faces, np.ones(len(faces), bool))
    places = np.random.default_rng(0).uniform([-50, -400, 650], [50, 400, 1150], (5000, 3))
    points = places.astype(np.float32)
    through = sees_through(points, guess, wall, POSE, 10.0)
    assert 0.2 < through.mean() < 0.8
    np.testing.assert_array_equal(sees_through(points, guess, far, POSE, 10.0), through)
    # Without a word of what is behind, only what lies between measured parts can be open.
    blind = sees_through(points, guess, replace(far, beyond=None), POSE, 10.0)
    assert blind.sum() < through.sum()


def test_what_lies_to_the_left_is_looked_for_in_its_own_row_and_no_farther() -> None:
    mask = np.zeros((3, 12), bool)
    mask[0, 2], mask[1, [0, 6]] = True, True
    found = _within(mask, 3)
    assert np.flatnonzero(found[0]).tolist() == [2, 3, 4, 5]
    assert np.flatnonzero(found[1]).tolist() == [0, 1, 2, 3, 6, 7, 8, 9]
    assert not found[2].any()
