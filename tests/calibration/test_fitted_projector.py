"""Light sheets as a projector with a lens: exact where they are one, refused where they are not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from bodyscan.arrays import Array
from bodyscan.calibration.fitted_projector import fit_projector
from bodyscan.calibration.sheet_fit import PinholeProjector
from bodyscan.errors import BadInput
from bodyscan.geometry.bowed_sheets import PLANE_DEGREE, BowedSheets
from bodyscan.geometry.camera import Camera
from bodyscan.geometry.lens_sheets import LensSheets
from bodyscan.geometry.lenses import lens_from_opencv
from bodyscan.geometry.lenses.opencv import Radial
from bodyscan.geometry.light_planes import Axis, LightPlanes
from bodyscan.geometry.projector_sheets import sheets_from_projector
from bodyscan.geometry.transforms import RigidTransform

CAMERA = Camera(1400.0, 1410.0, 0.3, 640.0, 500.0, Radial(-0.1, 0.05), 1280, 1024)
PLACE = RigidTransform.from_rotation_vector([0.05, -0.3, -0.1], [230.0, -25.0, 30.0])
MIDDLE = np.array([20.0, -10.0, 900.0])
LENSES = {
    "none": np.zeros(5),
    "radial": np.array([-0.05, 0.3, 0.0, 0.0, 0.0]),
    "Brown": np.array([-0.05, 1.4, -7.5e-3, -2e-3, -7.3]),
    "rational": np.array([0.4, 0.2, 2e-3, -1e-3, 0.05, 0.45, 0.3, 0.02]),
}
SIZE = {"vertical": 1280, "horizontal": 800}


def projector(lens: str) -> Camera:
    return Camera(1650.0, 1720.0, 0.0, 622.0, 363.0, lens_from_opencv(LENSES[lens]), 1280, 800)


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


def test_free_planes_of_a_pinhole_are_one() -> None:
    """The chapter's planes have a covariance each; a row that was never seen does no harm."""
    light = projector("none")
    rows = (light.matrix @ PLACE.matrix[:3])[[0, 2]]
    rows[0] += 0.5 * rows[1]  # columns begin half a pixel before their middle
    planes = PinholeProjector(rows).planes(1280, "vertical").coefficients
    planes[100] = np.nan
    variances = np.tile(np.diag([1e-6, 1e-6, 1e-6, 1e-2]) ** 2, (1281, 1, 1))
    found = fit_projector(CAMERA, LightPlanes(planes, variances, "vertical"))
    columns = found.camera.project(found.projector_from_camera.apply(somewhere()))[:, 0]
    truth = light.project(PLACE.apply(somewhere()))[:, 0]
    np.testing.assert_allclose(columns, truth, rtol=0, atol=1e-3)  # a twentieth of FLOOR_PX


def bowed(sigma: float) -> BowedSheets:
    pinhole = sheets(projector("none"), "vertical")
    own = BowedSheets.from_pinhole(pinhole, 0)
    return replace(own, covariance=np.eye(len(own.parameters)) * sigma**2)


def test_sheets_off_a_projector_by_their_noise_are_taken_and_by_more_refused() -> None:
    """A tenth of a thousandth of the picture's width is a fifth of a stripe."""
    sigma, known = 1e-4, bowed(1e-4)
    draw = np.random.default_rng(8).normal(0.0, sigma, len(known.parameters))
    noisy = replace(known, parameters=known.parameters + draw)
    found = fit_projector(CAMERA, noisy)
    assert 0.01 < found.misfit_px < 2.0 * found.predicted_px
    # a mirror that scans: where the sheets meet wanders by 3 % of the distance, there and back
    wandering = bowed(1e-4).parameters.copy()
    wandering[2 * (PLANE_DEGREE + 1) + 2] += 0.03
    with pytest.raises(BadInput, match="no projector with a lens explains its sheets"):
        fit_projector(CAMERA, replace(known, parameters=wandering))


def test_a_mirrored_picture_is_named() -> None:
    light = projector("radial")
    rows = sheets(light, "horizontal")
    turned = RigidTransform(np.diag([-1.0, -1.0, 1.0]), np.zeros(3)) @ rows.projector_from_camera
    mirrored = replace(rows, projector_from_camera=turned)
    with pytest.raises(BadInput, match="mirrored picture"):
        fit_projector(CAMERA, sheets(light, "vertical"), mirrored)


def test_sheets_that_nobody_knows_are_no_projector() -> None:
    own = bowed(1e-4)
    unknown = replace(own, covariance=np.full_like(own.covariance, np.nan))
    with pytest.raises(BadInput, match="known at 0 of"):
        fit_projector(CAMERA, unknown)
