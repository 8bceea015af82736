"""Sheets of light of a projector that OpenCV describes as a camera, against OpenCV itself; and light
sheets as a projector with a lens: exact where they are one, refused where they are not."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from bodyscan.arrays import Array
from bodyscan.calibration.projector_camera import (
    fit_projector,
    intersect_central_rays,
    sheets_from_projector,
)
from bodyscan.errors import BadInput
from bodyscan.geometry.bowed_sheets import BowedSheets
from bodyscan.geometry.camera import Camera
from bodyscan.geometry.lens_sheets import LensSheets
from bodyscan.geometry.lenses import lens_from_opencv
from bodyscan.geometry.lenses.opencv import Radial
from bodyscan.geometry.light_planes import Axis, LightPlanes
from bodyscan.geometry.transforms import RigidTransform

CAMERA = Camera(2800.0, 2790.0, 0.0, 1300.0, 970.0, Radial(-0.1, 0.05), 2592, 1944)
SIZE = {"vertical": 1280, "horizontal": 800}
LENSES = {
    "none": np.zeros(5),
    "radial": np.array([-0.05, 0.3, 0.0, 0.0, 0.0]),
    "Brown": np.array([-0.05, 1.4, -7.5e-3, -2e-3, -7.3]),
    "rational": np.array([0.4, 0.2, 2e-3, -1e-3, 0.05, 0.45, 0.3, 0.02]),
}
PLACE = RigidTransform.from_rotation_vector([0.05, -0.3, -0.1], [230.0, -25.0, 30.0])
MIDDLE = np.array([20.0, -10.0, 900.0])


def projector(lens: str, skew: float = 0.0) -> Camera:
    return Camera(1650.0, 1720.0, skew, 622.0, 363.0, lens_from_opencv(LENSES[lens]), 1280, 800)


@pytest.mark.parametrize("kind", LENSES)
@pytest.mark.parametrize("direction", ["vertical", "horizontal"])
def test_its_sheets_lie_where_opencv_projects_them(kind: str, direction: Axis) -> None:
    light = projector(kind)
    rng = np.random.default_rng(3)
    points = rng.uniform([-150.0, -120.0, 550.0], [120.0, 120.0, 850.0], (400, 3))
    seen, _ = cv2.projectPoints(
        points, PLACE.rotation_vector, PLACE.translation, light.matrix, LENSES[kind]
    )
    s = seen[:, 0, 0 if direction == "vertical" else 1] + 0.5
    shown = (s > 0.0) & (s < SIZE[direction])
    assert shown.sum() > 250
    for halves in (1, 2):  # two pixels a stripe: half as many stripes
        stripes = SIZE[direction] // halves
        # Where the search starts must not matter: nobody says how far away the subject stands.
        for middle in ([0.0, 0.0, 300.0], [0.0, 0.0, 3000.0]):
            sheets = sheets_from_projector(light, PLACE, np.array(middle), stripes, direction)
            depth, per_stripe, variance = sheets.intersect(
                points[shown] / points[shown, 2:], s[shown] / halves
            )
            if direction == "vertical":  # along the baseline, so that depth is well told
                np.testing.assert_allclose(depth, points[shown, 2], rtol=0, atol=1e-6)
            np.testing.assert_allclose(sheets.stripe(points) * halves, s, rtol=0, atol=1e-9)
            assert np.all(variance == 0.0)
            assert np.all(np.abs(per_stripe) > 0.0)


def test_skew_turns_the_sheets_of_columns_alone() -> None:
    light = projector("Brown", skew=4.0)
    points = np.random.default_rng(4).uniform([-100, -100, 600], [100, 100, 800], (50, 3))
    inside = PLACE.apply(points)
    bent, _ = cv2.projectPoints(inside, np.zeros(3), np.zeros(3), np.eye(3), LENSES["Brown"])
    u, v = np.moveaxis(light.pixels_from_normalized(bent[:, 0]), -1, 0)
    expected_of: dict[Axis, Array] = {"vertical": u, "horizontal": v}
    for direction, expected in expected_of.items():
        sheets = sheets_from_projector(light, PLACE, points[0], SIZE[direction], direction)
        np.testing.assert_allclose(sheets.stripe(points), expected + 0.5, rtol=0, atol=1e-9)


def test_sigma_moves_all_sheets_together() -> None:
    light = projector("Brown")
    sheets = sheets_from_projector(light, PLACE, np.array([0, 0, 700.0]), 640, "vertical", 0.5)
    rays = np.array([[0.0, 0.0, 1.0], [0.1, 0.05, 1.0]])
    depth, per_stripe, variance = sheets.intersect(rays, np.array([200.0, 300.0]))
    assert np.all(np.isfinite(depth))
    # half a projector pixel is a quarter of a stripe of two pixels
    np.testing.assert_allclose(np.sqrt(variance), 0.25 * np.abs(per_stripe), rtol=1e-12)


def test_what_is_looked_at_lies_where_the_axes_meet() -> None:
    light = projector("none")
    target = np.array([0.0, 0.0, 700.0])
    camera_middle = CAMERA.rays(np.array([1295.5, 971.5])) * 700.0
    middle = light.rays(np.array([639.5, 399.5]))
    # Turn the projector so that the middle of its picture falls on that point.
    position = np.array([200.0, 0.0, 0.0])
    z = (camera_middle - position) / np.linalg.norm(camera_middle - position)
    x = np.cross([0.0, 1.0, 0.0], z) / np.linalg.norm(np.cross([0.0, 1.0, 0.0], z))
    looks = np.stack([x, np.cross(z, x), z])
    wanted = middle / np.linalg.norm(middle)
    correct, _ = cv2.Rodrigues(np.cross([0.0, 0.0, 1.0], wanted))
    place = RigidTransform(correct @ looks, -correct @ looks @ position)
    found = intersect_central_rays(CAMERA, light, place)
    assert np.linalg.norm(found - target) < 15.0
    parallel = RigidTransform(np.eye(3), np.array([-200.0, 0.0, 0.0]))
    assert intersect_central_rays(CAMERA, light, parallel)[2] == pytest.approx(1000.0, rel=0.3)


def sheets(light: Camera, direction: Axis) -> LensSheets:
    return sheets_from_projector(light, PLACE, MIDDLE, SIZE[direction], direction)


def somewhere() -> Array:
    """Points about the boards, camera frame, mm."""
    points: Array = np.random.default_rng(5).uniform([-150, -120, 700], [150, 120, 1150], (300, 3))
    return points


@pytest.mark.parametrize("lens", LENSES)
def test_both_directions_give_the_projector_back(lens: str) -> None:
    light = projector(lens)
    found = fit_projector(CAMERA, sheets(light, "vertical"), sheets(light, "horizontal"))
    np.testing.assert_allclose(found.camera.parameters[:5], light.parameters[:5], rtol=0, atol=1e-5)
    np.testing.assert_allclose(found.camera.lens.opencv()[:5], LENSES[lens][:5], rtol=0, atol=1e-7)
    np.testing.assert_allclose(found.projector_from_camera.matrix, PLACE.matrix, rtol=0, atol=1e-5)
    assert (found.camera.width, found.camera.height) == (1280, 800)
    assert found.misfit_px < 1e-6


@pytest.mark.parametrize("direction", ["vertical", "horizontal"])
@pytest.mark.parametrize("lens", LENSES)
def test_one_direction_is_exact_across_the_stripes(lens: str, direction: Axis) -> None:
    """Rounding alone is left: nothing is fitted."""
    own = sheets(projector(lens), direction)
    found = fit_projector(CAMERA, own)
    pixels = found.camera.project(found.projector_from_camera.apply(somewhere()))
    s = pixels[:, 0 if direction == "vertical" else 1] + 0.5
    np.testing.assert_allclose(s, own.stripe(somewhere()), rtol=0, atol=1e-9)
    assert found.misfit_px == found.predicted_px == 0.0


def test_light_that_held_out_boards_found_to_be_no_projector_with_a_lens_is_refused() -> None:
    columns = sheets(projector("none"), "vertical")
    planes = LightPlanes.from_planes(columns.tangent_planes(np.arange(1281.0)), "vertical")
    for light, crossing in ((planes, None), (columns, BowedSheets.from_pinhole(columns, 1))):
        with pytest.raises(BadInput, match="only the lens model can be written"):
            fit_projector(CAMERA, light, crossing)


def test_directions_off_by_their_noise_are_taken_and_by_more_refused() -> None:
    columns, rows = (sheets(projector("Brown"), one) for one in ("vertical", "horizontal"))
    for shift, refused in ((0.05, False), (5.0, True)):
        # A shift of 0.05 mm at 900 mm is 0.1 of the projector's pixels, five times the floor.
        aside = RigidTransform.from_translation([shift, 0.0, 0.0])
        other = replace(rows, projector_from_camera=aside @ rows.projector_from_camera)
        if refused:
            with pytest.raises(BadInput, match="no lens model fits the projector"):
                fit_projector(CAMERA, columns, other)
        else:
            found = fit_projector(CAMERA, columns, other)
            assert 0.0 < found.misfit_px < 3.0 * found.predicted_px


def test_a_mirrored_picture_is_named() -> None:
    light = projector("radial")
    rows = sheets(light, "horizontal")
    turned = RigidTransform(np.diag([-1.0, -1.0, 1.0]), np.zeros(3)) @ rows.projector_from_camera
    mirrored = replace(rows, projector_from_camera=turned)
    with pytest.raises(BadInput, match="mirrored image"):
        fit_projector(CAMERA, sheets(light, "vertical"), mirrored)


def test_sheets_that_nobody_knows_are_no_projector() -> None:
    own, rows = (sheets(projector("none"), one) for one in ("vertical", "horizontal"))
    unknown = replace(own, covariance=np.full_like(own.covariance, np.nan))
    with pytest.raises(BadInput, match="known at 0 of"):
        fit_projector(CAMERA, unknown, rows)
