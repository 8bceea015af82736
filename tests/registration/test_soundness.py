"""What no camera, pose or covariance can be is found, and what is merely odd passes."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from bodyscan.geometry.camera import Camera
from bodyscan.geometry.lenses.radial import Radial
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.registration.soundness import camera_faults, covariance_faults, pose_faults
from bodyscan.rig.pair import Pair

PAIR = Pair.model_validate({"name": "p", "camera": {"width": 640, "height": 480}})
SOUND = Camera(700.0, 710.0, -0.5, 322.0, 238.0, Radial(-0.1, 0.02), 640, 480)


def said(found: Any) -> str:
    return "; ".join(f"{where} {what}" for where, what in found)


@pytest.mark.parametrize(
    "odd",
    [
        {},
        {"alpha": 90.0, "beta": 90.0, "lens": Radial(0.0, 0.0)},  # 149 degrees across
        {"alpha": 27000.0, "beta": 27000.0},  # one degree down
        {"alpha": 700.0, "beta": 1390.0, "gamma": 0.0},
        {"gamma": 69.0},
        {"u0": -630.0},
        {"u0": 1270.0},
        {"v0": -470.0},
        {"v0": 950.0},
    ],
)
def test_odd_cameras_pass(odd: dict[str, Any]) -> None:
    assert said(camera_faults(replace(SOUND, **odd), PAIR, "here")) == ""


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"width": 641}, "here is of 641 x 480 pixels, but its rig says 640 x 480"),
        ({"height": 481}, "is of 640 x 481 pixels"),
        ({"alpha": 85.0, "beta": 90.0}, "here.alpha is not a focal length for 640 pixels (got 85)"),
        ({"alpha": 37000.0, "beta": 27000.0}, "here.alpha is not a focal length"),
        ({"beta": 63.0}, "here.beta is not a focal length for 480 pixels (got 63)"),
        ({"beta": 27600.0}, "here.beta is not a focal length"),
        ({"beta": 1410.0}, "here has focal lengths too unlike (got 700, 1410)"),
        ({"beta": 345.0}, "has focal lengths too unlike"),
        ({"gamma": 71.0}, "here.gamma is more skew than a sensor has (got 71)"),
        ({"gamma": -71.0}, "is more skew"),
        ({"u0": -641.0}, "here.u0 lies far outside of the picture (got -641)"),
        ({"u0": 1281.0}, "here.u0 lies far outside"),
        ({"v0": -481.0}, "here.v0 lies far outside"),
        ({"v0": 961.0}, "here.v0 lies far outside"),
        ({"lens": Radial(-8.0, 0.0)}, "here has a lens that folds its picture over (got -8, 0)"),
        ({"lens": Radial(np.nan, 0.0)}, "has a lens that folds"),
    ],
)
def test_what_no_camera_is_is_named(wrong: dict[str, Any], message: str) -> None:
    assert message in said(camera_faults(replace(SOUND, **wrong), PAIR, "here"))


def test_a_lens_that_shows_half_of_its_picture_is_one() -> None:
    # The radius at which r (1 + k r^2) folds is 1 / sqrt(-3 k), seen at two thirds of it.
    def folds_at(share: float) -> float:
        """k1 of a lens whose picture ends where that share of a diagonal of 0.57 is seen."""
        seen = share * 0.57
        return float(-4.0 / (27.0 * seen**2))

    wide = replace(SOUND, lens=Radial(folds_at(0.85), 0.0))
    assert said(camera_faults(wide, PAIR, "here")) == ""
    narrow = replace(SOUND, lens=Radial(folds_at(0.4), 0.0))
    assert "folds" in said(camera_faults(narrow, PAIR, "here"))


PLACED = RigidTransform.from_rotation_vector([0.4, -0.2, 1.0], [1500.0, -200.0, 900.0])


@pytest.mark.parametrize(
    ("rotation", "translation", "message"),
    [
        (PLACED.rotation, [1e5, -1e5, 0.0], ""),
        (PLACED.rotation * (1.0 + 4e-7), [0.0, 0.0, 0.0], ""),
        (PLACED.rotation, [0.0, -1.001e5, 0.0], "here lies more than 100 m away"),
        (PLACED.rotation * (1.0 + 6e-7), [0.0, 0.0, 0.0], "here is not a rotation: its rows"),
        (-PLACED.rotation, [0.0, 0.0, 0.0], "here is not a rotation: it mirrors"),
        (PLACED.rotation * np.nan, [0.0, 0.0, 0.0], "here holds what is not a number"),
        (PLACED.rotation, [0.0, np.inf, 0.0], "here holds what is not a number"),
    ],
)
def test_a_pose_is_a_rotation_and_a_place_within_reach(
    rotation: np.ndarray, translation: list[float], message: str
) -> None:
    found = said(pose_faults(RigidTransform(rotation, np.array(translation)), "here"))
    assert found.startswith(message)
    assert bool(found) == bool(message)


COVARIANCE = np.diag([1e-6, 4.0, 0.0]) + np.diag([5e-4, 0.0], 1) + np.diag([5e-4, 0.0], -1)


def changed(row: int, column: int, value: float) -> np.ndarray:
    matrix = COVARIANCE.copy()
    matrix[row, column] = value
    return matrix


@pytest.mark.parametrize(
    ("matrix", "message"),
    [
        (COVARIANCE, ""),
        (np.zeros((3, 3)), ""),
        (np.diag([1, 2, 3]), ""),  # of whole numbers
        (changed(0, 1, 5e-4 * (1 + 3e-6)), ""),
        (changed(0, 1, 5e-4 * (1 + 6e-6)), "here is not symmetric"),
        (changed(1, 1, 0.25 * (1 - 1e-6)), ""),  # as correlated as can be, but for rounding
        (changed(1, 1, 0.25 * (1 - 2e-5)), "here is not a covariance"),
        (changed(2, 2, -1e-9), "here holds a negative variance"),
        (changed(2, 2, np.nan), "here holds what is not a number"),
        (COVARIANCE.astype(complex), "here holds what is not a number"),
        (np.eye(4), "here is of shape (4, 4), but 3 x 3 is wanted"),
        (np.ones(3), "here is of shape (3,), but 3 x 3 is wanted"),
        (None, "here is of shape (), but 3 x 3 is wanted"),
    ],
)
def test_a_covariance_is_symmetric_and_of_no_negative_variance(matrix: Any, message: str) -> None:
    found = said(covariance_faults(matrix, 3, "here"))
    assert found.startswith(message)
    assert bool(found) == bool(message)
    assert said(covariance_faults(np.zeros((0, 0)), 0, "here")) == ""
