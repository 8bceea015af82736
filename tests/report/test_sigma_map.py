import cv2
import numpy as np
import pytest
from ring import ring_of_cameras, ring_rig

from bodyscan.calibration.pair import PairCalibration, PairQuality
from bodyscan.errors import BadInput
from bodyscan.geometry.camera import Camera
from bodyscan.geometry.camera_tables import is_in_image
from bodyscan.geometry.lenses.opencv import Radial
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.geometry.uncertainty import PoseCovariance
from bodyscan.registration.rig_calibration import RigCalibration
from bodyscan.report.calibration_charts import sigma_at, sigma_chart

GOOD = PairQuality(0.05, 9)
MIDDLE = np.array([[0.0, 0.0, 1000.0]])


def shifts(names: dict[str, RigidTransform], mm: float) -> PoseCovariance:
    """Every pair shifted by itself, `mm` along each axis, not turned."""
    own = np.diag([0.0, 0.0, 0.0, *[mm**2] * 3])
    return PoseCovariance(tuple(names), np.kron(np.eye(len(names)), own).astype(float))


def calibrated(
    placings: dict[str, RigidTransform],
    cameras: dict[str, Camera],
    covariance: PoseCovariance,
    quality: PairQuality = GOOD,
) -> RigCalibration:
    """Cameras without projectors."""
    pairs = {
        name: PairCalibration(name, cameras[name], np.eye(7), None, quality) for name in placings
    }
    return RigCalibration(ring_rig(placings), pairs, placings, covariance, {}, {}, ())


def test_independent_shifts_average_out_and_shifts_in_common_do_not() -> None:
    placings, cameras = ring_of_cameras(heights=(1000,))
    sigma, seen = sigma_at(MIDDLE, placings, cameras, shifts(placings, 0.3), ())
    assert seen[0] == 3
    assert sigma[0] == pytest.approx(0.3 * np.sqrt(3) / np.sqrt(3))  # three axes, three pairs
    own = np.diag([0.0, 0.0, 0.0, *[0.3**2] * 3])
    together = PoseCovariance(tuple(placings), np.kron(np.ones((3, 3)), own).astype(float))
    sigma, _ = sigma_at(MIDDLE, placings, cameras, together, ())
    assert sigma[0] == pytest.approx(0.3 * np.sqrt(3))


def test_sigma_is_that_of_drawn_placings() -> None:
    placings, cameras = ring_of_cameras(heights=(900, 1300))
    names = tuple(placings)
    rng = np.random.default_rng(1)
    # Turns of 1e-4 radians about the rig's origin and shifts of 0.1 mm, all correlated.
    mixing = rng.normal(size=(36, 36)) / 6.0 * np.tile([1e-4] * 3 + [0.1] * 3, 6)[:, None]
    points = rng.uniform([-300, -300, 700], [300, 300, 1500], (20, 3))
    covariance = PoseCovariance(names, mixing @ mixing.T)
    sigma, seen = sigma_at(points, placings, cameras, covariance, names)
    sights = np.array([is_in_image(cameras[n], placings[n].inverse().apply(points)) for n in names])
    assert np.array_equal(sights.sum(axis=0), seen)
    squared = np.zeros(len(points))
    for draw in rng.normal(size=(800, 36)):
        motions = (mixing @ draw).reshape(6, 6)
        moved = np.array(
            [placings[n].retract(m).apply(placings[n].inverse().apply(points)) - points
             for n, m in zip(names, motions, strict=True)]
        )  # fmt: skip
        mean = np.sum(moved * sights[..., None], axis=0) / np.maximum(seen, 1)[:, None]
        squared += np.sum(mean**2, axis=1)
    drawn = np.sqrt(squared / 800)
    # 800 draws of 3 axes tell a sigma to 2 or 3 % if one axis leads; three such.
    assert np.all(seen > 0)
    np.testing.assert_allclose(sigma, drawn, rtol=0.1)


def test_what_no_pair_sees_has_no_sigma() -> None:
    placings, cameras = ring_of_cameras(heights=(400,))
    own, above = shifts(placings, 0.3), np.array([[0.0, 0.0, 2100.0]])
    sigma, seen = sigma_at(above, placings, cameras, own, placings)
    assert seen[0] == 0
    assert np.isnan(sigma[0])
    drawn, again = (sigma_chart(calibrated(placings, cameras, own)) for _ in range(2))
    assert drawn == again
    picture = cv2.imdecode(np.frombuffer(drawn, np.uint8), cv2.IMREAD_COLOR)
    height, width = picture.shape[:2]
    assert height == 900
    # Two maps of 700 mm about the axis: unseen grey above, a colour where three cameras look.
    for column in (int(0.25 * width), int(0.65 * width)):
        assert picture[100, column].tolist() == [199, 199, 199]
        assert np.ptp(picture[650, column].astype(int)) > 50


def test_a_camera_measures_depth_only_with_another_or_with_its_projector() -> None:
    placings, cameras = ring_of_cameras(poles=1, heights=(1000,))
    own = shifts(placings, 0.3)
    sigma, seen = sigma_at(MIDDLE, placings, cameras, own, ())
    assert seen[0] == 1
    assert np.isnan(sigma[0])
    sigma, _ = sigma_at(MIDDLE, placings, cameras, own, placings)
    assert sigma[0] == pytest.approx(0.3 * np.sqrt(3))


def test_no_map_is_drawn_of_what_is_not_known() -> None:
    placings, cameras = ring_of_cameras(heights=(400,))
    unknown = PairQuality(None, 0, imported="foreign.yaml")
    calibration = calibrated(placings, cameras, shifts(placings, 0.3), unknown)
    with pytest.raises(
        BadInput, match=r"accuracy of the imported calibration of p1-1, p2-1, p3-1 is not known"
    ) as caught:
        sigma_chart(calibration)
    assert "--sigma-px" in caught.value.remedy
    one = {"p1-1": placings["p1-1"]}
    with pytest.raises(BadInput, match="no pose uncertainty to map"):
        sigma_chart(calibrated(one, cameras, shifts(one, 0.0)))


def test_points_that_the_lens_folds_back_are_not_seen() -> None:
    """With Radial(-0.4, 0) a point at 70 degrees projects into the image, which ends at 23 degrees."""
    camera = Camera(1500.0, 1500.0, 0.0, 640.0, 512.0, Radial(-0.4, 0.0), 1280, 1024)
    angles = np.linspace(0.0, 1.4, 200)
    points = 1000.0 * np.stack([np.sin(angles), 0 * angles, np.cos(angles)], axis=1)
    pixels = camera.project(points)
    folded = (pixels[:, 0] > 0) & (pixels[:, 0] < 1279) & (angles > 0.8)
    assert folded.any()
    assert not is_in_image(camera, points)[folded].any()
    assert is_in_image(camera, points)[angles < 0.38].all()
    assert not is_in_image(camera, -points).any()
