"""The projectors against light followed step by step; the lens against OpenCV's and its inverse."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bodyscan.geometry.transforms import RigidTransform
from bodyscan.simulation.layout import build_mirror, build_pinhole
from bodyscan.simulation.lens import TrueCamera, sample_directions
from bodyscan.simulation.projector import MirrorProjector, PinholeProjector
from bodyscan.simulation.settings import Projection

ABOVE = RigidTransform.from_rotation_vector([-0.2, 0.03, 0.02], [15.0, -280.0, 10.0])
SEEN = (
    np.stack(
        np.meshgrid(np.linspace(-0.42, 0.42, 7), np.linspace(-0.34, 0.34, 7), [1.0]), axis=-1
    ).reshape(-1, 3)
    * np.array([800.0, 1300.0, 1800.0])[:, None, None]
)
SEEN = SEEN.reshape(-1, 3)


def mirror(horizontal: bool = True, **change: Any) -> MirrorProjector:
    projection = replace(Projection(), **change)
    rng = np.random.default_rng(5)
    return build_mirror(ABOVE, 640, horizontal, SEEN, projection, rng)


def followed_light(projector: MirrorProjector, s: float, spread: float) -> np.ndarray:
    """(2, 3): where a ray of the laser's fan meets the mirror, and a place further on its way."""
    angle = projector.first_angle + s / projector.stripes * projector.sweep_angle
    turned = RigidTransform.from_rotation_vector(projector.axis * angle, np.zeros(3))
    normal = turned.rotation @ projector.zero
    edge = np.cross(projector.sheet, projector.aim)
    ray = projector.aim + spread * edge
    surface = projector.centre + projector.offset_mm * normal
    hit = projector.laser + ray * (normal @ (surface - projector.laser)) / (normal @ ray)
    return np.stack([hit, hit + 1000.0 * (ray - 2 * (ray @ normal) * normal)])


@settings(max_examples=40, deadline=None)
@given(s=st.floats(0, 640), spread=st.floats(-0.3, 0.3), horizontal=st.booleans())
def test_light_followed_off_the_mirror_carries_its_stripe(
    s: float, spread: float, horizontal: bool
) -> None:
    projector = mirror(horizontal)
    start, place = followed_light(projector, s, spread)
    assert projector.stripe(place) == pytest.approx(s, abs=1e-9)
    # single precision: angles of 1e-7 rad, stripes of 7e-4 rad of mirror
    assert projector.stripe(place.astype(np.float32)) == pytest.approx(s, abs=1e-3)
    back = start - place
    source = projector.source(np.array(s))
    # the light seems to come straight from the mirrored laser, behind the mirror
    assert np.cross(back / np.linalg.norm(back), source - start) == pytest.approx(0, abs=1e-9)
    assert back @ (source - start) > 0
    plane = projector.plane(np.array(s))
    assert plane[:3] @ place + plane[3] == pytest.approx(0, abs=1e-8)


def line_in_common(planes: np.ndarray) -> float:
    """How far planes (N, 4), lengths in m, are from sharing one line: 0 if they do."""
    return float(np.linalg.svd(planes / np.linalg.norm(planes, axis=1, keepdims=True))[1][2])


def metres(planes: np.ndarray) -> np.ndarray:
    return planes * [1, 1, 1, 1e-3]


def test_sheets_share_no_line() -> None:
    s = np.linspace(0, 640, 65)
    real = line_in_common(metres(mirror().plane(s)))
    true: dict[str, Any] = {"mirror_offset_mm": (0.0, 0.0), "sheet_tilt_deg": 0.0, "aim_mm": 0.0}
    ideal = line_in_common(metres(mirror(**true).plane(s)))
    assert ideal < 1e-12  # a mirror and a sheet through the axis: all planes hold the axis
    assert real > 1e-3  # about a millimetre and more, at a metre
    for one in ("mirror_offset_mm", "sheet_tilt_deg"):
        part = mirror(**{key: value for key, value in true.items() if key != one})
        assert line_in_common(metres(part.plane(s))) > 1e-4


@pytest.mark.parametrize("build", [build_mirror, build_pinhole])
@pytest.mark.parametrize("horizontal", [True, False])
def test_sweep_covers_what_the_camera_sees(
    build: Callable[..., MirrorProjector | PinholeProjector], horizontal: bool
) -> None:
    projector = build(ABOVE, 640, horizontal, SEEN, Projection(), np.random.default_rng(2))
    s = projector.stripe(SEEN)
    assert np.isfinite(s).all()
    assert s.min() == pytest.approx(640 * 0.02 / 1.04, abs=1e-6)  # the margin, and no more
    assert s.max() == pytest.approx(640 - 640 * 0.02 / 1.04, abs=1e-6)
    image = SEEN[:, 1 if horizontal else 0] / SEEN[:, 2]
    assert np.corrcoef(image, s)[0, 1] > 0.8  # stripes are counted down, or to the right


def test_smile_bows_the_ends_only() -> None:
    straight, bowed = mirror(), mirror(smile_stripes=0.5)
    across = np.abs(straight.fan_tangent(SEEN, straight.angle(SEEN))) / straight.fan
    assert bowed.stripe(SEEN) - straight.stripe(SEEN) == pytest.approx(0.5 * across**2)


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
