"""Corners found elsewhere, in a corners.vnl, calibrate a rig of which no image is there."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from ring import board_poses, ring_of_cameras
from small_workspace import run

from bodyscan.arrays import Array
from bodyscan.boards.board_layout import corner_points
from bodyscan.captures.check import check
from bodyscan.errors import BodyscanError, CaptureError
from bodyscan.files.corners_vnl import Corners, read_corners, write_corners
from bodyscan.rig.board import Board
from bodyscan.workflows.calibrate_rig import calibrate_folder

BOARD = Board(name="board", columns=10, rows=7, square_mm=60)
GRID = (6, 9, 2)


def seen_corners(noise_px: float = 0.03) -> dict[str, Array]:
    """What three cameras of one pole see of twelve boards, by an image's name."""
    placings, cameras = ring_of_cameras(poles=1, heights=(700, 1000, 1300))
    rng = np.random.default_rng(3)
    forward = placings["p1-2"].rotation[:, 2]
    found = {}
    for number, pose in enumerate(board_poses(60, rng)):
        for name, camera in cameras.items():
            camera_from_board = placings[name].inverse() @ pose
            ahead = float(camera_from_board.rotation[:, 2] @ (placings[name].rotation.T @ forward))
            pixels = camera.project(camera_from_board.apply(corner_points(BOARD)))
            inside = np.all((pixels > 5) & (pixels < [1275, 1019]))
            if ahead > 0.4 and inside:
                found[f"/elsewhere/{name}/s{number:02}.png"] = pixels + rng.normal(
                    0.0, noise_px, pixels.shape
                )
    return found


def as_listed(found: dict[str, Array]) -> Iterator[tuple[str, Corners]]:
    for name, corners in found.items():
        yield name, tuple((float(x), float(y)) for x, y in corners)


def rig_file(folder: Path, text: str = "corners.vnl") -> Path:
    rig = {
        "name": "given",
        "boards": [BOARD.model_dump(exclude_none=True, exclude_defaults=True)],
        "pairs": [
            {"name": f"p1-{k}", "camera": {"width": 1280, "height": 1024, "lens": "radial"}}
            for k in (1, 2, 3)
        ],
        "calibration": [{"folder": "images", "corners": text}],
        "files": "{pair}/{shot}.png",
        "rig_frame": {"pair": "p1-1"},
    }
    path = folder / "rig.yaml"
    path.write_text(yaml.safe_dump(rig), "utf-8")
    return path


def test_a_rig_is_calibrated_without_its_images_and_again_from_what_it_wrote(
    tmp_path: Path,
) -> None:
    found = seen_corners()
    # Another program may run along rows from the other side; not one corner of one image is known.
    some = list(found)
    found[some[0]] = found[some[0]].reshape(GRID)[:, ::-1].reshape(-1, 2)
    found[some[1]] = np.vstack([[np.nan, np.nan], found[some[1]][1:]])
    found["/elsewhere/p1-1/s99.png"] = np.empty((0, 2))
    write_corners(tmp_path / "corners.vnl", as_listed(found))
    path = rig_file(tmp_path)
    report = check(path)
    assert report.ok, report.errors
    calibration, _ = calibrate_folder(path, tmp_path / "first")
    placings, _ = ring_of_cameras(poles=1, heights=(700, 1000, 1300))
    true = placings["p1-1"].inverse() @ placings["p1-3"]
    # 0.03 px of noise at 1.3 m with a focal length of 1500 px is 0.03 mm a corner; what twelve or
    # more boards leave of the baseline is known to some tenths of a millimetre.
    assert np.allclose(calibration.rig_from_camera["p1-3"].translation, true.translation, atol=1.0)
    assert (
        sum(view.poses for view in (p.quality for p in calibration.pairs.values()))
        == len(found) - 1
    )
    again = tmp_path / "again"
    again.mkdir()
    second, _ = calibrate_folder(rig_file(again, "../first/corners.vnl"), again / "second")
    # Six decimals of a pixel are kept.
    assert np.allclose(
        second.rig_from_camera["p1-3"].matrix, calibration.rig_from_camera["p1-3"].matrix, atol=1e-4
    )


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "holds no corner"),
        ("a.png 1 2 0\n", ":1"),
        ("# filename x\na.png 1\n", "has the columns filename x"),
        ("# filename x y level\na.png 1\n", ":2"),
        ("# filename x y level\na.png 1 two 0\n", "not an image and a corner: a.png 1 two 0"),
        ("# filename x y level\na.png 1 inf 0\n", "not an image and a corner"),
    ],
)
def test_a_wrong_line_is_named(tmp_path: Path, text: str, said: str) -> None:
    path = tmp_path / "corners.vnl"
    path.write_text(text)
    with pytest.raises(CaptureError) as caught:
        read_corners(path)
    assert said in str(caught.value)
    assert str(path) in str(caught.value)


def test_too_few_corners_and_such_as_lie_outside_are_named(tmp_path: Path) -> None:
    found = seen_corners()
    some = list(found)
    found[some[0]] = found[some[0]][:50]
    found[some[1]] = found[some[1]] + 3000.0
    write_corners(tmp_path / "corners.vnl", as_listed(found))
    calibration, _ = calibrate_folder(rig_file(tmp_path), tmp_path / "out")
    notes = "\n".join(calibration.notes)
    assert "has 50 corners, but board board has 54" in notes
    assert "has corners outside of 1280 x 1024 px" in notes


@settings(max_examples=200, deadline=None)
@given(st.text(alphabet="# filename x y level\n\t0123456789.-einfa/", max_size=200))
def test_whatever_lies_there_is_read_or_refused(text: str) -> None:
    import tempfile

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "corners.vnl"
        path.write_text("# filename x y level\n" + text)
        try:
            found = read_corners(path)
        except BodyscanError:
            return
        assert all(len(corner) == 2 for corners in found.values() for corner in corners)


@pytest.mark.parametrize(("noise_px", "grade"), [(0.03, "usable"), (2.0, "recalibrate")])
def test_a_calibration_ends_in_a_verdict_that_the_exit_code_repeats(
    tmp_path: Path, noise_px: float, grade: str
) -> None:
    write_corners(tmp_path / "corners.vnl", as_listed(seen_corners(noise_px)))
    done = run("calibrate-rig", rig_file(tmp_path), "--json")
    told = json.loads(done.stdout)
    assert told["verdict"]["grade"] == grade, told["verdict"]
    assert done.exit_code == told["exit_code"] == (1 if grade == "recalibrate" else 0)
    said = "\n".join(told["verdict"]["reasons"])
    assert ("px RMS (at most 0.3 is good)" in said) == (noise_px > 1.0)
