"""What no camera, pose or covariance can be is found, and what is merely odd passes."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from sheet_models import PINHOLE, STRIPES

from bodyscan.geometry.bowed_sheets import BowedSheets
from bodyscan.geometry.camera import Camera
from bodyscan.geometry.lenses.radial import Radial
from bodyscan.geometry.light_planes import LightPlanes
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.geometry.uncertainty import PoseCovariance
from bodyscan.registration.rig_calibration import ObservedCorners
from bodyscan.registration.soundness import (
    camera_faults,
    covariance_faults,
    find_faults,
    pose_faults,
)
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

    # Circles of 0.6 and 0.5 of the half diagonal are 59 % and 41 % of the picture.
    wide = replace(SOUND, lens=Radial(folds_at(0.6), 0.0))
    assert said(camera_faults(wide, PAIR, "here")) == ""
    narrow = replace(SOUND, lens=Radial(folds_at(0.5), 0.0))
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


WITH_LIGHT = Pair.model_validate(
    {
        "name": "p",
        "camera": {"width": 640, "height": 480},
        "projector": {"stripes": STRIPES, "direction": "horizontal"},
    }
)
TARGET = ("s1", "board")
collect_corners: Any = ObservedCorners  # of arrays of any kind


def planes(what: str = "coefficients", place: Any = (), value: Any = None) -> LightPlanes:
    """Of a fan, with some that were never measured.  value: what stands at a place instead."""
    slope = np.linspace(-0.3, 0.3, STRIPES + 1)
    coefficients = np.column_stack([slope, np.ones_like(slope), slope, np.full_like(slope, -200.0)])
    coefficients /= np.linalg.norm(coefficients[:, :3], axis=1)[:, None]
    coefficients[:3] = np.nan
    covariance = np.tile(np.diag([1e-8, 1e-8, 1e-8, 1e-2]), (STRIPES + 1, 1, 1))
    if value is not None:
        {"coefficients": coefficients, "covariance": covariance}[what][place] = value
    return LightPlanes(coefficients, covariance, "horizontal")


NINTH = planes().coefficients[9]


def calibration(**changes: Any) -> Any:
    """One pair that saw one board.  changes: of the pair's fields, else of the calibration's."""
    pair = SimpleNamespace(
        name="p", camera=SOUND, camera_covariance=np.eye(7), sheets=planes(), crossing=None
    )
    seen = collect_corners(np.zeros((4, 2)), np.zeros((4, 2)), np.zeros(4, np.int16))
    known = {
        "rig": SimpleNamespace(name="r", pairs=[WITH_LIGHT], boards=[SimpleNamespace(name="board")]),
        "pairs": {"p": pair},
        "failed": {},
        "rig_from_camera": {"p": PLACED},
        "covariance": PoseCovariance(("p",), np.eye(6)),
        "rig_from_board": {TARGET: PLACED},
        "seen": {"p": seen},
    }  # fmt: skip
    for name, value in changes.items():
        if hasattr(pair, name):
            setattr(pair, name, value)
        else:
            known[name] = value
    return SimpleNamespace(**known)


def test_a_sound_calibration_has_no_fault_with_either_kind_of_light() -> None:
    assert said(find_faults(calibration())) == ""
    for light in (PINHOLE, PINHOLE.with_lens(8), BowedSheets.from_pinhole(PINHOLE, 1)):
        known = light.with_covariance(np.eye(len(light.covariance)))
        assert said(find_faults(calibration(sheets=known))) == ""


MIRROR = RigidTransform(np.diag([1.0, 1.0, -1.0]), np.zeros(3))
TWO = Pair.model_validate(WITH_LIGHT.model_dump(mode="json") | {"name": "q"})


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"pairs": {}, "seen": {}}, "pairs is empty"),
        ({"failed": {"p": "why"}}, "failed.p is among the calibrated pairs as well"),
        ({"covariance": PoseCovariance(("q",), np.eye(6))},
         "placing_covariance_order does not name the pairs (got q)"),
        ({"covariance": PoseCovariance(("p", "p"), np.eye(12))}, "does not name the pairs (got p, p)"),
        ({"covariance": PoseCovariance(("p", "q"), np.eye(12))}, "does not name the pairs (got p, q)"),
        ({"covariance": PoseCovariance(("p",), np.eye(7))},
         "placing_covariance is of shape (7, 7), but 6 x 6 is wanted"),
        ({"rig_from_board": {("s1", "other"): PLACED}},
         "boards names no board of rig r (got 'other' in 's1')"),
        ({"rig_from_board": {TARGET: MIRROR}}, "boards: board in s1 is not a rotation: it mirrors"),
        ({"rig_from_camera": {"p": MIRROR}}, "pairs.p.rig_from_camera is not a rotation"),
        ({"camera": replace(SOUND, width=641)}, "pairs.p.camera is of 641 x 480 pixels"),
        ({"camera_covariance": np.eye(6)},
         "p/camera_covariance is of shape (6, 6), but 7 x 7 is wanted"),
    ],
)  # fmt: skip
def test_what_no_calibration_is_is_said_with_its_place(
    changes: dict[str, Any], message: str
) -> None:
    assert message in said(find_faults(calibration(**changes)))


def test_pairs_that_failed_may_have_been_placed_and_others_are_no_pairs_of_the_rig() -> None:
    rig = SimpleNamespace(name="r", pairs=[WITH_LIGHT, TWO], boards=[SimpleNamespace(name="board")])
    both = PoseCovariance(("p", "q"), np.eye(12))
    assert said(find_faults(calibration(rig=rig, covariance=both, failed={"q": "why"}))) == ""
    other = SimpleNamespace(name="r", pairs=[TWO], boards=rig.boards)
    assert "pairs.p is not a pair of rig r" in said(find_faults(calibration(rig=other)))


@pytest.mark.parametrize(
    ("light", "message"),
    [
        (None, "pairs.p.light and the rig's projector do not agree"),
        (LightPlanes(planes().coefficients, planes().covariance, "vertical"),
         "pairs.p.light is of 200 vertical stripes, but the rig's projector shows 200 horizontal"),
        (LightPlanes(planes().coefficients[1:], planes().covariance[1:], "horizontal"),
         "is of 199 horizontal stripes"),
        (LightPlanes(planes().coefficients, planes().covariance[1:], "horizontal"),
         "has arrays of shapes (201, 4) and (200, 4, 4)"),
        (LightPlanes(planes().coefficients[:, :3], planes().covariance, "horizontal"),
         "has arrays of shapes (201, 3)"),
        (planes(value=np.nan), "has no plane at all"),
        (planes("coefficients", (9, 2), np.nan), "holds what is not a number"),
        (planes("covariance", (9, 0, 2), np.inf), "holds what is not a number"),
        (planes("coefficients", 9, (1 + 1.1e-6) * NINTH), "normals are not of length 1"),
        (planes("covariance", (9, 0, 1), 1.1e-8), "has a covariance that is not symmetric"),
        (planes("covariance", (9, 0, 0), -1.1e-8), "is not positive semidefinite"),
        (replace(PINHOLE, parameters=np.ones(11)), "has 11 parameters"),
        (replace(PINHOLE, parameters=np.ones(1)), "has 1 parameters"),
        (replace(PINHOLE, middle=np.ones(2)), "has arrays of shapes (2,) and (2,)"),
        (replace(PINHOLE, middle=np.array([0.0, np.nan, 0.0])), "holds what is not a number"),
        (replace(PINHOLE, projector_from_camera=MIRROR),
         "pairs.p.light: projector_from_camera is not a rotation: it mirrors"),
        (PINHOLE.with_covariance(np.eye(9)), "pairs.p.light: covariance is of shape (9, 9), but 8 x 8"),
    ],
)  # fmt: skip
def test_what_no_light_is_is_named(light: Any, message: str) -> None:
    assert message in said(find_faults(calibration(sheets=light)))


@pytest.mark.parametrize(
    "light",
    [
        planes("coefficients", 9, (1 + 0.9e-6) * NINTH),
        planes("covariance", (9, 0, 1), 0.9e-8),  # a millionth of the largest, which is 1e-2
        planes("covariance", (9, 0, 0), -0.9e-8),
        planes("coefficients", np.s_[:STRIPES], np.nan),  # one is enough
    ],
)
def test_what_rounding_leaves_of_planes_passes(light: LightPlanes) -> None:
    assert said(find_faults(calibration(sheets=light))) == ""


def test_light_that_crosses_is_of_stripes_that_the_projector_shows() -> None:
    assert "pairs.p.crossing is of stripes that the rig's projector does not show" in said(
        find_faults(calibration(crossing=planes()))
    )


@pytest.mark.parametrize(
    ("seen", "message"),
    [
        (collect_corners(np.zeros((4, 2)), np.zeros((3, 2)), np.zeros(4, np.int16)),
         "p/seen has arrays of shapes (4, 2), (3, 2), (4,)"),
        (collect_corners(np.zeros((4, 2)), np.full((4, 2), np.nan), np.zeros(4, np.int16)),
         "p/seen holds what is not a number"),
        (collect_corners(np.full((4, 2), np.inf), np.zeros((4, 2)), np.zeros(4, np.int16)),
         "p/seen holds what is not a number"),
        (collect_corners(np.zeros((4, 2)), np.zeros((4, 2)), np.array([0, 0, 1, 0], np.int16)),
         "p/seen names boards that there are not"),
        (collect_corners(np.zeros((4, 2)), np.zeros((4, 2)), np.array([0, -1, 0, 0], np.int16)),
         "p/seen names boards that there are not"),
        (collect_corners(np.zeros((4, 2)), np.zeros((4, 2)), np.zeros(4)),
         "p/seen names boards that there are not"),
    ],
)  # fmt: skip
def test_corners_that_were_seen_are_numbers_on_boards_that_there_are(
    seen: ObservedCorners, message: str
) -> None:
    assert said(find_faults(calibration(seen={"p": seen}))) == message
