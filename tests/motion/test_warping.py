"""Range images displaced pixel by pixel, by motions whose result is known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from ball import ball_points, range_image_of
from normal_field import normal_field
from ring import looking_at

from bodyscan.alignment.matching import match_projected, sample_points
from bodyscan.arrays import WHOLE, find_crop, pad_crop
from bodyscan.fusion.smoothing import smooth
from bodyscan.geometry.camera import Camera
from bodyscan.geometry.lenses.opencv import Radial
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.motion.body_cells import BodyCells, build_rigid_fields, modulate_fields
from bodyscan.motion.warping import warp_image
from bodyscan.reconstruction.range_image import RangeImage

CAMERA = Camera(400.0, 404.0, -1.0, 158.0, 130.0, Radial(), 320, 256)
CENTRE, RADIUS = np.array([0.0, 0.0, 900.0]), 250.0
PLACE = looking_at([900.0, 700.0, 1000.0], CENTRE)


@pytest.fixture(scope="module")
def ball() -> tuple[RangeImage, BodyCells]:
    centre = PLACE.inverse().apply(CENTRE)
    points = ball_points(CAMERA, centre, RADIUS)
    normals = (points - centre) / RADIUS
    image = range_image_of(CAMERA, points, normals, grey=150)
    there = image.valid
    cells, _ = BodyCells.from_points(PLACE.apply(points[there]), PLACE.rotate(normals[there]))
    return image, cells


def test_a_rigid_motion_is_one(ball: tuple[RangeImage, BodyCells]) -> None:
    image, cells = ball
    turn, shift = np.array([0.004, -0.003, 0.002]), np.array([1.0, -2.0, 3.0])
    field = build_rigid_fields(cells, CENTRE, 1.0) @ np.concatenate([turn, shift])
    bent = warp_image(image, PLACE, cells, field)
    seen = image.valid
    moved = RigidTransform(np.eye(3), CENTRE + shift) @ RigidTransform.from_rotation_vector(
        turn, np.zeros(3)
    )
    expected = moved.apply(PLACE.apply(image.points[seen].astype(float)) - CENTRE)
    # First order in the turn: 0.005^2 / 2 of 250 mm.
    np.testing.assert_allclose(PLACE.apply(bent.points[seen].astype(float)), expected, atol=0.006)
    turned = moved.rotate(PLACE.rotate(image.normals[seen].astype(float)))
    np.testing.assert_allclose(PLACE.rotate(bent.normals[seen].astype(float)), turned, atol=1e-4)
    assert bent.warped
    assert not image.warped
    np.testing.assert_array_equal(bent.sigma_mm, image.sigma_mm)


def test_a_swelling_has_no_steps(ball: tuple[RangeImage, BodyCells]) -> None:
    """Outwards by up to 4 mm over a Gaussian of 100 mm, as a breath."""
    image, cells = ball
    peak = CENTRE + RADIUS * (PLACE.translation - CENTRE) / np.linalg.norm(
        PLACE.translation - CENTRE
    )

    def size(points: np.ndarray) -> np.ndarray:
        return 4.0 * np.exp(-0.5 * np.sum((points - peak) ** 2, axis=-1) / 100.0**2)

    field = modulate_fields(normal_field(cells), cells, size(cells.centres)[:, None])[..., 0]
    bent = warp_image(image, PLACE, cells, field)
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
    cut = whole.crop(box)
    assert cut.sigma_mm.shape < image.sigma_mm.shape
    depth = np.where(image.valid, image.points[..., 2], np.inf)
    for each in (whole, cut):
        np.testing.assert_array_equal(each.open_depth, depth)
    field = build_rigid_fields(cells, CENTRE, 1.0) @ np.array(
        [0.004, -0.003, 0.002, 1.0, -2.0, 3.0]
    )
    bent = [warp_image(each, PLACE, cells, field) for each in (whole, cut)]
    np.testing.assert_array_equal(bent[0].points[box], bent[1].points)
    np.testing.assert_array_equal(bent[0].normals[box], bent[1].normals)
    seen = [sample_points(each, 7.0)[0] for each in bent]
    nearby = PLACE @ RigidTransform.from_rotation_vector([0.0, 0.01, 0.0], [4.0, 0.0, 0.0])
    matched = [match_projected(seen[0], each, nearby, PLACE, 6.0) for each in seen]
    assert len(matched[0].distances) > 500
    smoothed = [smooth(each, PLACE, 7.0) for each in bent]
    for one, other in (seen, matched, smoothed):
        for name in (
            "points",
            "normals",
            "sigma_mm",
            "in_margin",
            "distances",
            "number",
            "corner",
            "colours",
        ):
            assert np.array_equal(getattr(one, name, 0), getattr(other, name, 0)), name
