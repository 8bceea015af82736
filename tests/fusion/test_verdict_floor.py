"""Level ground near z = 0, told by pixels whose heights and slopes are known."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from ray_cast_scan import cast_scan, load_body, load_rig

from bodyscan.arrays import Array
from bodyscan.fusion.verdict.rig import find_exchanged, find_floor, find_misplaced
from bodyscan.geometry.camera import Camera
from bodyscan.geometry.lenses.opencv import Radial
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.reconstruction.range_image import RangeImage

WITHIN: Any = SimpleNamespace(radius_mm=700.0, bottom_mm=0.0, top_mm=2200.0)
STRAIGHT_UP = np.array([0.0, 0.0, 1.0])


def seen(pair: str, points: Array, normal: Array = STRAIGHT_UP) -> Any:
    """A range image one pixel high; only every fourth pixel is what `points` (N, 3) say."""
    spread = np.repeat(points, 4, axis=0)[None]
    return SimpleNamespace(
        pair=pair,
        overexposed=False,
        subsample=lambda step: np.s_[::step, ::step],
        valid=np.ones(spread.shape[:2], bool),
        points=spread,
        normals=np.broadcast_to(normal, spread.shape),
    )


def ground(z_mm: float, count: int = 300, *, out_mm: float = 0.0, along: int = 1) -> Array:
    """Points on a ring of no more than 500 mm, or moved out by so much along an axis."""
    angle = np.linspace(0.0, 2.0 * np.pi, count)
    points = np.stack([200.0 * np.cos(angle), 200.0 * np.sin(angle), np.full(count, z_mm)], axis=1)
    points[:, along] += out_mm
    return points


def floor(*images: Any) -> float | None:
    here = RigidTransform.identity()
    return find_floor(images, {image.pair: here for image in images}, WITHIN)


def test_the_floor_is_the_median_of_pairs_which_are_each_a_median() -> None:
    high = np.concatenate([ground(3.0, 200), ground(50.0, 190)])
    assert floor(seen("a", high), seen("b", ground(5.0)), seen("c", ground(-8.0))) == 3.0
    assert floor(seen("a", high)) is None, "one pair may be wrong by itself"
    assert floor(seen("a", high), seen("b", ground(5.0, 299))) is None
    assert floor(seen("a", high), seen("b", ground(5.0, 300))) == 4.0


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_what_lies_6_cm_off_is_an_instep_or_a_step(side: float) -> None:
    for z_mm, told in ((59.0, side * 59.0), (61.0, None)):
        assert floor(*(seen(name, ground(side * z_mm)) for name in "ab")) == told


def test_what_leans_by_10_degrees_is_no_floor() -> None:
    for lean_deg, told in ((9.5, 7.0), (10.5, None)):
        lean = np.radians(lean_deg)
        normal = np.array([np.sin(lean), 0.0, np.cos(lean)])
        assert floor(*(seen(name, ground(7.0), normal) for name in "ab")) == told
        assert floor(*(seen(name, ground(7.0), -normal) for name in "ab")) is None


@pytest.mark.parametrize("along", [0, 1])
def test_ground_outside_of_the_volume_is_not_asked(along: int) -> None:
    for out_mm, told in ((480.0, 7.0), (920.0, None)):
        ring = ground(7.0, out_mm=out_mm, along=along)
        assert floor(*(seen(name, ring) for name in "ab")) == told


def test_heights_are_those_of_the_rig_wherever_the_camera_stands() -> None:
    at = RigidTransform.from_rotation_vector([2.0, 0.3, -0.4], [900.0, 300.0, 1500.0])
    there = at.inverse()
    images = [
        seen(name, there.apply(ground(12.0)), there.rotate(STRAIGHT_UP[None])[0]) for name in "ab"
    ]
    assert find_floor(images, dict.fromkeys("ab", at), WITHIN) == pytest.approx(12.0)


def stray(depth_mm: float, count: int, turned: float = 0.0) -> tuple[Any, RigidTransform]:
    """Points of a pair 1.5 m from the middle, which it looks past by an angle; and its pose."""
    image = seen("a", np.tile([0.0, 0.0, depth_mm], (count, 1)))
    image.camera = Camera(1000.0, 1000.0, 0.0, 320.0, 240.0, Radial(), 640, 480)
    level = RigidTransform(np.array([[0.0, 0, -1], [1, 0, 0], [0, -1, 0]]), np.zeros(3))
    turn = RigidTransform.from_rotation_vector([0.0, 0.0, turned], [1500.0, 0.0, 900.0])
    return image, turn @ level


@pytest.mark.parametrize(
    ("depth_mm", "seeing", "named"),
    [(1400.0, (), True), (1400.0, ("a",), False), (3000.0, (), False)],
)
def test_a_pair_whose_points_all_lie_elsewhere_is_named(
    depth_mm: float, seeing: tuple[str, ...], named: bool
) -> None:
    """As far away as the subject, with a pose that is wrong; not a wall behind a child's head."""
    image, pose = stray(depth_mm, 1000)
    found = find_misplaced([image], seeing, {"a": pose}, WITHIN)
    assert ("a" in found) == named
    assert not named or "none of its 4000 points" in found["a"]


def test_a_pair_that_gave_nothing_is_named_if_its_pose_looks_past_the_volume() -> None:
    for turned, named in ((0.0, False), (0.3, False), (1.2, True)):
        image, pose = stray(1400.0, 0, turned)
        found = find_misplaced([image], (), {"a": pose}, WITHIN)
        assert ("a" in found) == named
        assert not named or "points it away from the scan volume" in found["a"]


@pytest.mark.parametrize(("one", "other"), [("p1-2", "p3-3"), ("p1-2", "p1-3"), ("p2-2", "p2-2")])
def test_pairs_that_have_each_other_s_images_are_named(one: str, other: str) -> None:
    scan = cast_scan(load_body(), load_rig(), scale=0.25)
    right = {image.pair: image for image in scan.range_images}
    files = right | {one: right[other], other: right[one]}

    def read_as(pair: str, calibration: str) -> RangeImage:
        return replace(files[pair], pair=calibration)

    images = [read_as(name, name) for name in files]
    found = find_exchanged(images, scan.rig_from_camera, WITHIN, read_as)
    assert found == ({one: other, other: one} if one != other else {})
