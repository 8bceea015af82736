"""A wall held against the pictures of cameras before it: what each looked at and what it measured."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from bodyscan.arrays import Array, Bytes, Indices
from bodyscan.fusion.verdict.coverage import measure_coverage
from bodyscan.fusion.verdict.evidence import Coverage
from bodyscan.geometry.camera import Camera
from bodyscan.geometry.lenses.opencv import Radial
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.mesh.body import DARK_CLOTH, SKIN

CAMERA = Camera(500.0, 500.0, 0.0, 60.0, 40.0, Radial(), 121, 81)
AWAY_MM = 1000.0
HERE = RigidTransform.identity()


def grid(columns: int, rows: int) -> tuple[Array, Indices]:
    """Squares of 10 mm in the plane z = 1000, about the axis, two faces each, facing the camera."""
    x, y = np.meshgrid(np.arange(columns + 1.0), np.arange(rows + 1.0))
    places = np.stack([x - columns / 2, y - rows / 2, np.full_like(x, AWAY_MM / 10.0)], axis=-1)
    corner = np.arange(rows)[:, None] * (columns + 1) + np.arange(columns)
    a, b, c, d = ((corner + step).ravel() for step in (0, 1, columns + 1, columns + 2))
    faces = np.concatenate([np.stack([a, c, b], axis=1), np.stack([b, c, d], axis=1)])
    return 10.0 * places.reshape(-1, 3), faces


def seen(pair: str, *, left_of: int = 121, camera: Camera = CAMERA) -> Any:
    """What a camera at the origin measured of the plane: the columns left of some."""
    rays = camera.pixel_rays()
    valid = np.ones((81, 121), bool)
    valid[:, left_of:] = False
    return SimpleNamespace(
        pair=pair, camera=camera, corner=np.zeros(2, np.int64), valid=valid,
        points=AWAY_MM * rays, sigma_mm=np.ones((81, 121)),
        lit=np.full((81, 121), 100, np.uint8),
    )  # fmt: skip


def checked(
    *images: Any,
    columns: int = 20,
    rows: int = 14,
    turn: RigidTransform = HERE,
    regions: Bytes | None = None,
) -> Coverage:
    """turn: of the wall."""
    vertices, faces = grid(columns, rows)
    mesh: Any = SimpleNamespace(vertices=turn.apply(vertices), faces=faces, face_regions=regions)
    return measure_coverage(mesh, images, {image.pair: HERE for image in images})


def test_cameras_that_saw_it_all_missed_nothing() -> None:
    found = checked(seen("a"), seen("b"))
    assert found.yields == {"a": 1.0, "b": 1.0}
    assert found.saturated == {"a": 0.0, "b": 0.0}
    assert found.filled_share == 0.0
    assert found.areas_mm2.sum() == pytest.approx(200.0 * 140.0)
    np.testing.assert_allclose(np.unique(found.heights_mm), AWAY_MM)


def test_a_camera_is_asked_for_what_another_measured_and_for_that_alone() -> None:
    half = seen("a", left_of=61)
    found = checked(half, seen("b"))
    assert found.yields["a"] == pytest.approx(0.5, abs=0.03)
    assert found.yields["b"] == 1.0
    assert found.filled_share == 0.0
    alone = checked(half)
    assert alone.yields == {}, "what a pair alone says of itself is no witness"
    assert alone.filled_share == pytest.approx(0.5, abs=0.03)
    assert np.mean(alone.filled) == pytest.approx(0.5, abs=0.03)


def test_a_camera_is_not_asked_for_hair_and_dark_cloth() -> None:
    """Of the half that it did not measure, the other pair's longer exposure showed dark cloth."""
    regions = np.full(2 * 20 * 14, SKIN, np.uint8)
    regions[grid(20, 14)[0][grid(20, 14)[1]].mean(axis=1)[:, 0] > 0.0] = DARK_CLOTH
    found = checked(seen("a", left_of=61), seen("b"), regions=regions)
    assert found.yields == {"a": pytest.approx(1.0, abs=0.02), "b": 1.0}


@pytest.mark.parametrize(("lean_deg", "asked"), [(58.0, True), (62.0, False)])
@pytest.mark.parametrize("side", [1.0, -1.0])
def test_a_camera_should_measure_what_faces_it_by_60_degrees(
    lean_deg: float, asked: bool, side: float
) -> None:
    """Spots so near its axis that it sees all alike."""
    place = np.array([0.0, 0.0, AWAY_MM])
    about = RigidTransform.from_rotation_vector(
        [0.0, side * np.radians(lean_deg), 0.0], np.zeros(3)
    )
    turn = RigidTransform(about.rotation, place - about.apply(place[None])[0])
    found = checked(seen("a"), seen("b", left_of=0), columns=2, rows=13, turn=turn)
    assert found.filled_share == 0.0
    assert ("b" in found.yields) == asked


def test_spots_beside_the_picture_or_behind_the_camera_are_not_looked_at() -> None:
    """A wall of twice the picture's width: a camera that measured nothing is asked for its half."""
    wide = Camera(250.0, 250.0, 0.0, 60.0, 40.0, Radial(), 121, 81)
    found = checked(seen("a", camera=wide), seen("b", left_of=61), columns=46, rows=10)
    assert found.yields["b"] == pytest.approx(0.5, abs=0.03)
    assert found.filled_share == 0.0
    back = RigidTransform(np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, 0.0]))
    assert checked(seen("a"), seen("b"), turn=back).filled_share == 1.0


def test_a_part_of_a_picture_is_looked_up_where_it_lies() -> None:
    """Cut to its lower right; what is beside the cut was not measured."""
    whole = seen("a")
    part = seen("b")
    rows, columns = slice(30, 60), slice(70, 100)
    part.corner = np.array([30, 70])
    for name in ("valid", "points", "sigma_mm"):
        setattr(part, name, getattr(part, name)[rows, columns])
    found = checked(whole, part)
    # A pixel is 2 mm: 60 mm of 200 by 60 of 140.
    assert found.yields["b"] == pytest.approx(60.0 * 60.0 / (200.0 * 140.0), abs=0.01)
    assert checked(part).filled_share == pytest.approx(1.0 - 60.0 * 60.0 / 28_000.0, abs=0.01)
