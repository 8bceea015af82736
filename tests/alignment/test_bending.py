"""Range images displaced pixel by pixel, by motions whose result is known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from ring import looking_at

from bodyscan.alignment.bending import bend
from bodyscan.alignment.body_cells import BodyCells, modulated, normal_field, rigid_fields
from bodyscan.alignment.cell_speeds import CellSpeeds
from bodyscan.geometry.camera import Camera
from bodyscan.geometry.lenses.radial import Radial
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.geometry.velocity import Velocity
from bodyscan.reconstruction.range_image import RangeImage

CAMERA = Camera(400.0, 404.0, -1.0, 158.0, 130.0, Radial(), 320, 256)
CENTRE, RADIUS = np.array([0.0, 0.0, 900.0]), 250.0
PLACE = looking_at([900.0, 700.0, 1000.0], CENTRE)


@pytest.fixture(scope="module")
def ball() -> tuple[RangeImage, BodyCells]:
    rays = CAMERA.pixel_rays()
    centre = PLACE.inverse().apply(CENTRE)
    square = np.sum(rays**2, axis=-1)
    along = rays @ centre / square
    gap = along**2 - (centre @ centre - RADIUS**2) / square
    points = rays * (along - np.sqrt(np.where(gap > 0, gap, np.nan)))[..., None]
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


def test_a_pairs_own_velocity_is_the_rigid_motion_nearest_to_the_cells(
    ball: tuple[RangeImage, BodyCells],
) -> None:
    image, cells = ball
    twist = np.array([0.001, 0.002, -0.001, 3.0, -4.0, 6.0])  # rad/s and mm/s, camera frame
    # How a ball turns it does not show: there the prior's width, 0.01 rad/s and 10 mm/s, is left.
    centres = PLACE.inverse().apply(cells.centres)
    normals = PLACE.inverse().rotate(cells.normals)
    levers = np.hstack([np.cross(centres, normals), normals])
    prior = np.diag([1e4] * 3 + [1e-2] * 3)
    held = levers.T @ levers / len(levers) / 0.1**2 + prior
    covariance = np.asarray(np.linalg.inv(held), np.float64)
    moving = replace(image, velocity=Velocity(twist, covariance), time_ms=0.0)
    told = CellSpeeds.of(moving, PLACE, cells, np.arange(len(cells.centres)))
    points = PLACE.inverse().apply(cells.centres[told.cells])
    assert moving.velocity is not None
    speeds = np.sum(PLACE.rotate(moving.velocity.at(points)) * told.normals, axis=1)
    size = np.abs(told.speeds).max()
    # In sigmas: where nothing shows it may differ by one or so.
    np.testing.assert_allclose(told.combined @ -speeds, told.speeds, atol=1.5)
    assert size > 10.0
    # A hand that moves beside a body that stands is little of its rigid motion.
    hand = np.where(np.linalg.norm(points - points[0], axis=1) < 60.0, 10.0, 0.0)
    assert 0.0 < np.abs(told.combined @ hand).max() < 0.3 * size


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
