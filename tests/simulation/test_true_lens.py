"""The simulator's lens against a reference of other make, OpenCV's model, and its own inverse."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bodyscan.simulation.lens import TrueCamera, sample_directions

SKEWED = TrueCamera(1061.71, 1064.09, -0.56, 350.08, 286.5, -0.14, -0.09, 640, 480)
DECENTRED = replace(SKEWED, p1=4e-4, p2=-3e-4, k3=0.01)


@pytest.mark.parametrize("more", [(0.0, 0.0, 0.0), (4e-4, -3e-4, 0.01)])
def test_without_skew_it_is_the_model_of_opencv(more: tuple[float, ...]) -> None:
    camera = TrueCamera(1500.0, 1504.0, 0.0, 645.0, 508.0, -0.1, 0.05, 1280, 1024, *more)
    points = np.random.default_rng(1).uniform([-400, -300, 900], [400, 300, 1600], (500, 3))
    matrix = np.array([[1500.0, 0, 645], [0, 1504, 508], [0, 0, 1]])
    lens = np.array([-0.1, 0.05, *more])
    expected, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), matrix, lens)
    # both are float64 formulas of a few operations: nothing but rounding may differ
    assert camera.image(points) == pytest.approx(expected.reshape(-1, 2), abs=1e-9)


def test_skew_shears_the_image_before_the_lens_pushes_it() -> None:
    """Eq. 3: u - u0 holds the skew when it is scaled."""
    x, y = 0.2, -0.15
    ideal = SKEWED.alpha * x + SKEWED.gamma * y
    push = 1 + SKEWED.k1 * 0.0625 + SKEWED.k2 * 0.0625**2
    u, v = SKEWED.image(np.array([x, y, 1.0]))
    assert u == pytest.approx(SKEWED.u0 + ideal * push, abs=1e-9)
    assert v == pytest.approx(SKEWED.v0 + SKEWED.beta * y * push, abs=1e-9)


@settings(max_examples=25)
@given(st.floats(0, 639), st.floats(0, 479), st.sampled_from([SKEWED, DECENTRED]))
def test_rays_are_imaged_where_they_belong(u: float, v: float, camera: TrueCamera) -> None:
    ray = camera.directions(np.array([u, v]))
    assert camera.image(ray) == pytest.approx([u, v], abs=1e-8)
    assert ray[2] == 1.0


@pytest.mark.parametrize("camera", [SKEWED, DECENTRED])
def test_a_lens_that_folds_the_image_is_refused(camera: TrueCamera) -> None:
    folding = replace(camera, k1=-6.0)
    with pytest.raises(ValueError, match="folds"):
        folding.directions(folding.grid())


def test_samples_stay_inside_their_pixel_and_average_to_its_middle() -> None:
    camera = TrueCamera(755.0, 755.0, 0.0, 31.5, 23.5, 0.0, 0.0, 64, 48)
    rays = sample_directions(
        camera, 3, np.random.default_rng(0).random((48, 64, 2)), slice(0, 48)
    ).astype(float)
    off = (camera.image(rays).reshape(48, 64, 9, 2) - camera.grid()[:, :, None]).reshape(-1, 2)
    assert np.abs(off).max() <= 0.5 + 1e-4  # float32 rays
    # uniform in a pixel: standard deviation 0.29 px, 27,648 of them, five standard errors
    assert np.abs(off.mean(axis=0)).max() < 5 * 0.29 / np.sqrt(len(off))
