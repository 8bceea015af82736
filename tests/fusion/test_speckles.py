"""Small patches of depth in the air, and what stands before an empty room, pixel by pixel."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from bodyscan.fusion.cleaning import drop_speckles, find_foreground

NAN = np.float32(np.nan)


def depth_of(patch: int) -> np.ndarray:
    """A patch of so many pixels, a gap and a wall of 300."""
    depth = np.full((20, 30), NAN)
    depth[:, 15:] = 1000.0
    rows, columns = np.divmod(np.arange(patch), 10)
    depth[rows, columns] = 1000.0
    return depth


@pytest.mark.parametrize(("patch", "kept"), [(49, 0), (51, 51)])
def test_patches_of_fewer_pixels_are_speckles(patch: int, kept: int) -> None:
    found = drop_speckles(depth_of(patch), 4.0, 50.0)
    assert found[:, :10].sum() == kept
    assert found[:, 15:].all()
    assert not found[:, 10:15].any(), "nothing was measured there"


@pytest.mark.parametrize("near_mm", [500.0, 2000.0, 7900.0])
@pytest.mark.parametrize(("jump_mm", "one"), [(3.75, True), (4.5, False)])
def test_a_jump_in_depth_parts_what_is_side_by_side(
    near_mm: float, jump_mm: float, one: bool
) -> None:
    """Depths are compared in quarters of a millimetre: two halves of 300 pixels each, or 600."""
    depth = np.full((20, 30), near_mm, np.float32)
    depth[:, 15:] += np.float32(jump_mm)
    found = drop_speckles(depth, 4.0, 400.0)
    assert found.all() if one else not found.any()


def test_what_stands_before_the_nearest_of_an_empty_rooms_pixels_around_is_no_background() -> None:
    room = np.full((9, 11), 3000.0, np.float32)
    room[4, 5] = 2000.0  # the edge of a shelf
    room[0, 0] = 0.0  # nothing was seen there
    empty: Any = SimpleNamespace(open_depth=room)
    points = np.zeros((5, 7, 3), np.float32)
    points[..., 2] = 1997.0
    image: Any = SimpleNamespace(points=points, part=np.s_[2:7, 2:9])
    found = find_foreground(image, empty)
    assert not found[1:4, 2:5].any(), "beside the shelf"
    found[1:4, 2:5] = True
    assert found.all()
    points[..., 2] = 1995.0
    assert find_foreground(image, empty).all()
    points[2, 3, 2] = NAN
    assert not find_foreground(image, empty)[2, 3]
    points[..., 2] = 4000.0
    nothing: Any = SimpleNamespace(open_depth=np.zeros((9, 11), np.float32))
    assert find_foreground(image, nothing).all(), (
        "where a room is seen nowhere, all stands before it"
    )
