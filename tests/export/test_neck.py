"""Where the neck of a body of revolution is, each limit from both sides."""

from __future__ import annotations

import numpy as np
import pytest

from bodyscan.errors import FailedWork
from bodyscan.export.neck import Neck, find_neck, girth
from bodyscan.geometry.transforms import RigidTransform

SIDES, STEP_MM = 24, 4.0
ROUND = SIDES / np.pi * np.sin(np.pi / SIDES)
"""Girth of a polygon over that of the circle around it."""
AXIS = np.array([30.0, -20.0])
Profile = list[tuple[float, float]]
"""(height, radius) mm, straight in between."""
TALL_MM, NECK_MM = 1700.0, 1452.0
"""At a height that is looked at: 4 mm steps from a quarter of the stature, nearly, below the top."""


def turned(profile: Profile) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and faces of the surface, a ring every 4 mm; open at both ends."""
    height = np.arange(0.0, TALL_MM + 1.0, STEP_MM)
    radius = np.interp(height, *np.array(profile).T)
    angle = 2.0 * np.pi * np.arange(SIDES) / SIDES
    flat = AXIS + radius[:, None, None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    z = np.broadcast_to(height[:, None, None], (len(height), SIDES, 1))
    ring, side = np.mgrid[: len(height) - 1, :SIDES]
    a, b = SIDES * ring + side, SIDES * ring + (side + 1) % SIDES
    faces = np.stack([[a, b, b + SIDES], [a, b + SIDES, a + SIDES]], axis=-1).reshape(3, -1).T
    return np.concatenate([flat, z], axis=-1).reshape(-1, 3), faces


def person(*, neck: float = 345.0, head: float = 500.0, shoulders: float = 940.0) -> Profile:
    """By girths, mm.  Shoulders end 108 mm below the neck, and are looked at 119 mm below it."""
    narrow, skull, wide = (girth_mm / (2.0 * np.pi * ROUND) for girth_mm in (neck, head, shoulders))
    return [
        (0.0, wide), (NECK_MM - 108.0, wide), (NECK_MM, narrow), (NECK_MM + 48.0, skull),
        (TALL_MM, skull),
    ]  # fmt: skip


def found(profile: Profile) -> Neck:
    return find_neck(*turned(profile))


def test_the_neck_is_the_narrowest_slice_and_its_axis_that_of_the_head() -> None:
    neck = found(person())
    assert neck.height_mm == pytest.approx(NECK_MM)
    np.testing.assert_allclose(neck.axis, AXIS, atol=1e-6)  # the middle of rings


@pytest.mark.parametrize(
    ("widths", "is_one"),
    [
        ({"neck": 179.8}, False),
        ({"neck": 180.2}, True),
        ({"neck": 300.0, "head": 399.8}, False),
        ({"neck": 300.0, "head": 400.2}, True),
        # A head is a tenth wider than the neck.
        ({"neck": 480.0, "head": 527.8}, False),
        ({"neck": 480.0, "head": 528.2}, True),
        # Shoulders are half as wide again.
        ({"neck": 480.0, "head": 540.0, "shoulders": 719.0}, False),
        ({"neck": 480.0, "head": 540.0, "shoulders": 721.0}, True),
    ],
)
def test_a_neck_has_a_head_above_and_shoulders_below(
    widths: dict[str, float], is_one: bool
) -> None:
    if is_one:
        assert found(person(**widths)).height_mm == pytest.approx(NECK_MM)
        return
    with pytest.raises(FailedWork, match="no neck was found"):
        found(person(**widths))


def test_what_only_narrows_upwards_or_downwards_has_no_neck() -> None:
    for profile in ([(0.0, 155.0), (TALL_MM, 70.0)], [(0.0, 70.0), (TALL_MM, 155.0)]):
        with pytest.raises(FailedWork, match="stand upright"):
            found(profile)


def test_a_slice_between_vertices_has_the_girth_of_its_hull() -> None:
    vertices, faces = turned([(0.0, 60.0), (TALL_MM, 60.0 + 17.0)])
    for height in (500.0, 500.4):
        wanted = 2.0 * np.pi * (60.0 + 0.01 * height) * ROUND
        # Straight between rings, as the cone is; diagonals of its faces lie inside by a hundredth.
        assert girth(vertices, faces, height, AXIS) == pytest.approx(wanted, rel=1e-4)
    assert girth(vertices, faces, TALL_MM + 1.0, AXIS) == float("inf")
    assert girth(vertices, faces, -1.0, AXIS) == float("inf")


def test_what_is_farther_from_the_axis_than_a_head_reaches_does_not_count() -> None:
    vertices, faces = turned([(0.0, 60.0), (TALL_MM, 60.0)])
    aside = RigidTransform(np.eye(3), np.array([0.0, 400.0, 0.0])).apply(vertices)
    both = np.concatenate([vertices, aside]), np.concatenate([faces, faces + len(vertices)])
    alone = girth(vertices, faces, 800.0, AXIS)
    assert girth(*both, 800.0, AXIS) == pytest.approx(alone)
    # 160 mm, and a circle of 60 that ends 159 or 170 from it.
    assert girth(vertices, faces, 800.0, AXIS + [99.0, 0.0]) == pytest.approx(alone)
    assert girth(vertices, faces, 800.0, AXIS + [110.0, 0.0]) < 0.99 * alone
    assert girth(vertices, faces, 800.0, AXIS + [221.0, 0.0]) == float("inf")


@pytest.mark.parametrize(
    "profile",
    [
        # At 1290 mm, where the lowest slice is, and 1560, above the highest at 1544.
        [(0.0, 150.0), (1180.0, 150.0), (1290.0, 55.0), (1380.0, 80.0), (TALL_MM, 80.0)],
        [(0.0, 150.0), (1430.0, 150.0), (1560.0, 50.0), (1598.0, 90.0), (TALL_MM, 90.0)],
    ],
)
def test_what_is_narrowest_where_trunks_or_heads_are_is_no_neck(profile: Profile) -> None:
    """A quarter of the stature below the top, nearly, or a twelfth of it."""
    with pytest.raises(FailedWork, match="no neck was found"):
        found(profile)
