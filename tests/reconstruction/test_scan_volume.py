"""Which stripes are wanted: all that may lie in the scan volume, whatever else is in the room."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from small_pair import CAMERA, STRIPES, pair, planes, stripe_map

from bodyscan.arrays import Floats
from bodyscan.calibration.pair import PairCalibration
from bodyscan.geometry.camera import Camera
from bodyscan.geometry.lenses.opencv import Radial
from bodyscan.geometry.light_sheets import triangulate_image
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.reconstruction.scan_volume import (
    MARGIN_STRIPES,
    _compute_corner_rays,
    _measure_nonlinearity,
    compute_volume_interval,
    find_stripes_in_volume,
)
from bodyscan.rig.rig import Volume
from bodyscan.stripes.stripe_limits import StripeLimits

VOLUME = Volume(radius_mm=120.0, bottom_mm=-100.0, top_mm=150.0)
PLAIN = Camera(200.0, 200.0, 0.0, 79.5, 59.5, Radial(), 160, 120)


def looking_at_the_middle(distance_mm: float, turn: float, tilt: float) -> RigidTransform:
    """rig_from_camera of a camera that looks at the rig's origin from some way off."""
    ahead = np.array(
        [np.cos(turn) * np.cos(tilt), np.sin(turn) * np.cos(tilt), -np.sin(tilt)]
    )  # fmt: skip
    right = np.cross(ahead, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    return RigidTransform(
        np.stack([right, np.cross(ahead, right), ahead], axis=-1), -distance_mm * ahead
    )


def calibrated(rising: bool) -> PairCalibration:
    """The pair of the other tests; with stripes numbered from the other end, s grows with depth."""
    sheets = planes()
    if not rising:
        return pair()
    return replace(pair(), sheets=replace(sheets, coefficients=sheets.coefficients[::-1].copy()))


def limits_of(one: PairCalibration, at: RigidTransform, volume: Volume = VOLUME) -> StripeLimits:
    limits = find_stripes_in_volume(one, at, volume)
    assert limits is not None
    return limits


def some_s(seed: int, rising: bool) -> Floats:
    """A bumpy room: stripe coordinates of all depths, next to each other."""
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width]
    phase = np.random.default_rng(seed).uniform(0.0, 6.0, 4)
    waves = np.sin(u / 9 + phase[0]) + np.sin(v / 7 + phase[1]) + np.sin((u + v) / 5 + phase[2])
    s = STRIPES * (0.5 + 0.16 * waves)
    return (s if rising else STRIPES - s).clip(0.0, STRIPES).astype(np.float32)


@pytest.mark.slow
@settings(max_examples=40)
@given(
    st.floats(400.0, 800.0),
    st.floats(-3.0, 3.0),
    st.floats(-0.5, 0.5),
    st.booleans(),
    st.integers(0, 99),
)
@example(788.0, 0.0, -0.125, True, 0)  # a camera at the height of the volume's bottom
@example(789.3, -2.444, -0.1453, True, 12)  # and one a little below it
def test_all_that_lies_in_the_volume_is_wanted(
    distance_mm: float, turn: float, tilt: float, rising: bool, seed: int
) -> None:
    one, at = calibrated(rising), looking_at_the_middle(distance_mm, turn, tilt)
    wanted = limits_of(one, at)
    s = some_s(seed, rising)
    assert one.sheets is not None
    points, *_ = triangulate_image(one.sheets, one.camera, s, np.full_like(s, 0.01))
    x, y, z = np.moveaxis(at.apply(points.astype(np.float64)), -1, 0)
    there = (np.hypot(x, y) < VOLUME.radius_mm) & (z > VOLUME.bottom_mm) & (z < VOLUME.top_mm)
    standing = there & (z > VOLUME.bottom_mm + 25.0)
    kept, beyond = wanted.split(s, np.isfinite(s))
    assert standing.any()
    assert kept[standing].all()
    # What lies at the bottom is kept beside what stands, and else passes for the floor.
    beside = cv2.dilate(standing.view(np.uint8), np.ones((21, 21), np.uint8)) > 0
    assert kept[there & beside].all()
    assert not beyond[there & beside].any()
    # Nothing in front of the volume is taken for something behind it: the volume's middle lies
    # `distance_mm` from the camera, and no part of it is nearer than its half diagonal before that.
    half = np.hypot(VOLUME.radius_mm, 150.0)
    assert not beyond[points[..., 2] < distance_mm - half].any()


def test_integers_are_stripes_and_columns_may_be_lines() -> None:
    one, at = calibrated(True), looking_at_the_middle(500.0, 0.3, 0.1)
    wanted = limits_of(one, at)
    stripe = np.floor(some_s(1, True)).astype(np.int32)
    middle = stripe.astype(np.float32) + np.float32(0.5)
    usable = np.random.default_rng(0).random(stripe.shape) < 0.9
    for mine, other in zip(wanted.split(stripe, usable), wanted.split(middle, usable), strict=True):
        np.testing.assert_array_equal(mine, other)
        assert not mine[~usable].any()
    turned = wanted.split(stripe.T.copy(), usable.T.copy(), transposed=True)
    np.testing.assert_array_equal(turned[0].T, wanted.split(stripe, usable)[0])


def test_a_camera_may_stand_at_the_rigs_origin() -> None:
    """As it does where one pair fixes the rig frame, and stands inside of the volume then."""
    limits = find_stripes_in_volume(pair(), RigidTransform.identity(), Volume())
    assert limits is not None
    assert np.isfinite(limits.around_px)
    assert limits.around_px > 1.0


def test_a_volume_out_of_sight_is_seen_nowhere() -> None:
    away = looking_at_the_middle(500.0, 0.0, 0.0)
    behind = RigidTransform(away.rotation, -away.translation)
    wanted = limits_of(calibrated(True), behind)
    kept, beyond = wanted.split(some_s(0, True), np.ones((CAMERA.height, CAMERA.width), bool))
    assert not kept.any()
    assert not beyond.any()


def test_without_a_projector_or_an_order_in_depth_all_stripes_count() -> None:
    at = looking_at_the_middle(500.0, 0.0, 0.0)
    assert find_stripes_in_volume(replace(pair(), sheets=None), at, VOLUME) is None
    # Sheets that fan out from a line in the middle of the picture: nearer above, farther below.
    coefficients = planes().coefficients.copy()
    coefficients[: STRIPES // 2] = coefficients[: STRIPES // 2][::-1]
    folded = replace(pair(), sheets=replace(planes(), coefficients=coefficients))
    assert find_stripes_in_volume(folded, at, VOLUME) is None


@pytest.mark.parametrize("rising", [True, False])
def test_most_of_the_room_is_not_wanted(rising: bool) -> None:
    at = looking_at_the_middle(700.0, 0.0, 0.0)
    larger = Camera(1600.0, 1608.0, -2.0, 320.0, 240.0, Radial(-0.1, 0.02), 640, 480)
    one = replace(calibrated(rising), camera=larger)
    small = Volume(radius_mm=40.0, bottom_mm=-30.0, top_mm=30.0)
    s = np.repeat(np.repeat(some_s(2, rising), 4, axis=0), 4, axis=1)
    kept, beyond = limits_of(one, at, small).split(s, np.isfinite(s))
    # With 30 mm around it the volume is a sixth of the picture, and with one and a half stripes of
    # up to 50 mm at both ends a third of what there is in depth.
    assert 0.005 < kept.mean() < 0.1
    assert beyond.any()


@given(st.floats(100.0, 1500.0), st.floats(-3.0, 3.0), st.floats(-1.3, 1.3), st.integers(0, 99))
def test_a_ray_is_in_the_volume_between_where_it_enters_and_leaves(
    distance_mm: float, turn: float, tilt: float, seed: int
) -> None:
    at = looking_at_the_middle(distance_mm, turn, tilt)
    rng = np.random.default_rng(seed)
    rays = np.concatenate([rng.uniform(-0.6, 0.6, (200, 2)), np.ones((200, 1))], axis=1)
    enter, leave = compute_volume_interval(rays, at, VOLUME, raised_mm=20.0)
    depth = rng.uniform(60.0, 3000.0, 200)
    x, y, z = at.apply(rays * depth[:, None]).T
    within = np.hypot(x, y) < VOLUME.radius_mm + 30.0
    within &= (z > VOLUME.bottom_mm + 20.0) & (z < VOLUME.top_mm + 30.0)
    np.testing.assert_array_equal((depth > enter) & (depth < leave), within)


def test_what_lies_flat_is_wanted_where_nothing_stands() -> None:
    """A plate on the floor; and the floor beside somebody's feet, but not the rest of it."""
    at = looking_at_the_middle(900.0, 0.0, 0.6)
    one = calibrated(True)
    wanted = limits_of(one, at, Volume(radius_mm=300.0, bottom_mm=-5.0, top_mm=400.0))
    rays = at.rotate(CAMERA.pixel_rays())
    floor = stripe_map((1.0 - at.translation[2]) / rays[..., 2]).s
    s = np.where(np.isfinite(floor), STRIPES - floor, np.nan).astype(np.float32)
    flat, deep = wanted.split(s, np.isfinite(s))
    assert flat.sum() > 3000
    assert not (flat & deep).any()
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width]
    person = (abs(u - 80) < 6) & (abs(v - 60) < 20) & flat
    s[person] -= 8.0  # nearer, by far more than the layer
    beside, deep = wanted.split(s, np.isfinite(s))
    assert beside[person].all()
    near = cv2.dilate(person.view(np.uint8), np.ones((9, 9), np.uint8)) > 0
    np.testing.assert_array_equal(beside & near, flat & near)
    assert beside.sum() < 0.7 * flat.sum()
    assert deep[flat & ~beside].all()


def test_a_level_ray_goes_through_the_wall_or_comes_nearest_to_the_axis_beside_it() -> None:
    """From 500 mm beside the axis; with its room the volume's wall is 150 mm around that."""
    at = looking_at_the_middle(500.0, 0.7, 0.0)
    rays = np.array([[0.0, 0.0, 1.0], [0.2, 0.0, 1.0], [0.4, 0.0, 1.0], [-0.4, 0.0, 1.0]])
    enter, leave = compute_volume_interval(rays, at, VOLUME, raised_mm=0.0)
    # Nearest where 500 mm are left of 1 + x^2; to either side by what is left of the radius.
    nearest = 500.0 / (1.0 + rays[:, 0] ** 2)
    beside = 500.0 * np.abs(rays[:, 0]) / np.hypot(1.0, rays[:, 0])
    half = np.sqrt(np.maximum(150.0**2 - beside**2, 0.0)) / np.hypot(1.0, rays[:, 0])
    assert (half > 0.0).tolist() == [True, True, False, False]
    np.testing.assert_allclose(enter, nearest - half, rtol=1e-9)
    np.testing.assert_allclose(leave, nearest + half, rtol=1e-9)


def test_blocks_begin_at_the_first_pixels_outer_edge_and_cover_the_picture() -> None:
    plain = Camera(100.0, 100.0, 0.0, 0.0, 0.0, Radial(), 25, 16)
    rays = _compute_corner_rays(plain, 10)
    assert rays.shape == (3, 4, 3)
    np.testing.assert_allclose(100.0 * rays[0, :, 0], [-0.5, 9.5, 19.5, 29.5])
    np.testing.assert_allclose(100.0 * rays[:, 0, 1], [-0.5, 9.5, 19.5])


def test_limits_are_widened_as_much_on_the_left_as_on_the_right() -> None:
    """What a camera sees that looks down on a round volume is its own mirror image, stripes too."""
    at = looking_at_the_middle(600.0, 0.0, 0.5)
    rays = _compute_corner_rays(PLAIN, 8)
    near, far = compute_volume_interval(rays, at, VOLUME, raised_mm=0.0)
    np.testing.assert_allclose(near, near[:, ::-1], rtol=1e-9)
    finer = 1.0 + rays[..., 0] ** 2 + rays[..., 1]
    limits = 1e5 * finer * np.stack([1.0 / far, 1.0 / near, 1.0 / near])
    for by in _measure_nonlinearity(rays, at, VOLUME, (near, far), limits):
        assert np.count_nonzero(by) > 10
        # The two halves are rounded differently, and nothing else.
        np.testing.assert_allclose(by, by[:, ::-1], rtol=1e-6)


@pytest.mark.parametrize(
    ("distance_mm", "tilt"),
    [(450.0, -0.2), (600.0, -0.15), (600.0, 0.0), (900.0, -0.1), (900.0, 0.2), (900.0, 0.5)],
)
def test_no_pixel_in_a_block_loses_more_than_the_margin(distance_mm: float, tilt: float) -> None:
    """Where the wall meets the bottom, a limit bends by up to 80 stripes inside of a block: pad_crop by
    half as much it would cut 2 to 80 of them off. Along each ray s falls as 1e5 mm over depth."""
    at = looking_at_the_middle(distance_mm, 0.0, tilt)
    block_px, per_inverse = 8, 1e5
    rays = _compute_corner_rays(PLAIN, block_px)
    near, far = compute_volume_interval(rays, at, VOLUME, raised_mm=0.0)
    limits = -per_inverse / np.stack([near, far, far])
    near_by, far_by = _measure_nonlinearity(rays, at, VOLUME, (near, far), limits)
    enter, leave = compute_volume_interval(PLAIN.pixel_rays(), at, VOLUME, raised_mm=0.0)
    inside = enter < leave

    def linear(corners: np.ndarray) -> np.ndarray:
        """(120, 160): between the corners of blocks, at the pixels."""
        down, across = (
            np.maximum(1.0 - np.abs((np.arange(n)[:, None] + 0.5) / block_px - np.arange(k)), 0.0)
            for n, k in zip((120, 160), corners.shape, strict=True)
        )
        return down @ corners @ across.T

    too_near = linear(limits[0] - near_by) + per_inverse / enter
    too_far = -per_inverse / leave - linear(limits[1] + far_by)
    assert max(too_near[inside].max(), too_far[inside].max()) < MARGIN_STRIPES
