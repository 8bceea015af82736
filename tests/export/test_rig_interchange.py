import json

import cv2
import numpy as np
import pycolmap
import pytest
from ring import ring_of_cameras, ring_rig

from bodyscan.calibration.pair import PairCalibration, PairQuality
from bodyscan.errors import BadInput
from bodyscan.export.rig import export_rig
from bodyscan.export.rig_formats.colmap import read_colmap_rig, write_colmap_rig
from bodyscan.export.rig_formats.opencv import read_opencv_rig, write_opencv_rig
from bodyscan.geometry.camera_fields import to_fields
from bodyscan.geometry.pose_covariance import PoseCovariance
from bodyscan.registration.rig_calibration import RigCalibration

WRITTEN = {
    "colmap": (write_colmap_rig, read_colmap_rig, "model"),
    "opencv": (write_opencv_rig, read_opencv_rig, "rig.yaml"),
}


@pytest.fixture
def calibration():
    placings, cameras = ring_of_cameras(heights=(700, 1200))
    pairs = {
        name: PairCalibration(
            name, camera, np.eye(len(camera.parameters)), None, PairQuality(0.1, 9)
        )
        for name, camera in cameras.items()
    }
    covariance = PoseCovariance(tuple(pairs), np.eye(6 * len(pairs)))
    return RigCalibration(ring_rig(placings), pairs, placings, covariance, {}, {}, ())


@pytest.fixture
def points():
    """Points of the scan volume, rig frame."""
    return np.random.default_rng(2).uniform([-300, -300, 600], [300, 300, 1300], (50, 3))


@pytest.mark.parametrize("kind", WRITTEN)
def test_the_same_numbers_are_read_back(calibration, tmp_path, kind):
    write, read, name = WRITTEN[kind]
    path = write(calibration, tmp_path / name)
    found = read(path)
    assert list(found) == list(calibration.pairs)
    for pair, (camera, rig_from_camera) in found.items():
        own = calibration.pairs[pair].camera
        assert to_fields(camera) == pytest.approx(to_fields(own), abs=1e-9)
        np.testing.assert_allclose(
            rig_from_camera.matrix, calibration.rig_from_camera[pair].matrix, rtol=0, atol=1e-9
        )


def test_colmap_itself_sees_the_cameras_where_they_stand(calibration, points, tmp_path):
    model = pycolmap.Reconstruction()
    model.read_text(write_colmap_rig(calibration, tmp_path / "model"))
    assert model.num_rigs() == 1
    assert model.rig(1).num_sensors() == len(calibration.pairs)
    for image in model.images.values():
        own = calibration.pairs[image.name].camera
        seen = calibration.rig_from_camera[image.name].inverse().apply(points)
        pixels = [image.project_point(point) for point in points]
        # COLMAP's pixel centres are at +0.5, its cameras without skew.
        expected = own.without_skew(own.project(seen)) + 0.5
        np.testing.assert_allclose(pixels, expected, rtol=0, atol=1e-8)
        assert own.gamma != 0


def test_opencv_itself_projects_the_same(calibration, points, tmp_path):
    path = write_opencv_rig(calibration, tmp_path / "rig.yaml")
    store = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    pairs = store.getNode("pairs")
    for k, (name, pair) in enumerate(calibration.pairs.items()):
        node = pairs.at(k)
        assert node.getNode("name").string() == name
        matrix = node.getNode("camera_matrix").mat()
        assert matrix[0, 1] == node.getNode("skew").real() == pair.camera.gamma
        rotation, translation = node.getNode("R").mat(), node.getNode("T").mat()
        lens = node.getNode("distortion_coefficients").mat()
        pixels, _ = cv2.projectPoints(points, cv2.Rodrigues(rotation)[0], translation, matrix, lens)
        seen = calibration.rig_from_camera[name].inverse().apply(points)
        expected = pair.camera.without_skew(pair.camera.project(seen))
        np.testing.assert_allclose(pixels.reshape(-1, 2), expected, rtol=0, atol=1e-7)


def test_the_same_bytes_and_nothing_left_over(calibration, tmp_path):
    formats = ["colmap", "opencv"]
    first = export_rig(calibration, tmp_path / "a", formats)
    export_rig(calibration, tmp_path / "b", formats)
    assert first == [tmp_path / "a" / "colmap", tmp_path / "a" / "rig-opencv.yaml"]
    files = sorted(p.relative_to(tmp_path / "a") for p in (tmp_path / "a").rglob("*"))
    assert [f.name for f in files if f.suffix] == [
        "bodyscan.json",
        *(f"{what}.txt" for what in ("cameras", "frames", "images", "points3D", "rigs")),
        "rig-opencv.yaml",
    ]
    for file in files:
        if file.suffix:
            assert (tmp_path / "a" / file).read_bytes() == (tmp_path / "b" / file).read_bytes()


def test_what_is_no_rig_is_refused(calibration, tmp_path):
    with pytest.raises(BadInput, match="meshroom"):
        export_rig(calibration, tmp_path, ["meshroom"])
    with pytest.raises(BadInput, match="export-rig"):
        read_colmap_rig(tmp_path / "nothing")
    with pytest.raises(BadInput, match="export-rig"):
        read_opencv_rig(tmp_path / "nothing.yaml")
    torn = tmp_path / "torn.yaml"
    torn.write_text("%YAML 1.2\n---\npairs:\n   -\n      name: a\n")
    with pytest.raises(BadInput, match="export-rig"):
        read_opencv_rig(torn)
    folder = write_colmap_rig(calibration, tmp_path / "model")
    content = json.loads((folder / "bodyscan.json").read_text())
    content["pairs"]["stranger"] = content["pairs"].pop("p1-1")
    (folder / "bodyscan.json").write_text(json.dumps(content))
    with pytest.raises(BadInput, match="stranger"):
        read_colmap_rig(folder)
