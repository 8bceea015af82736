"""Calibrations made elsewhere become normal ones: from made-up files with known truth, and the real."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import open3d as o3d
import pytest
from real_captures import real_rig_file
from ring import looking_at
from scipy.spatial import cKDTree
from typer.testing import CliRunner

import bodyscan
from bodyscan.arrays import Array, Mask
from bodyscan.cli.main import app
from bodyscan.errors import BadInput, CalibrationFileError, RigFileError
from bodyscan.geometry.lens_sheets import LensSheets
from bodyscan.geometry.light_sheets import triangulate_image
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.registration.calibration_verdict import grade_calibration
from bodyscan.registration.rig_calibration import RigCalibration
from bodyscan.registration.storage import load_calibration
from bodyscan.rig.rig import load_rig
from bodyscan.workflows.check_rig import BoardCheck, check_rig
from bodyscan.workflows.import_rig import import_folder, import_rig

CAMERA = np.array([[1400.0, 0.0, 630.0], [0.0, 1404.0, 500.0], [0.0, 0.0, 1.0]])
CAMERA_LENS = np.array([-0.2, 0.1, 1e-3, -5e-4, 0.02])
LIGHT = np.array([[1500.0, 0.0, 510.0], [0.0, 1490.0, 700.0], [0.0, 0.0, 1.0]])
LIGHT_LENS = np.array([-0.05, 0.2, -2e-3, 1e-3, -0.3])
SIZES = {"camera": (1280, 1024), "light": (1024, 768)}
WORLD_FROM = {
    "a": looking_at([1000.0, 200.0, 900.0], [0.0, 0.0, 800.0]),
    "b": looking_at([-900.0, 500.0, 1100.0], [0.0, 0.0, 900.0]),
}
LIGHT_FROM_CAMERA = RigidTransform.from_rotation_vector([0.02, -0.25, 0.01], [210.0, 5.0, -20.0])
PAIR: dict[str, Any] = {
    "camera": {"width": 1280, "height": 1024},
    "projector": {"code": "gray", "stripes": 512, "direction": "vertical"},
}


def rotations_and_shifts(pair: str) -> dict[str, RigidTransform]:
    camera = WORLD_FROM[pair].inverse()
    return {"camera": camera, "light": LIGHT_FROM_CAMERA @ camera}


def write_storage(path: Path, *, millimetres: float = 1.0) -> None:
    """Cameras and projectors of both pairs with OpenCV, in a unit of so many millimetres."""
    store = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for pair in WORLD_FROM:
        for what, matrix, lens in (("camera", CAMERA, CAMERA_LENS), ("light", LIGHT, LIGHT_LENS)):
            pose = rotations_and_shifts(pair)[what]
            store.write(f"K_{what}_{pair}", matrix)
            store.write(f"D_{what}_{pair}", lens)
            store.write(f"S_{what}_{pair}", np.array(SIZES[what]))
            store.write(f"R_{what}_{pair}", pose.rotation)
            store.write(f"T_{what}_{pair}", pose.translation / millimetres)
    store.release()


def nodes(what: str, pair: str) -> dict[str, str]:
    keys = ("matrix", "distortion", "size", "rotation", "translation")
    return {key: f"{node}_{what}_{pair}" for key, node in zip(keys, "KDSRT", strict=True)}


def described(*pairs: str, **changed: Any) -> dict[str, Any]:
    """A rig file of these pairs."""
    known = {
        pair: {"file": "foreign.yaml", "format": "opencv", "units": "mm"}
        | {"camera": nodes("camera", pair), "projector": nodes("light", pair)}
        for pair in pairs
    }
    own = [{"name": pair, "known": known[pair], **PAIR} for pair in pairs]
    return {"name": "imported", "pairs": own, **changed}


def write_rig_file(folder: Path, content: dict[str, Any]) -> Path:
    path = folder / "rig.yaml"
    path.write_text(json.dumps(content, indent=1))
    return path


def imported(folder: Path, content: dict[str, Any]) -> RigCalibration:
    return import_rig(load_rig(write_rig_file(folder, content)), folder)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    write_storage(tmp_path / "foreign.yaml")
    return tmp_path


def stripes_seen(points: Array, pair: str) -> tuple[Array, Array]:
    """Where OpenCV sees points (N, 3) of the world in the camera, px, and their stripes."""
    seen = {}
    for what, matrix, lens in (("camera", CAMERA, CAMERA_LENS), ("light", LIGHT, LIGHT_LENS)):
        pose = rotations_and_shifts(pair)[what]
        rotation, shift = cv2.Rodrigues(pose.rotation)[0], pose.translation
        seen[what] = cv2.projectPoints(points, rotation, shift, matrix, lens)[0][:, 0]
    return seen["camera"], (seen["light"][:, 0] + 0.5) / 2.0  # 1024 px are 512 stripes


def test_what_is_scanned_lies_where_it_is(folder: Path) -> None:
    """Points of the world as OpenCV projects them into camera and projector come back."""
    rig_file = write_rig_file(folder, described("a", "b"))
    _, saved = import_folder(rig_file, folder / "calibration")
    calibration = load_calibration(saved)
    points = np.random.default_rng(1).uniform([-200, -200, 700], [200, 200, 1100], (400, 3))
    for name, pair in calibration.pairs.items():
        pixels, s = stripes_seen(points, name)
        assert isinstance(pair.sheets, LensSheets)
        rays = pair.camera.rays(pixels)
        depth, _, _ = pair.sheets.intersect(rays, s)
        found = calibration.rig_from_camera[name].apply(rays * depth[:, None])
        shown = (s > 0) & (s < 512)
        assert shown.sum() > 200
        np.testing.assert_allclose(found[shown], points[shown], rtol=0, atol=1e-6)
    assert calibration.covariance.names == ("a", "b")


@pytest.mark.parametrize(
    ("what", "node", "value", "said"),
    [
        # No ray anywhere, and no numpy warning.
        ("distortion", "D", np.array([-9.0, 0, 0, 0, 0]), r"odd.yaml.*not invertible within"),
        ("size", "S", np.array(SIZES["camera"]), "principal point"),
    ],
)
def test_a_lens_or_an_axis_that_is_not_the_cameras_is_named(
    folder: Path, what: str, node: str, value: Array, said: str
) -> None:
    matrix = CAMERA.copy()
    if what == "size":
        matrix[0, 2] = 5000.0
    store = cv2.FileStorage(str(folder / "odd.yaml"), cv2.FILE_STORAGE_WRITE)
    store.write("K", matrix)
    store.write(node, value)
    store.release()
    content = described("a")
    known = content["pairs"][0]["known"]
    known |= {"camera": {"matrix": "K", what: node}, "file": "odd.yaml"}
    known["projector"]["file"] = "foreign.yaml"
    with pytest.raises(CalibrationFileError, match=said):
        imported(folder, content)


def test_python_users_import_too(folder: Path) -> None:
    rig_file = write_rig_file(folder, described("a"))
    found = bodyscan.import_calibration(rig_file, sigma_px=0.5)
    assert found.pairs["a"].quality.imported_sigma_px == 0.5
    bodyscan.save_calibration(found, folder / "kept")
    assert bodyscan.load_calibration(folder / "kept").pairs["a"].camera == found.pairs["a"].camera


def test_units_and_inverse_poses(folder: Path) -> None:
    write_storage(folder / "foreign.yaml", millimetres=10.0)
    content = described("a", "b")
    for pair in content["pairs"]:
        pair["known"]["units"] = "cm"
    there = imported(folder, content)
    for name, pose in WORLD_FROM.items():
        np.testing.assert_allclose(there.rig_from_camera[name].matrix, pose.matrix, atol=1e-9)
        content["pairs"][0]["known"]["camera"]["inverse"] = True
    back = imported(folder, content)
    expected = WORLD_FROM["a"].inverse().matrix
    np.testing.assert_allclose(back.rig_from_camera["a"].matrix, expected, atol=1e-9)
    del content["pairs"][0]["known"]["units"]
    with pytest.raises(CalibrationFileError, match=r"unit") as caught:
        imported(folder, content | {"pairs": content["pairs"][:1]})
    assert "units: mm" in caught.value.remedy


def test_the_rig_frame_is_as_the_rig_file_says(folder: Path) -> None:
    content = described("a", "b", rig_frame={"pair": "b"})
    found = imported(folder, content)
    np.testing.assert_allclose(found.rig_from_camera["b"].matrix, np.eye(4), atol=1e-12)
    relative = WORLD_FROM["b"].inverse() @ WORLD_FROM["a"]
    np.testing.assert_allclose(found.rig_from_camera["a"].matrix, relative.matrix, atol=1e-9)
    assert found.axes.startswith("that of camera b: x to")
    content = described("a", "b")
    content["pairs"][0]["nominal"] = {"position_mm": [0, 0, 500], "look_at_mm": [100, 0, 500]}
    found = imported(folder, content)
    np.testing.assert_allclose(found.rig_from_camera["a"].translation, [0, 0, 500])
    assert found.axes.startswith("origin on the floor")
    board = {"name": "b", "columns": 9, "rows": 6, "square_mm": 10}
    content = described("a", rig_frame={"shot": "floor"}, boards=[board])
    with pytest.raises(BadInput, match="the rig frame is to be fixed by a board"):
        imported(folder, content)


def test_a_pair_that_cannot_be_read_costs_that_pair(folder: Path) -> None:
    content = described("a", "b")
    content["pairs"][1]["known"]["camera"]["matrix"] = "K_camera_c"
    found = imported(folder, content)
    assert list(found.pairs) == ["a"]
    assert "did you mean 'K_camera_" in found.failed["b"]
    assert grade_calibration(found).reasons[0].startswith("failed: b")
    content["pairs"] = content["pairs"][1:]
    with pytest.raises(CalibrationFileError, match="K_camera_c"):
        imported(folder, content)


def test_the_only_camera_without_a_pose_is_the_world(folder: Path) -> None:
    """Two cameras as stereoCalibrate gives them: R and T are the second's, from the first."""
    content = json.loads(json.dumps(described("a", "b")))
    for pair in content["pairs"]:
        del pair["projector"], pair["known"]["projector"]
    first = content["pairs"][0]["known"]["camera"]
    pose = {key: first.pop(key) for key in ("rotation", "translation")}
    found = imported(folder, content)
    assert not found.failed
    np.testing.assert_array_equal(found.rig_from_camera["a"].matrix, np.eye(4))
    np.testing.assert_allclose(found.rig_from_camera["b"].matrix, WORLD_FROM["b"].matrix, atol=1e-9)
    for key in pose:
        del content["pairs"][1]["known"]["camera"][key]
    with pytest.raises(CalibrationFileError, match="all but one of a rig"):
        imported(folder, content)


def test_a_projector_may_be_the_world_and_a_pose_in_a_file_of_its_own(folder: Path) -> None:
    content, poses = json.loads(json.dumps(described("a"))), rotations_and_shifts("a")
    known, camera_from_light = (
        content["pairs"][0]["known"],
        poses["camera"] @ poses["light"].inverse(),
    )
    store = cv2.FileStorage(str(folder / "poses.yaml"), cv2.FILE_STORAGE_WRITE)
    store.write("R", camera_from_light.rotation)
    store.write("T", camera_from_light.translation)
    store.release()
    known["camera"] |= {"rotation": "R", "translation": "T", "pose_file": "poses.yaml"}
    del known["projector"]["rotation"], known["projector"]["translation"]
    found, expected = (imported(folder, one).pairs["a"].sheets for one in (content, described("a")))
    assert isinstance(found, LensSheets)
    assert isinstance(expected, LensSheets)
    difference = found.projector_from_camera.inverse() @ expected.projector_from_camera
    np.testing.assert_allclose(difference.matrix, np.eye(4), atol=1e-9)


@pytest.mark.parametrize(
    ("where", "value", "said"),
    [
        (("camera", "width"), 640, r"1280 x 1024 px, the rig file says 640 x 1024"),
        (("projector", "stripes"), 1100, r"1024 x 768 px, which 1100 vertical stripes do not"),
        (("known", "projector", "rotation"), "K_light_a", r"K_light_a: is not a rotation"),
        (("known", "camera", "distortion"), "S_light_a", None),
        (("known", "file"), "nowhere.yaml", r"there is no such file"),
    ],
)
def test_what_is_wrong_is_named(
    folder: Path, where: tuple[str, ...], value: object, said: str | None
) -> None:
    content = json.loads(json.dumps(described("a")))
    inside = content["pairs"][0]
    for part in where[:-1]:
        inside = inside[part]
    inside[where[-1]] = value
    if said is None:  # two numbers are a lens with k1 and k2: nobody can tell
        assert imported(folder, content).pairs["a"].camera.lens.opencv()[0] == 1024.0
        return
    with pytest.raises(CalibrationFileError, match=said):
        imported(folder, content)


@pytest.mark.parametrize(("millimetres", "units"), [(1.0, "m"), (1000.0, "mm")])
def test_an_implausible_baseline_names_the_unit(
    tmp_path: Path, millimetres: float, units: str
) -> None:
    """211 mm for metres and the other way round."""
    write_storage(tmp_path / "foreign.yaml", millimetres=millimetres)
    content = described("a")
    content["pairs"][0]["known"]["units"] = units
    said = r"puts the projector (2.11e\+05|0.211) mm"
    with pytest.raises(CalibrationFileError, match=said) as found:
        imported(tmp_path, content)
    assert f"its lengths are not in {units}" in found.value.what


def test_a_mirrored_or_endless_pose_is_named(folder: Path) -> None:
    text = (folder / "foreign.yaml").read_text()
    mirrored = np.diag([1.0, -1.0, 1.0]) @ rotations_and_shifts("a")["light"].rotation
    store = cv2.FileStorage(str(folder / "mirrored.yaml"), cv2.FILE_STORAGE_WRITE)
    store.write("R_light_a", mirrored)
    store.release()
    content = described("a")
    content["pairs"][0]["known"]["projector"]["file"] = "mixed.yaml"
    own = (folder / "mirrored.yaml").read_text().partition("---\n")[2]
    (folder / "mixed.yaml").write_text(text.replace("R_light_a:", "unused:") + own)
    with pytest.raises(CalibrationFileError, match=r"mixed.yaml:\d+: R_light_a: is a reflection"):
        imported(folder, content)
    number = re.compile(r"(T_light_a:.*?data: \[ )[^,]*", re.DOTALL)
    (folder / "mixed.yaml").write_text(number.sub(r"\1.Inf", text))
    with pytest.raises(CalibrationFileError, match=r"mixed.yaml:\d+: T_light_a: .* not finite"):
        imported(folder, content)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"format": "opencvv"}, r"rig.yaml:\d+:\d+: pairs\[0\].known.format: .*mean 'opencv'"),
        ({"units": "inch"}, r"pairs\[0\].known.units: must be 'mm', 'cm' or 'm'"),
        ({"format": "kalibr"}, r"pairs\[0\].known.camera.matrix: is for format: opencv"),
        ({"sigma_px": 0}, r"pairs\[0\].known.sigma_px: must be greater than 0"),
        ({"camera": {"distortion": "D"}}, r"pairs\[0\].known.camera.matrix: is missing"),
        ({"camera": {"matrix": "K", "rotation": "R"}}, r"known.camera.translation: is missing"),
        ({"camera": {"matrix": "K", "name": "a"}}, r"known.camera.name: is for files that name"),
        ({"camera": {"matrix": "K", "width": "w"}}, r"known.camera.height: is missing"),
        ({"camera": {"matrix": "K", "size": "s", "width": "w", "height": "h"}}, r"is said twice"),
        ({"camera": {"matrx": "K"}}, r"known.camera.matrx: is not a key.*did you mean 'matrix'"),
        ({"projector": {}}, r"known.projector: does not say which"),
        ({}, r"known.projector: needs a projector"),  # which the pair does not have
    ],
)
def test_wrong_keys_are_named_with_their_line(
    folder: Path, change: dict[str, Any], said: str
) -> None:
    content = json.loads(json.dumps(described("a")))
    content["pairs"][0]["known"] |= change
    if not change:
        content["pairs"][0]["projector"] = None
    with pytest.raises(RigFileError, match=said):
        load_rig(write_rig_file(folder, content))


def test_how_exact_it_is_is_not_made_up(folder: Path) -> None:
    rig = load_rig(write_rig_file(folder, described("a")))
    unknown = import_rig(rig, folder)
    assert grade_calibration(unknown).grade == "not judged"
    assert "is not known" in unknown.notes[0]
    assert unknown.pairs["a"].quality.unjudged
    stated = import_rig(rig, folder, 0.4)
    assert grade_calibration(stated).grade == "good"
    assert not stated.pairs["a"].quality.unjudged
    pair = stated.pairs["a"]
    assert isinstance(pair.sheets, LensSheets)
    shape = pair.camera.height, pair.camera.width
    s, sigma = np.full(shape, 200.0, np.float32), np.zeros(shape, np.float32)
    points, along, _ = triangulate_image(pair.sheets, pair.camera, s, sigma)
    seen = np.isfinite(along)
    # No boards were seen, so that there is no place that is far from them: all of it has a sigma.
    plain = unknown.pairs["a"].sheets
    assert plain is not None
    _, without, _ = triangulate_image(plain, pair.camera, s, sigma)
    np.testing.assert_array_equal(seen, np.isfinite(without))
    rays = points[seen][::1000].astype(float)
    rays /= rays[:, 2:]
    _, per_stripe, _ = pair.sheets.intersect(rays, np.full(len(rays), 200.0))
    expected = 0.4 / 2.0 * np.abs(per_stripe) * np.linalg.norm(rays, axis=1)  # 2 px a stripe
    np.testing.assert_allclose(along[seen][::1000], expected, rtol=1e-3)


def test_the_command_makes_a_calibration_folder(folder: Path) -> None:
    rig_file = write_rig_file(folder, described("a"))
    done = CliRunner().invoke(app, ["import", str(rig_file), "--out", str(folder / "out")])
    assert done.exit_code == 0, done.output
    assert "its accuracy is not known" in done.output.replace("\n", " ")
    assert load_calibration(folder / "out").pairs["a"].quality.imported == "foreign.yaml (opencv)"
    report = CliRunner().invoke(app, ["report", str(folder / "out")])
    assert report.exit_code == 0, report.output
    assert "not judged" in report.output
    text = (folder / "out" / "report.html").read_text("utf-8")
    assert "left out" not in text
    assert "This calibration was imported: no image of a board was read" in text
    assert "calibrate again" not in text
    assert "There is no map: the accuracy of the imported calibration of a is not known" in text
    assert "Rig frame: that of the imported files, wherever it lies." in text
    drawn = CliRunner().invoke(app, ["sigma-map", str(folder / "out")])
    assert "is not known" in str(drawn.exception)
    export = ["export-rig", str(folder / "out"), "--out", str(folder / "rig"), "--format", "kalibr"]
    assert "Kalibr has no lens like 'brown'" in str(CliRunner().invoke(app, export).exception)
    export[-1] = "mrcal,aniposelib"
    assert CliRunner().invoke(app, export).exit_code == 0


def test_the_check_of_a_rig_file_reads_what_is_known(folder: Path) -> None:
    content = described("a")
    checked = CliRunner().invoke(app, ["check", str(write_rig_file(folder, content))])
    assert checked.exit_code == 0, checked.output
    content["pairs"][0]["known"]["camera"]["matrix"] = "K"
    checked = CliRunner().invoke(app, ["check", str(write_rig_file(folder, content))])
    assert checked.exit_code == 2
    assert "has no node 'K'" in checked.output


def gray_code(folder: Path, axis: str, bits: int) -> tuple[Array, Mask]:
    """The plain decoding of `gray-jpeg`: signs of pattern less inverse; where every one of them is
    told by 5 grey levels or more."""
    number: Any = 0
    last: Any = 0
    told: Any = True
    for bit in reversed(range(bits)):
        images = [
            cv2.imread(str(next(folder.glob(f"*_[[]{axis}-{bit:02}-{way}_*.jpg"))), 0).astype(int)
            for way in ("00", "01")
        ]
        last = last ^ (images[0] > images[1])
        number, told = 2 * number + last, told & (np.abs(images[0] - images[1]) >= 5)
    return number, told


@pytest.mark.slow
def test_a_real_scan_lies_on_the_cloud_that_came_with_it(captures: Path, tmp_path: Path) -> None:
    """By the imported calibration alone: decoded plainly, a pixel of the projector is told to half
    of itself at best, which is 0.1 mm there."""
    rig_file = real_rig_file("gray-jpeg", captures, tmp_path)
    pair = import_rig(load_rig(rig_file), tmp_path).pairs["sltk"]
    folder = captures / "gray-jpeg"
    number, told = gray_code(folder / "scan_0020", "00", 11)
    assert pair.sheets is not None
    # Code 0 is the projector's column 0, and the middle of that lies at s = 1/2.
    s = np.where(told, number + 0.5, np.nan).astype(np.float32)
    points, sigma, _ = triangulate_image(pair.sheets, pair.camera, s, np.full_like(s, 0.3))
    found = points[np.isfinite(sigma)].astype(float)
    assert len(found) > 0.99 * told.sum()
    cloud = o3d.io.read_point_cloud(str(folder / "scan_0020_cloud.ply"))
    theirs = np.asarray(cloud.points) * [1.0, -1.0, -1.0]
    assert np.median(cKDTree(found).query(theirs[::20])[0]) < 0.11
    # Half a projector pixel beside it would be 0.4 mm in depth.
    pixels = np.round(pair.camera.project(theirs)).astype(int)
    depth = points[pixels[:, 1], pixels[:, 0], 2]
    assert abs(np.nanmedian(depth - theirs[:, 2])) < 0.05
    assert pair.crossing is not None
    assert (pair.crossing.direction, pair.crossing.stripes) == ("horizontal", 800)


@pytest.mark.slow
def test_the_other_real_calibration_is_read_and_held_against_a_board(
    captures: Path, tmp_path: Path
) -> None:
    rig_file = real_rig_file("two-frequency", captures, tmp_path)
    calibration = import_rig(load_rig(rig_file), tmp_path)
    pair = calibration.pairs["slstudio"]
    assert pair.camera.alpha == pytest.approx(2195.12036)
    assert isinstance(pair.sheets, LensSheets)
    assert isinstance(pair.crossing, LensSheets)
    # What the middle pixel sees half a metre or so away, columns and rows alike.
    ray = pair.camera.rays(np.array([[843.5, 675.5]]))
    for sheets in (pair.sheets, pair.crossing):
        s = sheets.stripe(ray * 600.0)
        assert 0 < s[0] < sheets.stripes
        assert sheets.intersect(ray, s)[0] == pytest.approx(600.0, rel=1e-9)
    # One pair alone, one board: a pose of the projector by its corners is 0.3 degrees from the file's.
    shots = tmp_path / "shots"
    shutil.copytree(captures / "two-frequency" / "calseq1", shots / "calseq1")
    (shots / "captures.yaml").write_text("version: 1\nkind: calibration\n")
    found = check_rig(calibration, [shots])
    assert not found.valid
    assert isinstance(found, BoardCheck)
    (offset,) = found.stripes
    assert 0.4 < max(abs(offset.offset_mm), abs(offset.tilt_mm)) < 1.5
    assert "calibration.xml (opencv) is not its calibration" in " ".join(found.lines)
