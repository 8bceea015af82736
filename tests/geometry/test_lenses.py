import itertools
from dataclasses import asdict, replace
from typing import Any

import cv2
import numpy as np
import pytest
from any_camera import cameras, lenses, pixels_of
from hypothesis import given
from hypothesis import strategies as st

from bodyscan.errors import BadInput
from bodyscan.geometry.camera import Camera, camera_from_fields, describe_camera
from bodyscan.geometry.lenses import LENSES, lens_from_opencv
from bodyscan.geometry.lenses.fisheye import Fisheye
from bodyscan.geometry.lenses.lens import Lens
from bodyscan.geometry.lenses.opencv import Brown, Radial, Rational


@given(cameras)
def test_projecting_and_looking_back_undo_each_other(camera: Camera) -> None:
    pixels = pixels_of(camera)
    rays = camera.rays(pixels)
    # Newton's method has converged to rounding: 1e-8 px is far below any corner's noise.
    assert np.allclose(camera.project(rays * 1234.5), pixels, rtol=0.0, atol=1e-8)
    assert np.allclose(camera.rays(camera.project(rays)), rays, rtol=0.0, atol=1e-11)


@given(lenses())
def test_newtons_method_in_the_plane_serves_every_lens(lens: Lens) -> None:
    ideal = np.random.default_rng(0).uniform(-0.4, 0.4, (40, 2))
    assert np.allclose(Lens.undistort(lens, lens.distort(ideal)), ideal, rtol=0.0, atol=1e-12)


FOLDING = (
    Radial(-0.6, 0.0),
    Radial(-0.6, 0.05),
    Brown(-0.5, 0.1, 2e-3, -1e-3, -0.1),
    Brown(0.1, -0.4, 0.0, 0.0, 0.0),
    Rational(0.2, 0.0, 1e-3, 0.0, -0.3, 0.1, 0.0, 0.1),
    Rational(0.0, 0.0, 0.0, 0.0, 0.0, -0.8, 0.0, 0.0),  # a pole at 1.12
)


@pytest.mark.parametrize("lens", FOLDING)
def test_no_ray_is_better_than_a_wrong_one(lens: Lens) -> None:
    """Beyond the fold there is no answer; before it, all around, the very point."""
    reach = lens.fold_radius
    turns = np.linspace(0.0, 2.0 * np.pi, 24, endpoint=False)
    around = np.stack([np.cos(turns), np.sin(turns)], axis=-1)
    # Towards the fold a point is known less and less by where it is shown: 0.98 has 1e-12 left.
    for share in (0.0, 0.3, 0.6, 0.9, 0.98):
        ideal = share * reach * around
        assert np.allclose(lens.undistort(lens.distort(ideal)), ideal, rtol=0.0, atol=1e-9)
    real = np.random.default_rng(0).uniform(-4.0, 4.0, (500, 2))
    found = lens.undistort(real)
    known = np.isfinite(found).all(axis=1)
    # A pincushion lens shows all of the plane before its pole.
    assert (0 < known.sum() < len(real)) or lens.coefficients[5] == -0.8
    assert np.allclose(lens.distort(found[known]), real[known], rtol=0.0, atol=1e-9)
    assert np.linalg.norm(found[known], axis=1).max() < reach


@pytest.mark.parametrize("lens", FOLDING)
def test_the_fold_is_where_it_is_said_to_be(lens: Lens) -> None:
    def turned_over(radius: float) -> bool:
        turns = np.linspace(0.0, 2.0 * np.pi, 64, endpoint=False)
        points = radius * np.stack([np.cos(turns), np.sin(turns)], axis=-1)
        return bool(np.any(np.linalg.det(lens.by_point(points)) <= 0.0))

    assert not any(turned_over(share * lens.fold_radius) for share in np.linspace(0.01, 0.995, 40))
    assert turned_over(1.01 * lens.fold_radius)


@given(st.floats(-0.2, 0.2), st.floats(-0.1, 0.1))
def test_the_chapters_lens_is_browns_without_the_rest(k1: float, k2: float) -> None:
    """The general scan finds the fold that the closed form has, and both bend alike."""
    radial, brown, rational = Radial(k1, k2), Brown(k1, k2), Rational(k1, k2)
    ideal = np.random.default_rng(0).uniform(-0.4, 0.4, (40, 2))
    for other in (brown, rational):
        assert np.allclose(other.distort(ideal), radial.distort(ideal), rtol=0.0, atol=1e-15)
        assert (
            other.fold_radius == pytest.approx(radial.fold_radius, rel=2e-3)
            or radial.fold_radius > 20.0
        )


@pytest.mark.parametrize("lens", [Brown(-0.2, 0.1, 2e-3, -1e-3, 0.05),
                                  Rational(0.3, -0.1, 1e-3, 2e-3, 0.05, 0.4, 0.1, -0.05)])  # fmt: skip
def test_opencv_projects_alike(lens: Lens) -> None:
    camera = Camera(900.0, 905.0, 0.0, 330.0, 235.0, lens, 640, 480)
    points = np.random.default_rng(0).uniform([-0.4, -0.3, 1.0], [0.4, 0.3, 1.0], (50, 3))
    expected, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), camera.matrix, lens.opencv())
    assert np.allclose(camera.project(points), expected.reshape(-1, 2), rtol=0.0, atol=1e-9)


def test_opencv_projects_a_fisheye_alike() -> None:
    """Up to 80 degrees from the axis, and on it."""
    lens = Fisheye(0.05, -0.02, 0.01, -0.003)
    camera = Camera(400.0, 402.0, 0.0, 640.0, 480.0, lens, 1280, 960)
    angle = np.radians(np.linspace(0.0, 80.0, 41))
    turn = np.linspace(0.0, 40.0, 41)
    axes = np.sin(angle) * np.array([np.cos(turn), np.sin(turn)])
    points = np.stack([*axes, np.cos(angle)], axis=1)
    expected, _ = cv2.fisheye.projectPoints(
        points[:, None], np.zeros(3), np.zeros(3), camera.matrix, lens.coefficients
    )
    assert np.allclose(camera.project(points), expected.reshape(-1, 2), rtol=0.0, atol=1e-9)
    back = camera.rays(camera.project(points))
    assert np.allclose(back[:, :2], points[:, :2] / points[:, 2:], rtol=1e-9, atol=1e-9)


@given(cameras)
def test_jacobians_are_derivatives(camera: Camera) -> None:
    points = camera.rays(pixels_of(camera)) * 1200.0
    by_parameter, by_point = camera.jacobians(points)
    assert by_parameter.shape == (len(points), 2, len(camera.parameter_names))
    for k in range(3):
        shift = 1e-2 * np.eye(3)[k]
        numeric = (camera.project(points + shift) - camera.project(points - shift)) / 2e-2
        # Central differences of 0.01 mm: curvature leaves 1e-8 px/mm, rounding 1e-10.
        assert np.allclose(by_point[:, :, k], numeric, rtol=0.0, atol=1e-7)
    steps = np.where(np.arange(len(camera.parameters)) < 5, 1e-2, 1e-5)
    for k, step in enumerate(np.diag(steps)):
        numeric = camera.retract(step).project(points) - camera.retract(-step).project(points)
        # Pixels of 1e3 are rounded to 1e-13, over steps of at least 1e-5.
        expected = 2.0 * step[k] * by_parameter[:, :, k]
        assert np.allclose(numeric, expected, rtol=1e-6, atol=1e-11)


@given(cameras)
def test_parameters_are_read_and_moved_by_name(camera: Camera) -> None:
    named = dict(zip(camera.parameter_names, camera.parameters, strict=True))
    assert named["alpha"] == camera.alpha
    step = np.zeros(len(named))
    step[camera.parameter_names.index("gamma")] = 0.25
    assert camera.retract(step) == replace(camera, gamma=camera.gamma + 0.25)
    assert len(camera.prior_sigmas) == len(named)


@given(cameras)
def test_a_camera_is_read_as_it_was_written(camera: Camera) -> None:
    assert camera_from_fields(describe_camera(camera)) == camera


@given(lenses())
def test_a_lens_of_opencvs_is_read_as_it_was_written(lens: Lens) -> None:
    try:
        coefficients = lens.opencv()
    except BadInput:
        return
    found = lens_from_opencv(coefficients)
    ideal = np.random.default_rng(0).uniform(-0.4, 0.4, (40, 2))
    assert np.allclose(found.distort(ideal), lens.distort(ideal), rtol=0.0, atol=1e-15)


@pytest.mark.parametrize("lens", [Brown(p1=0.01, p2=-0.02), Rational(p1=0.01, p2=-0.02)])
def test_points_in_whole_numbers_are_distorted_as_others_are(lens: Lens) -> None:
    whole = np.array([[0, 0], [1, 0], [0, -1]])
    np.testing.assert_array_equal(lens.distort(whole), lens.distort(whole.astype(float)))


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"lens": "fish"}, "lens 'fish' is unknown, there are"),
        ({"p1": 0.1}, "lacks or does not have p1"),
        ({"alpha": float("nan")}, "alpha of a camera is nan, not a number"),
        ({"alpha": "600"}, "alpha of a camera is '600', not a number"),
        ({"k2": None}, "lacks or does not have k2"),  # left out
    ],
)
def test_fields_of_no_camera_are_refused(changed: dict[str, Any], message: str) -> None:
    camera = Camera(600.0, 601.0, 0.0, 320.0, 240.0, LENSES["radial"](), 640, 480)
    fields = describe_camera(camera) | changed
    with pytest.raises(ValueError, match=message):
        camera_from_fields({k: v for k, v in fields.items() if v is not None})


def test_a_coefficient_that_lenses_share_is_as_likely_large_in_each() -> None:
    """A lens may be called by a longer formula: k1 and k2 say the same there."""
    named = [
        dict(zip(asdict(lens), lens.prior_sigmas.tolist(), strict=True))
        for lens in (Radial(), Brown(), Rational())
    ]
    for shorter, longer in itertools.pairwise(named):
        assert shorter == {name: longer[name] for name in shorter}
