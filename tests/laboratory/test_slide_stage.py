"""Cameras from points of known place: the 3 x 4 matrix and Tsai's method."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from table_one import CAMERA

from bodyscan.geometry.camera import Camera
from bodyscan.geometry.lenses.opencv import Radial
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.laboratory.rivals import (
    calibrate_tsai,
    estimate_projection_matrix,
    split_projection_matrix,
)

GRID = np.stack(np.meshgrid(np.arange(20.0, 161, 20), np.arange(20.0, 121, 20)), -1).reshape(-1, 2)
POINTS = np.concatenate([np.column_stack([GRID, np.full(48, z)]) for z in range(-60, 61, 20)])
PLACE = RigidTransform.from_rotation_vector([0.12, -0.16, 0.02], [-98.0, -87.0, 378.0])


@settings(max_examples=20, deadline=None)
@given(
    focal=st.floats(500.0, 2000.0),
    aspect=st.floats(0.95, 1.05),
    skew=st.floats(-5.0, 5.0),
    turn=st.tuples(*[st.floats(-0.4, 0.4)] * 3),
)
def test_a_camera_without_lens_is_its_matrix(
    focal: float, aspect: float, skew: float, turn: tuple[float, float, float]
) -> None:
    true = Camera(focal * aspect, focal, skew, 350.0, 230.0, Radial(), 640, 480)
    place = RigidTransform.from_rotation_vector(turn, [-90.0, -70.0, 450.0])
    pixels = true.project(place.apply(POINTS))
    camera, found = split_projection_matrix(estimate_projection_matrix(POINTS, pixels), 640, 480)
    # Rounding, magnified by the condition of the linear system (1e6 at the longest focal length).
    assert np.allclose(camera.matrix, true.matrix, atol=1e-4)
    assert np.allclose(found.matrix, place.matrix, atol=1e-4)


def tsai_pixels(focal: float, kappa: float) -> np.ndarray:
    """A lens just as Tsai's model has it: ideal = real (1 + kappa r^2), solved for real."""
    seen = PLACE.apply(POINTS)
    ideal = seen[:, :2] / seen[:, 2:]
    length = np.linalg.norm(ideal, axis=1)
    real = length.copy()
    for _ in range(50):
        real = length / (1.0 + kappa * real**2)
    return ideal * (real / length)[:, None] * focal * [0.998, 1.0] + [352.0, 281.0]


@pytest.mark.parametrize("kappa", [0.0, 0.15, -0.1])
def test_tsai_finds_his_own_camera(kappa: float) -> None:
    camera, place = calibrate_tsai(POINTS, tsai_pixels(1064.0, kappa), 640, 480)
    assert camera.beta == pytest.approx(1064.0, rel=1e-6)
    assert camera.alpha / camera.beta == pytest.approx(0.998, rel=1e-6)
    assert [camera.u0, camera.v0] == pytest.approx([352.0, 281.0], abs=1e-3)
    assert np.allclose(place.matrix, PLACE.matrix, atol=1e-3)
    # The chapter's k1 and k2 undo kappa to their sixth order: 12 kappa^3 r^7 at r = 0.2.
    error = camera.project(PLACE.apply(POINTS)) - tsai_pixels(1064.0, kappa)
    assert np.max(np.abs(error)) < 0.01


def test_tsai_sees_the_chapters_lens_nearly() -> None:
    pixels = CAMERA.project(PLACE.apply(POINTS))
    camera, place = calibrate_tsai(POINTS, pixels, 640, 480)
    error = camera.project(place.apply(POINTS)) - pixels
    # One coefficient for two, and no skew (0.5 px over the whole image): a few hundredths of a px.
    assert 0.01 < np.sqrt(np.mean(error**2)) < 0.08
    assert camera.alpha == pytest.approx(CAMERA.alpha, rel=1e-3)


def test_a_matrix_does_not_see_the_lens() -> None:
    pixels = CAMERA.project(PLACE.apply(POINTS))
    camera, place = split_projection_matrix(estimate_projection_matrix(POINTS, pixels), 640, 480)
    error = camera.project(place.apply(POINTS)) - pixels
    # Barrel distortion of up to 4 px, most of which scale and centre take up.
    assert 0.1 < np.sqrt(np.mean(error**2)) < 0.5
