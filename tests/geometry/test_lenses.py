from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bodyscan.errors import BadInput
from bodyscan.geometry.camera import Camera
from bodyscan.geometry.camera_fields import from_fields, to_fields
from bodyscan.geometry.lenses import LENSES, lens_from_opencv
from bodyscan.geometry.lenses.lens import Lens

# The least and longest lenses that scanners have: 35 and 12 degrees from the axis to the corner.
FOCAL_PX = st.floats(600.0, 2000.0)
SHARE = 0.2  # of the prior's sigma: a stronger lens may fold within the image


@st.composite
def lenses(draw) -> Lens:
    lens = LENSES[draw(st.sampled_from(sorted(LENSES)))]()
    count = len(lens.names)
    shares = draw(st.lists(st.floats(-SHARE, SHARE), min_size=count, max_size=count))
    return lens.with_coefficients(np.array(shares) * lens.prior_sigmas)


cameras = st.builds(
    Camera,
    alpha=FOCAL_PX,
    beta=FOCAL_PX,
    gamma=st.floats(-3.0, 3.0),
    u0=st.floats(300.0, 340.0),
    v0=st.floats(220.0, 260.0),
    lens=lenses(),
    width=st.just(640),
    height=st.just(480),
)


def pixels_of(camera: Camera) -> np.ndarray:
    u, v = np.meshgrid(np.linspace(0, camera.width - 1, 9), np.linspace(0, camera.height - 1, 7))
    return np.stack([u, v], axis=-1).reshape(-1, 2)


@given(cameras)
def test_projecting_and_looking_back_undo_each_other(camera):
    pixels = pixels_of(camera)
    rays = camera.rays(pixels)
    # Newton's method has converged to rounding: 1e-8 px is far below any corner's noise.
    assert np.allclose(camera.project(rays * 1234.5), pixels, rtol=0.0, atol=1e-8)
    assert np.allclose(camera.rays(camera.project(rays)), rays, rtol=0.0, atol=1e-11)


@given(lenses())
def test_newtons_method_in_the_plane_serves_every_lens(lens):
    ideal = np.random.default_rng(0).uniform(-0.4, 0.4, (40, 2))
    assert np.allclose(Lens.undistort(lens, lens.distort(ideal)), ideal, rtol=0.0, atol=1e-12)


@given(cameras)
def test_jacobians_are_derivatives(camera):
    points = camera.rays(pixels_of(camera)) * 1200.0
    by_parameter, by_point = camera.jacobians(points)
    assert by_parameter.shape == (len(points), 2, len(camera.parameter_names))
    for k in range(3):
        shift = 1e-2 * np.eye(3)[k]
        numeric = (camera.project(points + shift) - camera.project(points - shift)) / 2e-2
        # Central differences of 0.01 mm: curvature leaves 1e-8 px/mm, rounding 1e-10.
        assert np.allclose(by_point[:, :, k], numeric, rtol=0.0, atol=1e-7)
    for k, step in enumerate(np.diag(camera.difference_steps)):
        numeric = camera.moved(step).project(points) - camera.moved(-step).project(points)
        # Pixels of 1e3 are rounded to 1e-13, over steps of at least 1e-5.
        expected = 2.0 * step[k] * by_parameter[:, :, k]
        assert np.allclose(numeric, expected, rtol=1e-6, atol=1e-11)


@given(cameras)
def test_a_step_of_a_difference_is_small_in_the_image(camera):
    points = camera.rays(pixels_of(camera))
    for step in np.diag(camera.difference_steps):
        moved = np.abs(camera.moved(step).project(points) - camera.project(points)).max()
        assert 1e-6 < moved < 0.1  # px: far above rounding, far below what bends


@given(cameras)
def test_parameters_are_read_and_moved_by_name(camera):
    named = dict(zip(camera.parameter_names, camera.parameters, strict=True))
    assert named["alpha"] == camera.alpha
    step = np.zeros(len(named))
    step[camera.parameter_names.index("gamma")] = 0.25
    assert camera.moved(step) == replace(camera, gamma=camera.gamma + 0.25)
    assert len(camera.prior_sigmas) == len(camera.difference_steps) == len(named)


@given(cameras)
def test_a_camera_is_read_as_it_was_written(camera):
    assert from_fields(to_fields(camera)) == camera


@given(lenses())
def test_a_lens_of_opencvs_is_read_as_it_was_written(lens):
    try:
        coefficients = lens.opencv()
    except BadInput:
        return
    found = lens_from_opencv(coefficients)
    ideal = np.random.default_rng(0).uniform(-0.4, 0.4, (40, 2))
    assert np.allclose(found.distort(ideal), lens.distort(ideal), rtol=0.0, atol=1e-15)


def fields() -> dict:
    return to_fields(Camera(600.0, 601.0, 0.0, 320.0, 240.0, LENSES["radial"](), 640, 480))


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"lens": "fisheye"}, "lens 'fisheye' is unknown, there are"),
        ({"p1": 0.1}, "lacks or does not have p1"),
        ({"alpha": float("nan")}, "alpha of a camera is nan, not a number"),
        ({"alpha": "600"}, "alpha of a camera is '600', not a number"),
    ],
)
def test_fields_of_no_camera_are_refused(changed, message):
    with pytest.raises(ValueError, match=message):
        from_fields(fields() | changed)


def test_a_coefficient_left_out_is_named():
    damaged = fields()
    del damaged["k2"]
    with pytest.raises(ValueError, match="lacks or does not have k2"):
        from_fields(damaged)
