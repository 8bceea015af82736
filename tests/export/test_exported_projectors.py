"""A pair written for another program and imported again from there: the same rays, the same sheets."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from real_captures import real_rig_file

from bodyscan.arrays import Array
from bodyscan.calibration.pair import PairCalibration, PairQuality
from bodyscan.calibration.projector_camera import sheets_from_projector
from bodyscan.export.rig import export_rig, fit_projectors
from bodyscan.geometry.camera import Camera
from bodyscan.geometry.lens_sheets import LensSheets
from bodyscan.geometry.lenses import lens_from_opencv
from bodyscan.geometry.lenses.opencv import Radial
from bodyscan.geometry.light_planes import LightSheets
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.geometry.uncertainty import PoseCovariance
from bodyscan.interchange.rig_format import RIG_FORMATS
from bodyscan.registration.rig_calibration import RigCalibration
from bodyscan.rig.rig import Rig, load_rig
from bodyscan.workflows.import_rig import import_rig

PROJECTOR_FROM_CAMERA = RigidTransform.from_rotation_vector([0.02, 0.2, 0.01], [-210.0, 5.0, -20.0])
RADIAL, LONG = np.array([-0.05, 0.3, 1e-3, -2e-3, 0.0]), np.array([-0.05, 1.4, -7e-3, -2e-3, -7.3])
STORED_MM, STORED_STRIPES = 1e-7, 1e-6
"""What is left of a fit that is exact, in one of the scanner's 1000 mm and stripes."""


def describe_rig(form: str | None) -> Rig:
    """Two pairs; with a format they are known from what was written in it."""
    projector = {"code": "gray", "stripes": 1280, "direction": "vertical"}
    pair: dict[str, Any] = {
        "camera": {"width": 1280, "height": 1024},
        "projector": {**projector, "crossing": {"stripes": 800}},
    }
    pairs = []
    for name in ("a", "b"):
        content = {"name": name, **pair}
        if form is not None:
            known = {"file": RIG_FORMATS.find(form).path, "format": form}
            names = {"camera": {"name": name}, "projector": {"name": f"{name}-projector"}}
            unit = {} if RIG_FORMATS.find(form).unit else {"units": "mm"}
            content["known"] = {**known, **names, **unit}
        pairs.append(content)
    return Rig.model_validate({"name": "two", "pairs": pairs})


def calibrate(lens: Array) -> RigCalibration:
    camera = Camera(1400.0, 1410.0, 0.0, 640.0, 500.0, Radial(-0.1, 0.05), 1280, 1024)
    light = Camera(1650.0, 1720.0, 0.0, 622.0, 763.0, lens_from_opencv(lens), 1280, 800)
    middle = np.array([0.0, 0.0, 1000.0])
    columns = sheets_from_projector(light, PROJECTOR_FROM_CAMERA, middle, 1280, "vertical")
    rows = sheets_from_projector(light, PROJECTOR_FROM_CAMERA, middle, 800, "horizontal")
    quality = PairQuality(0.1, 9)
    pairs = {
        name: PairCalibration(name, camera, np.eye(7), columns, quality, rows)
        for name in ("a", "b")
    }
    poses = {
        "a": RigidTransform.identity(),
        "b": RigidTransform.from_rotation_vector([0.0, 1.2, 0.1], [-900.0, 20.0, 500.0]),
    }
    covariance = PoseCovariance(("a", "b"), np.eye(12))
    return RigCalibration(describe_rig(None), pairs, poses, covariance, {}, {}, ())


def stripes_of(sheets: LightSheets | None, points: Array) -> Array:
    assert isinstance(sheets, LensSheets)
    return sheets.stripe(points)


def assert_same(found: RigCalibration, wanted: RigCalibration) -> None:
    points = np.random.default_rng(5).uniform([-200, -150, 800], [200, 150, 1200], (200, 3))
    for name, pair in wanted.pairs.items():
        again = found.pairs[name]
        pixels = pair.camera.project(points)
        np.testing.assert_allclose(again.camera.rays(pixels), pair.camera.rays(pixels), atol=1e-9)
        for now, before in ((again.sheets, pair.sheets), (again.crossing, pair.crossing)):
            s = stripes_of(now, points)
            np.testing.assert_allclose(s, stripes_of(before, points), rtol=0, atol=STORED_STRIPES)


@pytest.mark.parametrize("form", RIG_FORMATS.names())
def test_an_exported_rig_is_imported_unchanged(tmp_path: Path, form: str) -> None:
    wanted = calibrate(RADIAL)
    exported = export_rig(wanted, tmp_path, [form])
    assert [note.split(",")[0] for note in exported.notes[:2]] == [
        f"{name}: its projector is written as a camera" for name in ("a", "b")
    ]
    found = import_rig(describe_rig(form), tmp_path)
    assert not found.failed
    assert_same(found, wanted)
    a_from_b = [c.rig_from_camera["a"].inverse() @ c.rig_from_camera["b"] for c in (found, wanted)]
    np.testing.assert_allclose(a_from_b[0].matrix, a_from_b[1].matrix, rtol=0, atol=STORED_MM)


def test_a_first_code_that_may_have_been_forgotten_is_noted() -> None:
    """1280 of 2048 columns and 800 of 1024 rows leave open where they begin."""
    notes = fit_projectors(calibrate(RADIAL)).notes
    found = [note for note in notes if note.startswith("a, b: the first of")]
    assert len(found) == 2
    assert "1280 vertical stripes is taken to have code 0 of 2048" in found[0]
    assert "such as 112 where they lie in the middle, give `first_code`" in found[1]


def test_kalibr_leaves_out_a_projector_whose_lens_it_cannot_express(tmp_path: Path) -> None:
    wanted = calibrate(LONG)
    exported = export_rig(wanted, tmp_path, ["kalibr", "opencv"])
    refused = [note for note in exported.notes if "camchain.yaml" in note]
    assert refused == [
        f"{name}-projector is not in camchain.yaml: Kalibr has no lens like 'brown': its radtan ends "
        "with k1, k2, p1, p2"
        for name in ("a", "b")
    ]
    assert sorted(RIG_FORMATS.find("kalibr").read(exported.value[0])) == ["a", "b", "cam0", "cam1"]
    assert_same(import_rig(describe_rig("opencv"), tmp_path), wanted)


def test_opencv_s_projector_pose_is_that_of_stereo_calibrate(tmp_path: Path) -> None:
    """R and T below `projector` take the camera's coordinates to the projector's."""
    (path,) = export_rig(calibrate(RADIAL), tmp_path, ["opencv"]).value
    store = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    node = store.getNode("pairs").at(1).getNode("projector")
    np.testing.assert_allclose(
        node.getNode("R").mat(), PROJECTOR_FROM_CAMERA.rotation, rtol=0, atol=1e-9
    )
    np.testing.assert_allclose(
        node.getNode("T").mat()[:, 0], PROJECTOR_FROM_CAMERA.translation, rtol=0, atol=1e-6
    )
    lens = node.getNode("distortion_coefficients").mat().ravel()
    np.testing.assert_allclose(lens, RADIAL, rtol=0, atol=1e-8)


def test_a_camera_alone_and_a_name_that_is_taken() -> None:
    wanted = calibrate(RADIAL)
    pairs = {
        "a": wanted.pairs["a"],
        "a-projector": replace(wanted.pairs["b"], sheets=None, crossing=None),
    }
    poses = {"a": wanted.rig_from_camera["a"], "a-projector": wanted.rig_from_camera["b"]}
    found = fit_projectors(replace(wanted, pairs=pairs, rig_from_camera=poses))
    assert not found.value
    assert found.notes == (
        "a: its projector is left out: another pair is named a-projector already\n"
        "  rename that pair",
    )


def test_a_real_pair_comes_back(captures: Path, tmp_path: Path) -> None:
    """gray-jpeg's own calibration, through OpenCV's file: what its pixels and stripes say stays."""
    rig_file = real_rig_file("gray-jpeg", captures, tmp_path)
    rig = load_rig(rig_file)
    wanted = import_rig(rig, rig_file.parent)
    export_rig(wanted, tmp_path / "out", ["opencv"])
    content = json.loads(rig.model_dump_json(exclude_none=True))
    content["pairs"][0]["known"] = {
        "file": "rig-opencv.yaml",
        "format": "opencv",
        "projector": {"name": "sltk-projector"},
    }
    found = import_rig(Rig.model_validate(content), tmp_path / "out")
    points = np.random.default_rng(5).uniform([-100, -100, 450], [100, 100, 700], (200, 3))
    again, before = found.pairs["sltk"], wanted.pairs["sltk"]
    pixels = before.camera.project(points)
    np.testing.assert_allclose(again.camera.rays(pixels), before.camera.rays(pixels), atol=1e-9)
    for now, then in ((again.sheets, before.sheets), (again.crossing, before.crossing)):
        s = stripes_of(now, points)
        np.testing.assert_allclose(s, stripes_of(then, points), rtol=0, atol=STORED_STRIPES)
