"""Every format written, read back, and read by the program whose it is where that is installed."""

from __future__ import annotations

import ast
import json
import re
import tomllib
from contextlib import nullcontext, suppress
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np
import pycolmap
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st
from ring import ring_of_cameras

from bodyscan.arrays import Array
from bodyscan.errors import BadInput, CalibrationFileError
from bodyscan.geometry.camera import Camera
from bodyscan.geometry.lenses import lens_from_opencv
from bodyscan.geometry.lenses.fisheye import Fisheye
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.interchange.formats.opencv import read_nodes
from bodyscan.interchange.found_camera import find_camera
from bodyscan.interchange.rig_format import MILLIMETRES, RIG_FORMATS, RigCameras

WORLDS = {"opencv", "colmap", "mrcal", "aniposelib", "caliscope"}  # Kalibr's is its first camera


def ring() -> RigCameras:
    placings, cameras = ring_of_cameras(heights=(700, 1200))
    return {name: (cameras[name], placings[name]) for name in cameras}


@pytest.fixture
def points() -> Array:
    """Points of the scan volume, rig frame."""
    points: Array = np.random.default_rng(2).uniform([-300, -300, 600], [300, 300, 1300], (50, 3))
    return points


@pytest.mark.parametrize("kind", RIG_FORMATS.names())
def test_the_same_cameras_are_read_back(tmp_path: Path, kind: str) -> None:
    form, cameras = RIG_FORMATS.find(kind), ring()
    found = form.read(form.write(cameras, tmp_path / form.path))
    scale = MILLIMETRES[form.unit or "mm"]
    first = next(iter(cameras.values()))[1]
    for name, (camera, rig_from_camera) in cameras.items():
        own = found[name]().camera(camera.width, camera.height)
        np.testing.assert_allclose(own.parameters, camera.parameters, rtol=0, atol=1e-9)
        pose = found[name]().camera_from_world
        assert pose is not None
        world = rig_from_camera if kind in WORLDS else first.inverse() @ rig_from_camera
        read = RigidTransform(pose.rotation, pose.translation * scale).inverse()
        np.testing.assert_allclose(read.matrix, world.matrix, rtol=0, atol=1e-8)


LENSES = {
    "brown": lens_from_opencv(np.array([-0.2, 0.1, 1e-3, -2e-3, 0.05])),
    "rational": lens_from_opencv(np.array([0.4, 0.2, 1e-3, -2e-3, 0.05, 0.5, 0.3, 0.02])),
    "fisheye": Fisheye(0.1, -0.02, 0.01, -0.003),
}


@pytest.mark.parametrize("lens", LENSES)
@pytest.mark.parametrize("kind", RIG_FORMATS.names())
def test_every_lens_that_a_format_has_is_read_back(tmp_path: Path, kind: str, lens: str) -> None:
    form, cameras = RIG_FORMATS.find(kind), dict(ring())
    name = "p2-1"
    own = replace(cameras[name][0], lens=LENSES[lens])
    assert own.lens.kind == lens
    cameras[name] = own, cameras[name][1]
    if kind == ("mrcal" if lens == "fisheye" else "kalibr"):
        with pytest.raises(BadInput, match=f"pair {name}: .* no lens like '{lens}'"):
            form.write(cameras, tmp_path / form.path)
        assert not list(tmp_path.iterdir())
        return
    found = form.read(form.write(cameras, tmp_path / form.path))[name]()
    read = found.camera(own.width, own.height)
    assert read.lens.kind == lens
    np.testing.assert_allclose(read.parameters, own.parameters, rtol=0, atol=1e-9)


@pytest.mark.parametrize("kind", RIG_FORMATS.names())
def test_the_same_cameras_give_the_same_bytes(tmp_path: Path, kind: str) -> None:
    form = RIG_FORMATS.find(kind)
    for folder in ("a", "b"):
        assert form.write(ring(), tmp_path / folder / form.path) == tmp_path / folder / form.path
    files = [p.relative_to(tmp_path / "a") for p in (tmp_path / "a").rglob("*") if p.is_file()]
    assert files
    assert not [file for file in files if file.name.startswith(".")]
    for file in files:
        assert (tmp_path / "a" / file).read_bytes() == (tmp_path / "b" / file).read_bytes()


def test_colmap_itself_sees_the_cameras_where_they_stand(points: Array, tmp_path: Path) -> None:
    cameras, model = ring(), pycolmap.Reconstruction()
    model.read_text(RIG_FORMATS.find("colmap").write(cameras, tmp_path / "model"))
    assert model.num_rigs() == 1
    assert model.rig(1).num_sensors() == len(cameras)
    for image in model.images.values():
        own, rig_from_camera = cameras[image.name]
        pixels = [image.project_point(point) for point in points]
        # COLMAP's pixel centres are at +0.5, its cameras without skew.
        expected = replace(own, gamma=0.0).project(rig_from_camera.inverse().apply(points)) + 0.5
        np.testing.assert_allclose(pixels, expected, rtol=0, atol=1e-8)
        assert own.gamma != 0


def test_opencv_itself_projects_the_same(points: Array, tmp_path: Path) -> None:
    path = RIG_FORMATS.find("opencv").write(ring(), tmp_path / "rig.yaml")
    store = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    pairs = store.getNode("pairs")
    for k, (name, (camera, rig_from_camera)) in enumerate(ring().items()):
        node = pairs.at(k)
        assert node.getNode("name").string() == name
        matrix = node.getNode("camera_matrix").mat()
        assert matrix[0, 1] == node.getNode("skew").real() == camera.gamma
        rotation, translation = node.getNode("R").mat(), node.getNode("T").mat()
        lens = node.getNode("distortion_coefficients").mat()
        pixels, _ = cv2.projectPoints(points, cv2.Rodrigues(rotation)[0], translation, matrix, lens)
        expected = replace(camera, gamma=0.0).project(rig_from_camera.inverse().apply(points))
        np.testing.assert_allclose(pixels.reshape(-1, 2), expected, rtol=0, atol=1e-7)


def test_what_python_programs_read_projects_the_same(points: Array, tmp_path: Path) -> None:
    """Kalibr's YAML, mrcal's literal and the TOMLs by what their own programs parse them with,
    projected by OpenCV as they do."""
    cameras = ring()
    files = {kind: RIG_FORMATS.find(kind).write(cameras, tmp_path / kind) for kind in WORLDS}
    files["kalibr"] = RIG_FORMATS.find("kalibr").write(cameras, tmp_path / "kalibr")
    anipose = tomllib.loads(files["aniposelib"].read_text("utf-8"))
    caliscope = tomllib.loads(files["caliscope"].read_text("utf-8"))["cameras"]
    kalibr = yaml.safe_load(files["kalibr"].read_text("utf-8"))
    chain = np.eye(4)
    first = next(iter(cameras.values()))[1]
    for k, (name, (camera, rig_from_camera)) in enumerate(cameras.items()):
        seen = rig_from_camera.inverse().apply(points)
        expected = replace(camera, gamma=0.0).project(seen)
        model = ast.literal_eval((files["mrcal"] / f"{name}.cameramodel").read_text("utf-8"))
        fx, fy, cx, cy, *lens = model["intrinsics"]
        matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
        rotation, shift = np.split(np.array(model["extrinsics"]), 2)
        told = [(rotation, shift, matrix, np.array(lens), points)]
        for table, metres in ((anipose[f"cam_{k}"], 1.0), (caliscope[str(k)], 1000.0)):
            words = "rotation", "translation", "matrix", "distortions"
            rotation, shift, matrix, lens = (np.array(table[word]) for word in words)
            told.append((rotation, metres * shift, matrix, lens, points))
        own = kalibr[f"cam{k}"]
        chain = np.array(own.get("T_cn_cnm1", np.eye(4))) @ chain
        fx, fy, cx, cy = own["intrinsics"]
        matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
        rotation = cv2.Rodrigues(chain[:3, :3])[0]
        in_first = first.inverse().apply(points)
        told.append(
            (rotation, 1000.0 * chain[:3, 3], matrix, np.array(own["distortion_coeffs"]), in_first)
        )
        for *numbers, where in told:
            pixels, _ = cv2.projectPoints(where, *numbers)
            np.testing.assert_allclose(pixels[:, 0], expected, rtol=0, atol=1e-6)


WRITTEN_BY_OTHERS = {
    "kalibr": (
        "camchain.yaml",
        "cam0:\n"
        "  camera_model: pinhole\n"
        "  distortion_coeffs: [-0.2, 0.05]\n"
        "  distortion_model: none\n"
        "  intrinsics: [1000.0, 1010.0, 640.0, 360.0]\n"
        "  resolution: [1280, 720]\n"
        "right:\n  note: no camera\n"
        "cam1:\n"
        "  camera_model: pinhole\n"
        "  distortion_coeffs: [-0.2, 0.05, 0.0, 0.0]\n"
        "  distortion_model: radtan\n"
        "  intrinsics: [1000.0, 1010.0, 640.0, 360.0]\n"
        "  resolution: [1280, 720]\n"
        "  T_cn_cnm1:\n"
        "  - [1.0, 0.0, 0.0, -0.2]\n  - [0.0, 1.0, 0.0, 0.0]\n"
        "  - [0.0, 0.0, 1.0, 0.0]\n  - [0.0, 0.0, 0.0, 1.0]\n",
        "cam1",
    ),
    "mrcal": (
        "left.cameramodel",
        "# made on some day\n{\n"
        "    'lensmodel':  'LENSMODEL_OPENCV8',\n\n"
        "    # intrinsics are fx,fy,cx,cy,distortion0,distortion1,....\n"
        "    'intrinsics': [ 1000, 1010, 640, 360, -0.2, 0.05, 0, 0, 0, 0, 0, 0,],\n"
        "    'extrinsics': [ 0, 0, 0, -0.2, 0., 0., ],\n"
        "    'imagersize': [ 1280, 720,],\n"
        "    'icam_intrinsics': 0,\n    'optimization_inputs': b'P)h>@6aWAK',\n}\n",
        "left",
    ),
    "aniposelib": (
        "calibration.toml",
        '[cam_0]\nname = "A"\nsize = [ 1280, 720,]\n'
        "matrix = [ [ 1000.0, 0.0, 640.0,], [ 0.0, 1010.0, 360.0,], [ 0.0, 0.0, 1.0,],]\n"
        "distortions = [ -0.2, 0.05, 0.0, 0.0, 0.0,]\n"
        "rotation = [ 0.0, 0.0, 0.0,]\ntranslation = [ -0.2, 0.0, 0.0,]\n\n"
        "[metadata]\nadjusted = false\nerror = 0.3\n",
        "A",
    ),
    "caliscope": (
        "camera_array.toml",
        "[cameras.3]\ncam_id = 3\nsize = [1280, 720]\nrotation_count = 0\nerror = 0.4\n"
        "matrix = [[1000.0, 0.0, 640.0], [0.0, 1010.0, 360.0], [0.0, 0.0, 1.0]]\n"
        "distortions = [-0.2, 0.05, 0.0, 0.0, 0.0]\n"
        "translation = [-0.2, 0.0, 0.0]\nrotation = [0.0, 0.0, 0.0]\n"
        "grid_count = 20\nfisheye = false\n",
        "3",
    ),
}
"""Made up here after the descriptions of each format; all say the same camera."""


@pytest.mark.parametrize("kind", WRITTEN_BY_OTHERS)
def test_what_others_write_is_read(tmp_path: Path, kind: str) -> None:
    file, text, name = WRITTEN_BY_OTHERS[kind]
    (tmp_path / file).write_text(text)
    found = RIG_FORMATS.find(kind).read(tmp_path / file)[name]()
    assert found.camera(1280, 720) == Camera(
        1000.0, 1010.0, 0.0, 640.0, 360.0,
        lens_from_opencv(np.array([-0.2, 0.05, 0.0, 0.0, 0.0])), 1280, 720,
    )  # fmt: skip
    assert found.camera_from_world is not None
    np.testing.assert_array_equal(found.camera_from_world.rotation, np.eye(3))
    np.testing.assert_array_equal(found.camera_from_world.translation, [-0.2, 0.0, 0.0])


def spoilt(kind: str, old: str, new: str) -> str:
    text = WRITTEN_BY_OTHERS[kind][1]
    assert old in text
    return text.replace(old, new)


WRONG = [
    ("kalibr", "radtan", "fov", r":12: cam1.distortion_model: 'fov' is a lens"),
    ("kalibr", "1000.0, 1010.0", "9" * 400 + ", 1010.0", r":5: cam0.intrinsics: holds what is not a n"),
    ("kalibr", "  note: no camera", "  note: a\n  note: b", r":9: right.note: is given twice"),
    ("kalibr", "pinhole", "ds", r":2: cam0.camera_model: 'ds' is a lens that is not supported"),
    ("kalibr", "cam0", "camera0", r"no cam0"),
    ("kalibr", "[1.0, 0.0, 0.0, -0.2]", "[-1.0, 0.0, 0.0, -0.2]", r"T_cn_cnm1: is a reflection"),
    ("kalibr", "[1.0, 0.0, 0.0, -0.2]", "[1.1, 0.0, 0.0, -0.2]", r"T_cn_cnm1: is not a rotation"),
    ("kalibr", "1280, 720", "1280", r":6: cam0.resolution: holds 1 numbers, not 2"),
    ("kalibr", "  intrinsics", "\tintrinsics", r"is not YAML"),
    ("mrcal", "OPENCV8", "CAHVOR", r":3: lensmodel: 'LENSMODEL_CAHVOR' is a lens"),
    ("mrcal", "1000, 1010", "1000", r":6: intrinsics: holds 11 numbers, not 12"),
    ("mrcal", "1000, 1010", "1000, -1010", r":6: intrinsics: has focal lengths 1000 and -1010"),
    ("mrcal", "1000, 1010", "1e999, 1010", r":6: intrinsics: holds a number that is not finite"),
    ("mrcal", "'imagersize'", "'size'", r"has no imagersize"),
    ("mrcal", "[ 1280, 720,]", "[ 1280, 720", r":\d+: is not an mrcal cameramodel"),
    ("aniposelib", "-0.2, 0.05, 0.0, 0.0, 0.0", "-0.2, nan, 0, 0, 0", r":5: cam_0.distortions: .*f"),
    ("aniposelib", "size", "sizes", r":1: cam_0: has no size"),
    ("aniposelib", "0.0, 0.0, 0.0,]\nrot", "0, 0, 1]\nfisheye = true\nrot", r":5: .* a fisheye has 4"),
    ("aniposelib", "[ -0.2,", "[" * 9999, r"is not TOML"),
    ("aniposelib", "0.05, 0.0", "0.05, 0, 0.0", r":5: cam_0.distortions: holds 6 numbers, not"),
    ("caliscope", "[cameras.3]", "[camera.3]", r"holds no cameras"),
    ("caliscope", "1280, 720]", "1280, 720", r"is not TOML: .*line"),
    ("caliscope", "0.0, 0.0, 1.0", "0.0, 1.0, 0.0", r":6: cameras.3.matrix: is not a camera matrix"),
]  # fmt: skip


@pytest.mark.parametrize(("kind", "old", "new", "said"), WRONG)
def test_what_is_wrong_is_named_with_its_line(
    tmp_path: Path, kind: str, old: str, new: str, said: str
) -> None:
    path = tmp_path / WRITTEN_BY_OTHERS[kind][0]
    path.write_text(spoilt(kind, old, new))
    with pytest.raises(CalibrationFileError, match=said) as caught:
        [camera() for camera in RIG_FORMATS.find(kind).read(path).values()]
    assert str(path) in caught.value.where
    assert caught.value.remedy


NODES = {"matrix": "cam/K", "distortion": "kc", "size": "size", "rotation": "R", "translation": "T"}
NUMBERS = {
    "K": [1000.0, 0.0, 640.0, 0.0, 1010.0, 360.0, 0.0, 0.0, 1.0],
    "kc": [-0.2, 0.05, 0.0, 0.0, 0.0],
    "R": [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
    "T": [-0.2, 0.0, 0.0],
}


def storage(kind: str) -> str:
    """What cv2.FileStorage writes: a matrix in a node of its own, others at the root."""
    flags = {
        "yaml": cv2.FILE_STORAGE_FORMAT_YAML,
        "xml": cv2.FILE_STORAGE_FORMAT_XML,
        "json": cv2.FILE_STORAGE_FORMAT_JSON,
    }
    store = cv2.FileStorage(
        f"any.{kind}", cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY | flags[kind]
    )
    store.startWriteStruct("cam", cv2.FILE_NODE_MAP)
    store.write("K", np.array(NUMBERS["K"]).reshape(3, 3))
    store.endWriteStruct()
    store.write("kc", np.array(NUMBERS["kc"])[:, None])
    store.write("R", np.array(NUMBERS["R"]).reshape(3, 3))
    store.write("T", np.array(NUMBERS["T"])[:, None])
    store.write("size", np.array([[1280, 720]]))
    text: str = store.releaseAndGetString()
    return text


ROS = """\
cam:
  K: {rows: 3, cols: 3, data: [1000.0, 0, 640, 0, 1010, 360, 0, 0, 1]}
kc: {rows: 1, cols: 5, data: [-0.2, 0.05, 0, 0, 0]}
size: [1280, 720]
R: [[1, 0, 0], [0, 1, 0], [0, 0, 1]]
T: [-0.2, 0, 0]
"""


@pytest.mark.parametrize("kind", ["yaml", "xml", "json", "ros"])
def test_nodes_of_any_name_are_read(tmp_path: Path, kind: str) -> None:
    path = tmp_path / f"any.{kind}"
    path.write_text(ROS if kind == "ros" else storage(kind))
    found = read_nodes(path, NODES)
    lens = lens_from_opencv(np.array(NUMBERS["kc"]))
    assert found.camera(1280, 720) == Camera(1000, 1010, 0, 640, 360, lens, 1280, 720)
    assert found.camera_from_world is not None
    np.testing.assert_array_equal(found.camera_from_world.matrix[:3, 3], NUMBERS["T"])
    turned = read_nodes(path, NODES | {"rotation": "T"})
    assert turned.camera_from_world is not None
    np.testing.assert_allclose(turned.camera_from_world.rotation_vector, NUMBERS["T"], atol=1e-15)


@pytest.mark.parametrize(
    ("wrong", "said", "remedy"),
    [
        ({"matrix": "cam/k"}, r"any.yaml:3: has no node 'k' below cam", "there is K"),
        ({"distortion": "kcc"}, r"has no node 'kcc' in it \(did you mean 'kc'\?\)", "cam, kc, R"),
        ({"matrix": "kc"}, r"any.yaml:9: kc: holds 5 numbers, not 9", ""),
        ({"rotation": "cam/K"}, r"K: is not a rotation", ""),
        ({"size": "T"}, r"T: holds 3 numbers, not 2", ""),
        ({"translation": "size"}, r"size: holds 2 numbers, not 3", ""),
    ],
)
def test_nodes_that_do_not_fit_are_named(
    tmp_path: Path, wrong: dict[str, str], said: str, remedy: str
) -> None:
    path = tmp_path / "any.yaml"
    path.write_text(storage("yaml"))
    with pytest.raises(CalibrationFileError, match=said) as caught:
        read_nodes(path, NODES | wrong)
    assert remedy in caught.value.remedy


def test_numbers_that_cannot_be_are_named(tmp_path: Path) -> None:
    path, text = tmp_path / "any.yaml", storage("yaml")
    path.write_text(re.sub(r"data: \[ -[^,]*", "data: [ .Nan", text, count=1))
    with pytest.raises(CalibrationFileError, match=r"any.yaml:9: kc: holds a number that is not"):
        read_nodes(path, NODES)
    for spoilt_text in ("", "words", text.replace("data: [", "data: ", 1)):
        path.write_text(spoilt_text)
        with pytest.raises(
            CalibrationFileError, match=r"neither YAML, XML nor JSON|not a number|no node"
        ):
            read_nodes(path, NODES)
    with pytest.raises(CalibrationFileError, match="there is no such file"):
        read_nodes(tmp_path / "nowhere.yaml", NODES)


ROS_CAMERA = """\
image_width: 1280
image_height: 720
distortion_model: MODEL
camera_matrix: {rows: 3, cols: 3, data: [1000.0, 0, 640, 0, 1010, 360, 0, 0, 1]}
distortion_coefficients: {rows: 1, cols: 4, data: [-0.2, 0.05, 0.0, 0.0]}
"""
BROWN = lens_from_opencv(np.array([-0.2, 0.05, 0, 0, 0]))
ROS_NODES = {"matrix": "camera_matrix", "distortion": "distortion_coefficients"}


@pytest.mark.parametrize(
    ("old", "new", "lens"),
    [
        ("MODEL", "equidistant", Fisheye(-0.2, 0.05)),
        ("MODEL", "plumb_bob\nbinning_x: 0\nroi: {x_offset: 0, width: 640}", BROWN),
        ("distortion_model: MODEL", "fisheye_model: 1", Fisheye(-0.2, 0.05)),
        ("distortion_model: MODEL", "model: fisheye", Fisheye(-0.2, 0.05)),
        ("distortion_model: MODEL", "camera_model: my-camera 7", BROWN),
        ("MODEL", "thin_prism_fisheye", None),
        ("distortion_model: MODEL", "camera_model: omni", None),
        ("distortion_model: MODEL", "distortion_type: fisheye", Fisheye(-0.2, 0.05)),
        ("distortion_model: MODEL", "isFisheye: true", Fisheye(-0.2, 0.05)),
        ("distortion_model: MODEL", "model_type: MEI", None),
        ("MODEL", "plumb_bob\nis_fisheye: true", None),
        ("MODEL", "plumb_bob\nbinning_y: 2", None),
        ("MODEL", "plumb_bob\nroi: {x_offset: 0, y_offset: 40}", None),
        ("distortion_model: MODEL", "fisheye: 0\nmodel: equidistant", None),
    ],
)
def test_words_beside_coefficients_decide_the_lens(
    tmp_path: Path, old: str, new: str, lens: object
) -> None:
    path = tmp_path / "ros.yaml"
    path.write_text(ROS_CAMERA.replace(old, new))
    refused = pytest.raises(CalibrationFileError, match=r":\d: \w+: ('.*' is a|contrad|of pic)")
    with nullcontext() if lens else refused:
        assert read_nodes(path, ROS_NODES).lens == lens


@pytest.mark.parametrize(
    "head", ["", "%YAML:1.0\n", "%YAML:1.0\n---\n", "---\n", "%YAML 1.2\n---\n"]
)
@pytest.mark.parametrize("tail", ["", "---\nother: [\n"])
def test_every_dialect_of_yaml_is_read(tmp_path: Path, head: str, tail: str) -> None:
    path = tmp_path / "any.yaml"
    coefficients = "\n- -0.2\n- 0.05\n- 0.0\n- 0.0"
    path.write_text(
        head
        + ROS_CAMERA.replace("MODEL", "plumb_bob")
        + f"d:{coefficients}\nk: !!opencv-matrix\n   data: [ 1., 2. ]\n"
        + tail
    )
    assert read_nodes(path, ROS_NODES | {"distortion": "d"}).lens.coefficients[0] == -0.2
    _, text, camera = WRITTEN_BY_OTHERS["kalibr"]
    path.write_text(
        head + text.replace(" [-0.2, 0.05, 0.0, 0.0]", coefficients.replace("\n", "\n  ")) + tail
    )
    assert RIG_FORMATS.find("kalibr").read(path)[camera]().lens.coefficients[0] == -0.2
    path.write_text(head + "a: b\n  c: d\n" + tail)
    with pytest.raises(
        CalibrationFileError, match=rf"any.yaml:{head.count(chr(10)) + 2}: is not YAML"
    ):
        read_nodes(path, ROS_NODES)


def test_what_json_cannot_hold_is_named_with_its_line(tmp_path: Path) -> None:
    path = tmp_path / "any.json"
    path.write_text(re.sub(r"-0\.2\d*", "NaN", storage("json"), count=1))
    with pytest.raises(CalibrationFileError, match=r"any.json:\d+: kc: holds a number that"):
        read_nodes(path, NODES)
    path.write_text('{"a": ' + "[" * 100_000)
    with pytest.raises(CalibrationFileError, match="nested"):
        read_nodes(path, NODES)


def test_a_camera_that_nobody_asked_for_hinders_no_other(tmp_path: Path) -> None:
    path = tmp_path / "camchain.yaml"
    path.write_text(spoilt("kalibr", "radtan", "fov"))
    cameras = RIG_FORMATS.find("kalibr").read(path)
    assert find_camera(cameras, "cam0", str(path)).size == (1280, 720)
    with pytest.raises(CalibrationFileError, match="'fov' is a lens"):
        find_camera(cameras, "cam1", str(path))
    with pytest.raises(CalibrationFileError, match="has no camera 'cam7'") as caught:
        find_camera(cameras, "cam7", str(path))
    assert "it has cam0; cam1 cannot be used" in caught.value.remedy
    assert "camchain.yaml:12: cam1.distortion_model: 'fov' is a lens" in caught.value.remedy
    (tmp_path / "left.cameramodel").write_text(WRITTEN_BY_OTHERS["mrcal"][1])
    (tmp_path / "right.cameramodel").write_text(spoilt("mrcal", "OPENCV8", "SPLINED_STEREOGRAPHIC"))
    assert RIG_FORMATS.find("mrcal").read(tmp_path)["left"]().size == (1280, 720)
    path.write_text("[cameras.0]\ncam_id = 0\nsize = [9, 9]\n" + WRITTEN_BY_OTHERS["caliscope"][1])
    assert RIG_FORMATS.find("caliscope").read(path)["3"]().size == (1280, 720)


@pytest.mark.parametrize("words", [("T_cam_imu", "T_cam_imu"), ("T_imu_cam", "T_cam_imu")])
def test_kalibr_cameras_are_placed_by_the_imu(tmp_path: Path, words: tuple[str, str]) -> None:
    first = RigidTransform.from_rotation_vector(
        np.array([0.1, 0.2, -0.3]), np.array([0.1, 0, 0.05])
    )
    second = RigidTransform.from_rotation_vector(np.array([0, -0.2, 0.4]), np.array([-0.2, 0.1, 0]))
    text = WRITTEN_BY_OTHERS["kalibr"][1].split("  T_cn_cnm1")[0]
    given = [first if words[0] == "T_cam_imu" else first.inverse(), second]
    lines = [f"  {word}: {pose.matrix.tolist()}\n" for word, pose in zip(words, given, strict=True)]
    path = tmp_path / "imucam.yaml"
    path.write_text(text.replace("right:", f"{lines[0]}right:") + lines[1])
    pose = RIG_FORMATS.find("kalibr").read(path)["cam1"]().camera_from_world
    assert pose is not None
    np.testing.assert_allclose(pose.matrix, (second @ first.inverse()).matrix, rtol=0, atol=1e-12)


def test_caliscope_turns_no_calibration_and_null_is_no_pose(tmp_path: Path) -> None:
    path, caliscope = tmp_path / "camera_array.toml", RIG_FORMATS.find("caliscope")
    path.write_text(spoilt("caliscope", "rotation_count = 0", "rotation_count = 1"))
    assert caliscope.read(path)["3"]().camera_from_world is not None
    path.write_text(spoilt("caliscope", "rotation = [0.0, 0.0, 0.0]", 'rotation = "null"'))
    assert caliscope.read(path)["3"]().camera_from_world is None


def test_the_newer_key_of_mrcal_is_read(tmp_path: Path) -> None:
    path = tmp_path / "left.cameramodel"
    path.write_text(spoilt("mrcal", "extrinsics", "rt_cam_ref"))
    pose = RIG_FORMATS.find("mrcal").read(path)["left"]().camera_from_world
    assert pose is not None
    assert pose.translation[0] == -0.2


def test_a_size_may_be_given_by_two_nodes(tmp_path: Path) -> None:
    path = tmp_path / "any.yaml"
    path.write_text(storage("yaml") + "w: 1280\nh: 720\nhalf: 0.5\n")
    apart = {what: name for what, name in NODES.items() if what != "size"}
    assert read_nodes(path, apart | {"width": "w", "height": "h"}).size == (1280, 720)
    with pytest.raises(CalibrationFileError, match="w: is not the size of an image"):
        read_nodes(path, apart | {"width": "w", "height": "half"})


def test_a_file_of_another_camera_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "any.yaml"
    path.write_text(storage("yaml"))
    with pytest.raises(CalibrationFileError, match=r"1280 x 720 px, the rig file says 640 x 360"):
        read_nodes(path, NODES).camera(640, 360)
    unsaid = read_nodes(path, {k: v for k, v in NODES.items() if k != "size"})
    with pytest.raises(CalibrationFileError, match=r"principal point at \(640.0, 360.0\), outside"):
        unsaid.camera(640, 360)
    assert unsaid.camera(1920, 1080).width == 1920


def test_what_is_no_rig_is_refused(tmp_path: Path) -> None:
    colmap, opencv = RIG_FORMATS.find("colmap"), RIG_FORMATS.find("opencv")
    with pytest.raises(BadInput, match="is not a COLMAP model"):
        colmap.read(tmp_path / "nothing")
    torn = tmp_path / "torn.yaml"
    torn.write_text("%YAML 1.2\n---\npairs:\n   -\n      name: a\n")
    with pytest.raises(BadInput, match="has no node 'image_width' below pairs/0"):
        opencv.read(torn)["a"]()
    torn.write_text(storage("yaml"))
    with pytest.raises(BadInput, match="no list of pairs") as caught:
        opencv.read(torn)
    assert "cam, kc, R, T, size" in caught.value.remedy
    folder = colmap.write(ring(), tmp_path / "model")
    content = json.loads((folder / "bodyscan.json").read_text())
    content["pairs"]["stranger"] = content["pairs"].pop("p1-1")
    (folder / "bodyscan.json").write_text(json.dumps(content))
    with pytest.raises(BadInput, match="stranger"):
        colmap.read(folder)
    for wrong in ('{"pairs": ' + "[" * 100_000, '{"pairs": {"p1-1": {"gamma": NaN}}}'):
        (folder / "bodyscan.json").write_text(wrong)
        with pytest.raises(BadInput, match=r"nested too deep|NaN is not a finite number"):
            colmap.read(folder)


def test_a_colmap_model_of_others(tmp_path: Path) -> None:
    """Two cameras in a rig that was seen in two frames: placed by the rig, named by their folders."""
    model = pycolmap.Reconstruction()
    rig = pycolmap.Rig(rig_id=1)
    for number, (name, params) in enumerate(
        (("SIMPLE_RADIAL", [1000.0, 640.5, 360.5, -0.2]), ("PINHOLE", [900.0, 910.0, 600, 350])), 1
    ):
        model.add_camera(
            pycolmap.Camera(model=name, width=1280, height=720, params=params, camera_id=number)
        )
    sensors = [pycolmap.sensor_t(pycolmap.SensorType.CAMERA, k) for k in (1, 2)]
    rig.add_ref_sensor(sensors[0])
    shifted = np.eye(4)[:3]
    shifted[0, 3] = -0.2
    rig.add_sensor(sensors[1], pycolmap.Rigid3d(shifted))
    model.add_rig(rig)
    for number in (1, 2):
        frame = pycolmap.Frame(frame_id=number, rig_id=1)
        for k, sensor in enumerate(sensors, 1):
            frame.add_data_id(pycolmap.data_t(sensor, 10 * number + k))
        frame.rig_from_world = pycolmap.Rigid3d(np.eye(4)[:3])
        model.add_frame(frame)
        for k in (1, 2):
            image = pycolmap.Image(
                name=f"cam{k}/{number}.jpg", camera_id=k, image_id=10 * number + k
            )
            image.frame_id = number
            model.add_image(image)
        model.register_frame(number)
    (tmp_path / "sparse").mkdir()
    model.write(tmp_path / "sparse")
    found = RIG_FORMATS.find("colmap").read(tmp_path / "sparse")
    assert {"1", "2", "cam1", "cam2", "cam1/1.jpg", "cam2/2.jpg"} < set(found)
    lens = lens_from_opencv(np.array([-0.2, 0, 0, 0, 0]))
    assert found["cam1"]().camera(1280, 720) == Camera(1000, 1000, 0, 640, 360, lens, 1280, 720)
    pose = found["cam2"]().camera_from_world
    assert pose is not None
    np.testing.assert_allclose(pose.matrix[:3, 3], [-0.2, 0.0, 0.0])
    fisheye = pycolmap.Camera(
        model="OPENCV_FISHEYE", width=1280, height=720, params=[900, 900, 640, 360, 0.1, 0.2, 0, 0],
        camera_id=1,
    )  # fmt: skip
    strange = pycolmap.Reconstruction()
    fov = pycolmap.Camera(
        model="FOV", width=1280, height=720, params=[900, 900, 640, 360, 0.5], camera_id=2
    )
    strange.add_camera(fisheye)
    strange.add_camera(fov)
    (tmp_path / "strange").mkdir()
    strange.write(tmp_path / "strange")
    cameras = RIG_FORMATS.find("colmap").read(tmp_path / "strange")
    assert cameras["1"]().lens == Fisheye(0.1, 0.2, 0.0, 0.0)
    with pytest.raises(CalibrationFileError, match="FOV, which is not supported"):
        cameras["2"]()


def test_a_colmap_sensor_without_a_place_in_its_rig_has_none(tmp_path: Path) -> None:
    names = list(ring())
    folder = RIG_FORMATS.find("colmap").write(ring(), tmp_path / "model")
    model = pycolmap.Reconstruction(folder)
    for file in folder.glob("*.bin"):
        file.unlink()
    model.write_text(folder)
    rigs = (folder / "rigs.txt").read_text("utf-8").rstrip("\n").split("\n")
    fields = rigs[-1].split()
    # rig, sensors, CAMERA 1, then of each: CAMERA, its number, whether it has a pose, the pose.
    assert fields[4:7] == ["CAMERA", "2", "1"]
    rigs[-1] = " ".join([*fields[:6], "0", *fields[14:]])
    (folder / "rigs.txt").write_text("\n".join(rigs) + "\n", "utf-8")
    found = RIG_FORMATS.find("colmap").read(folder)
    assert found[names[1]]().camera_from_world is None
    assert found[names[2]]().camera_from_world is not None


JUNK = st.sampled_from(
    ["", "[", "]", "{", "}", "nan", "1e999", "-1", '"', "x", "\n", "\t", ":", "null", "[[1, 2], 3]",
     "\x00", "- ", 'b"x"', "</a>", "!!opencv-matrix", "9" * 400, "9" * 5000,
     "[" * 2000]
)  # fmt: skip


STORAGES = ("yaml", "xml", "json")


@given(
    st.sampled_from([*WRITTEN_BY_OTHERS, *STORAGES]),
    st.integers(0),
    st.sampled_from([0, 1, 5, 40]),
    JUNK,
)
def test_whatever_a_file_holds_is_read_or_refused(kind: str, at: int, cut: int, junk: str) -> None:
    name, text = ("any", storage(kind)) if kind in STORAGES else WRITTEN_BY_OTHERS[kind][:2]
    at %= len(text)
    with TemporaryDirectory() as folder:
        path = Path(folder) / name
        path.write_text(text[:at] + junk + text[at + cut :])
        with suppress(CalibrationFileError):
            if kind in STORAGES:
                read_nodes(path, NODES)
            else:
                [camera() for camera in RIG_FORMATS.find(kind).read(path).values()]


def test_a_colmap_model_whose_names_are_no_text_is_refused(tmp_path: Path) -> None:
    """Found by `python -m benchmarks.fuzz`: a model read well, and then its names did not."""
    form = RIG_FORMATS.find("colmap")
    folder = form.write(ring(), tmp_path / form.path)
    named = next(path for path in sorted(folder.glob("images.*")))
    named.write_bytes(named.read_bytes().replace(b"p1-1", b"\x85\xff-1"))
    with pytest.raises(CalibrationFileError, match="is not a COLMAP model"):
        form.read(folder)
