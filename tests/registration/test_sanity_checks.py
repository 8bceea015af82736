"""What no camera, pose, covariance or light plane can be is named.

That whole files are refused for it is tested in test_calibration_storage.
"""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from bodyscan.geometry.camera import Camera
from bodyscan.geometry.lenses.opencv import Radial
from bodyscan.geometry.light_planes import LightPlanes
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.geometry.uncertainty import PoseCovariance
from bodyscan.registration.sanity_checks import (
    find_camera_faults,
    find_covariance_faults,
    find_faults,
    find_pose_faults,
)
from bodyscan.rig.pair import Pair

PROJECTOR = {"stripes": 200, "direction": "horizontal"}
PAIR = Pair.model_validate(
    {"name": "p", "camera": {"width": 640, "height": 480}, "projector": PROJECTOR}
)
SOUND = Camera(700.0, 710.0, -0.5, 322.0, 238.0, Radial(-0.1, 0.02), 640, 480)
POSE = RigidTransform.from_rotation_vector([0.4, -0.2, 1.0], [1500.0, -200.0, 900.0])


def messages(faults: Any) -> str:
    return "; ".join(f"{where} {what}" for where, what in faults)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"u0": -630.0, "gamma": 69.0, "beta": 1390.0}, ""),
        ({"width": 641}, "here is of 641 x 480 pixels, but its rig says 640 x 480"),
        ({"alpha": 85.0, "beta": 90.0}, "here.alpha is not a focal length for 640 pixels (got 85)"),
        ({"beta": 27600.0}, "here.beta is not a focal length"),
        ({"beta": 1410.0}, "here has focal lengths too unlike (got 700, 1410)"),
        ({"gamma": -71.0}, "here.gamma is more skew than a sensor has (got -71)"),
        ({"u0": -641.0}, "here.u0 lies far outside of the image (got -641)"),
        ({"v0": 961.0}, "here.v0 lies far outside"),
        ({"lens": Radial(-8.0, 0.0)}, "here has a lens that folds its image over (got -8, 0)"),
        ({"lens": Radial(np.nan, 0.0)}, "has a lens that folds"),
    ],
)
def test_impossible_cameras_are_named(changes: dict[str, Any], message: str) -> None:
    found = messages(find_camera_faults(replace(SOUND, **changes), PAIR, "here"))
    assert message in found
    assert bool(found) == bool(message)


@pytest.mark.parametrize(
    ("rotation", "translation", "message"),
    [
        (POSE.rotation, [1e5, -1e5, 0.0], ""),
        (POSE.rotation, [0.0, -1.001e5, 0.0], "here lies more than 100 m away"),
        (POSE.rotation * (1.0 + 6e-7), [0.0, 0.0, 0.0], "here is not a rotation: its rows"),
        (-POSE.rotation, [0.0, 0.0, 0.0], "here is not a rotation: it mirrors"),
        (POSE.rotation, [0.0, np.inf, 0.0], "here holds what is not a number"),
    ],
)
def test_a_pose_is_a_rotation_and_a_translation_within_100_m(
    rotation: np.ndarray, translation: list[float], message: str
) -> None:
    found = messages(find_pose_faults(RigidTransform(rotation, np.array(translation)), "here"))
    assert found.startswith(message)
    assert bool(found) == bool(message)


@pytest.mark.parametrize(
    ("matrix", "message"),
    [
        (np.zeros((2, 2)), ""),
        (np.array([[1, 0], [0, 4]]), ""),  # of whole numbers
        (np.array([[1.0, 1e-5], [0.0, 1.0]]), "here is not symmetric"),
        (np.array([[1.0, 1.001], [1.001, 1.0]]), "here is not a covariance"),
        (np.diag([1.0, -1e-9]), "here holds a negative variance"),
        (np.diag([1.0, np.nan]), "here holds what is not a number"),
        (np.eye(2, dtype=complex), "here holds what is not a number"),
        (np.eye(4), "here is of shape (4, 4), but 2 x 2 is wanted"),
        (None, "here is of shape (), but 2 x 2 is wanted"),
    ],
)
def test_a_covariance_is_symmetric_and_positive_semidefinite(matrix: Any, message: str) -> None:
    found = messages(find_covariance_faults(matrix, 2, "here"))
    assert found.startswith(message)
    assert bool(found) == bool(message)


def planes(**changes: Any) -> LightPlanes:
    """A fan of planes, of which the first are not calibrated.

    changes: of `coefficients` or `covariance`, (index, value).
    """
    slope = np.linspace(-0.3, 0.3, 201)
    coefficients = np.column_stack([slope, np.ones_like(slope), slope, np.full_like(slope, -200.0)])
    coefficients /= np.linalg.norm(coefficients[:, :3], axis=1)[:, None]
    coefficients[:3] = np.nan
    arrays = {
        "coefficients": coefficients,
        "covariance": np.tile(np.diag([1e-8, 1e-8, 1e-8, 1e-2]), (201, 1, 1)),
    }
    for name, (index, value) in changes.items():
        arrays[name][index] = value
    return LightPlanes(arrays["coefficients"], arrays["covariance"], "horizontal")


@pytest.mark.parametrize(
    ("light", "message"),
    [
        (planes(), ""),
        (planes(coefficients=(np.s_[:200], np.nan)), ""),  # one is enough
        (None, "pairs.p.light and the rig's projector do not agree"),
        (replace(planes(), direction="vertical"),
         "pairs.p.light is of 200 vertical stripes, but the rig's projector shows 200 horizontal"),
        (replace(planes(), covariance=np.zeros((200, 4, 4))), "has arrays of shapes (201, 4) and"),
        (planes(coefficients=((), np.nan)), "has no plane at all"),
        (planes(coefficients=((9, 2), np.nan)), "holds what is not a number"),
        (planes(covariance=((9, 0, 2), np.inf)), "holds what is not a number"),
        (planes(coefficients=((9, 1), 2.0)), "normals are not of length 1"),
        (planes(covariance=((9, 0, 1), 1.1e-8)), "has a covariance that is not symmetric"),
        (planes(covariance=((9, 0, 0), -1.1e-8)), "is not positive semidefinite"),
    ],
)  # fmt: skip
def test_impossible_light_planes_are_named(light: LightPlanes | None, message: str) -> None:
    pair = SimpleNamespace(
        name="p", camera=SOUND, camera_covariance=np.eye(7), sheets=light, crossing=None
    )
    calibration: Any = SimpleNamespace(
        rig=SimpleNamespace(name="r", pairs=[PAIR], boards=[]),
        pairs={"p": pair},
        failed={},
        rig_from_camera={"p": POSE},
        covariance=PoseCovariance(("p",), np.eye(6)),
        rig_from_board={},
        observed={},
    )
    found = messages(find_faults(calibration))
    assert message in found
    assert bool(found) == bool(message)
