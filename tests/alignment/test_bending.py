"""Range images displaced pixel by pixel, by motions whose result is known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from ball import ball_points
from normal_field import normal_field
from ring import looking_at

from bodyscan.alignment.bending import _bend, _one_in_each_block, bend
from bodyscan.alignment.body_cells import BodyCells, modulated, rigid_fields
from bodyscan.alignment.matching import alignment_points, match_projected
from bodyscan.arrays import WHOLE, find_crop, pad_crop
from bodyscan.fusion.smoothing import smooth
from bodyscan.geometry.camera import Camera
from bodyscan.geometry.lenses.radial import Radial
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.reconstruction.range_image import RangeImage

CAMERA = Camera(400.0, 404.0, -1.0, 158.0, 130.0, Radial(), 320, 256)
CENTRE, RADIUS = np.array([0.0, 0.0, 900.0]), 250.0
PLACE = looking_at([900.0, 700.0, 1000.0], CENTRE)


@pytest.fixture(scope="module")
def ball() -> tuple[RangeImage, BodyCells]:
    centre = PLACE.inverse().apply(CENTRE)
    points = ball_points(CAMERA, centre, RADIUS)
    sigma = np.where(np.isfinite(points[..., 2]), 0.1, np.nan)
    grey = np.full(sigma.shape, 150, np.uint8)
    normals = (points - centre) / RADIUS
    image = RangeImage(
        "p",
        CAMERA,
        points.astype(np.float32),
        normals.astype(np.float32),
        sigma.astype(np.float32),
        grey,
    )
    there = image.valid
    cells, _ = BodyCells.of(PLACE.apply(points[there]), PLACE.rotate(normals[there]))
    return image, cells


def test_a_rigid_motion_is_one(ball: tuple[RangeImage, BodyCells]) -> None:
    image, cells = ball
    turn, shift = np.array([0.004, -0.003, 0.002]), np.array([1.0, -2.0, 3.0])
    field = rigid_fields(cells, CENTRE, 1.0) @ np.concatenate([turn, shift])
    bent = bend(image, PLACE, cells, field)
    seen = image.valid
    moved = RigidTransform(np.eye(3), CENTRE + shift) @ RigidTransform.from_rotation_vector(
        turn, np.zeros(3)
    )
    expected = moved.apply(PLACE.apply(image.points[seen].astype(float)) - CENTRE)
    # First order in the turn: 0.005^2 / 2 of 250 mm.
    np.testing.assert_allclose(PLACE.apply(bent.points[seen].astype(float)), expected, atol=0.006)
    turned = moved.rotate(PLACE.rotate(image.normals[seen].astype(float)))
    np.testing.assert_allclose(PLACE.rotate(bent.normals[seen].astype(float)), turned, atol=1e-4)
    assert bent.bent
    assert not image.bent
    np.testing.assert_array_equal(bent.sigma_mm, image.sigma_mm)


def test_a_swelling_has_no_steps(ball: tuple[RangeImage, BodyCells]) -> None:
    """Outwards by up to 4 mm over a Gaussian of 100 mm, as a breath."""
    image, cells = ball
    peak = CENTRE + RADIUS * (PLACE.translation - CENTRE) / np.linalg.norm(
        PLACE.translation - CENTRE
    )

    def size(points: np.ndarray) -> np.ndarray:
        return 4.0 * np.exp(-0.5 * np.sum((points - peak) ** 2, axis=-1) / 100.0**2)

    field = modulated(normal_field(cells), cells, size(cells.centres)[:, None])[..., 0]
    bent = bend(image, PLACE, cells, field)
    seen = image.valid
    before = PLACE.apply(image.points[seen].astype(float))
    outwards = np.linalg.norm(PLACE.apply(bent.points[seen].astype(float)) - CENTRE, axis=1)
    off = outwards - RADIUS - size(before)
    # 4 mm / 100 mm^2 bend by 0.06 mm over half a cell; at the ball's rim cells have one neighbour less.
    assert np.sqrt(np.mean(off**2)) < 0.06
    assert np.percentile(np.abs(off), 99) < 0.2


def test_what_is_cut_away_changes_nothing(ball: tuple[RangeImage, BodyCells]) -> None:
    """A box that leaves nothing measured out, at no multiple of any step or block."""
    image, cells = ball
    whole = replace(image, beyond=~image.valid)
    box = pad_crop(find_crop(image.valid) or WHOLE, 5)
    cut = whole.cut(box)
    assert cut.sigma_mm.shape < image.sigma_mm.shape
    depth = np.where(image.valid, image.points[..., 2], np.inf)
    for each in (whole, cut):
        np.testing.assert_array_equal(each.open_depth, depth)
    field = rigid_fields(cells, CENTRE, 1.0) @ np.array([0.004, -0.003, 0.002, 1.0, -2.0, 3.0])
    bent = [bend(each, PLACE, cells, field) for each in (whole, cut)]
    np.testing.assert_array_equal(bent[0].points[box], bent[1].points)
    np.testing.assert_array_equal(bent[0].normals[box], bent[1].normals)
    seen = [alignment_points(each, 7.0) for each in bent]
    nearby = PLACE @ RigidTransform.from_rotation_vector([0.0, 0.01, 0.0], [4.0, 0.0, 0.0])
    matched = [match_projected(seen[0], each, nearby, PLACE, 6.0) for each in seen]
    assert len(matched[0].distances) > 500
    smoothed = [smooth(each, PLACE, 7.0) for each in bent]
    for one, other in (seen, matched, smoothed):
        for name in (
            "points",
            "normals",
            "sigma_mm",
            "rim",
            "distances",
            "number",
            "corner",
            "colours",
        ):
            assert np.array_equal(getattr(one, name, 0), getattr(other, name, 0)), name


def test_of_each_block_the_measured_pixel_nearest_to_its_middle_is_taken() -> None:
    """Blocks of five, counted from the picture's own corner."""
    sigma = np.full((12, 13), 0.1, np.float32)
    sigma[4, 5] = np.nan  # the middle of one
    found = _one_in_each_block(sigma, (3, 2), 5)
    assert found.shape == (3, 3)
    # The block of rows 5 to 9 and columns 5 to 9 of the picture has its middle at (7, 7).
    assert found[1, 2] == 13 * (12 - 3 - 5) + (12 - 2)
    assert found[1, 1] == 13 * 3 + 5  # beside the one that is missing, the first of four
    assert found[2, 1] == 13 * (12 - 3) + (7 - 2)
    assert found[0, 0] == 13 * 0 + 0
    sigma[2:7, 3:8] = np.nan
    assert _one_in_each_block(sigma, (3, 2), 5)[1, 1] == -1


def spread_over_blocks(
    cell: np.ndarray, depth: np.ndarray, shifts: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """How far `_bend` carries each of 12 x 13 pixels along x, where blocks of five, counted from a
    corner at row 3 and column 2, belong to cells with such shifts; and where it lies, in blocks."""
    points = np.zeros((12, 13, 3), np.float32)
    points[..., 2] = 1000.0
    before, normals = points.copy(), np.zeros_like(points)
    sigma = np.full((12, 13), 0.1, np.float32)
    fields = np.zeros((len(shifts), 12))
    fields[:, 0] = shifts
    blocks = cell.astype(np.int32), depth.astype(np.float32)
    _bend(points, normals, sigma, (3, 2), 5, blocks, (np.zeros((len(shifts), 3)), fields))
    y, x = (np.arange(3, 15) + 0.5) / 5.0 - 0.5, (np.arange(2, 15) + 0.5) / 5.0 - 0.5
    return (points - before)[..., 0], y[:, None], x[None]


def test_between_the_middles_of_four_blocks_their_motions_are_mixed_by_nearness() -> None:
    i, j = np.indices((3, 3))
    own = 1.0 + 2.0 * i + 4.0 * j + 0.5 * i * j
    shift, y, x = spread_over_blocks(3 * i + j, np.full((3, 3), 1000.0), own.ravel())
    y, x = np.clip(y, 0.0, 2.0), np.clip(x, 0.0, 2.0)  # beyond the last middles as there
    # Single precision.
    np.testing.assert_allclose(shift, 1.0 + 2.0 * y + 4.0 * x + 0.5 * y * x, rtol=1e-5)


@pytest.mark.parametrize(
    ("off_mm", "one_surface"), [(39.0, True), (-39.0, True), (41.0, False), (-41.0, False)]
)
def test_what_is_far_before_or_behind_moves_by_itself(off_mm: float, one_surface: bool) -> None:
    cell, depth = np.array([[0, 0, 1]] * 3), np.full((3, 3), 1000.0)
    depth[:, 2] += off_mm
    shift, _, x = spread_over_blocks(cell, depth, np.array([1.0, 3.0]))
    here = np.arange(2, 15) // 5
    mixed = 1.0 + 2.0 * np.clip(x[0] - 1.0, 0.0, 1.0)
    # A pixel goes with its own block whatever its depth, and mixes others in on its own surface only.
    expected = mixed if one_surface else np.where(here < 2, 1.0, np.where(x[0] >= 2.0, 3.0, mixed))
    np.testing.assert_allclose(shift[4], expected, rtol=1e-5)  # amid a row of blocks


def test_blocks_without_a_cell_are_left_out_of_the_mixture() -> None:
    cell = np.array([[0, 0, -1]] * 3)
    cell[2] = 1
    shift, y, _ = spread_over_blocks(cell, np.full((3, 3), 1000.0), np.array([1.0, 3.0]))
    expected = 1.0 + 2.0 * np.clip(y - 1.0, 0.0, 1.0)
    np.testing.assert_allclose(shift[:, :6], np.tile(expected, (1, 6)), rtol=1e-5)
