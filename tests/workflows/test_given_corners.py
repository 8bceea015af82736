"""Corners found elsewhere, in a corners.vnl, calibrate a rig of which no image is there."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from ring import board_poses, ring_of_cameras
from small_workspace import run

from bodyscan.arrays import Array
from bodyscan.boards.board_layout import compute_corner_points
from bodyscan.boards.detection import find_boards
from bodyscan.captures.check import check
from bodyscan.errors import BodyscanError, CaptureError
from bodyscan.files.corners_vnl import Corners, read_corners, write_corners
from bodyscan.rig.board import Board
from bodyscan.workflows.calibrate_rig import calibrate_folder

BOARD = Board(name="board", columns=10, rows=7, square_mm=60)
GRID = (6, 9, 2)


def seen_corners(
    noise_px: float = 0.03, board: Board = BOARD, *, poles: int = 1, behind: bool = False
) -> dict[str, Array]:
    """What the cameras see of boards, by an image's name: three cameras of each pole.

    behind: they see the print through the board as well.
    """
    placings, cameras = ring_of_cameras(poles=poles, heights=(700, 1000, 1300))
    rng = np.random.default_rng(3)
    forward = placings["p1-2"].rotation[:, 2]
    found = {}
    for number, pose in enumerate(board_poses(60, rng)):
        for name, camera in cameras.items():
            camera_from_board = placings[name].inverse() @ pose
            forward = placings[name].rotation[:, 2] if behind else forward
            ahead = float(camera_from_board.rotation[:, 2] @ (placings[name].rotation.T @ forward))
            ahead = abs(ahead) if behind else ahead
            pixels = camera.project(camera_from_board.apply(compute_corner_points(board)))
            inside = np.all((pixels > 5) & (pixels < [1275, 1019]))
            if ahead > 0.4 and inside:
                found[f"/elsewhere/{name}/s{number:02}.png"] = pixels + rng.normal(
                    0.0, noise_px, pixels.shape
                )
    return found


def as_listed(found: dict[str, Array]) -> Iterator[tuple[str, Corners]]:
    for name, corners in found.items():
        yield name, tuple((float(x), float(y)) for x, y in corners)


def rig_file(folder: Path, text: str = "corners.vnl", board: Board = BOARD, poles: int = 1) -> Path:
    rig = {
        "name": "given",
        "boards": [board.model_dump(exclude_none=True, exclude_defaults=True)],
        "pairs": [
            {"name": f"p{pole}-{k}", "camera": {"width": 1280, "height": 1024, "lens": "radial"}}
            for pole in range(1, poles + 1)
            for k in (1, 2, 3)
        ],
        "calibration": [{"folder": "images", "corners": text}],
        "files": "{pair}/{shot}.png",
        "rig_frame": {"pair": "p1-1"},
    }
    path = folder / "rig.yaml"
    path.write_text(yaml.safe_dump(rig), "utf-8")
    return path


def test_a_rig_is_calibrated_without_images_and_again_from_what_it_wrote(tmp_path: Path) -> None:
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


def test_a_print_with_markers_seen_through_its_glass_joins_both_sides(tmp_path: Path) -> None:
    glass = Board(name="board", kind="charuco", columns=9, rows=7, square_mm=60, marker_mm=45)
    found = seen_corners(board=glass, poles=2, behind=True)
    write_corners(tmp_path / "corners.vnl", as_listed(found))
    calibration, _ = calibrate_folder(rig_file(tmp_path, board=glass, poles=2), tmp_path / "out")
    placings, _ = ring_of_cameras(poles=2, heights=(700, 1000, 1300))
    true = placings["p1-1"].inverse() @ placings["p2-3"]
    assert not calibration.failed
    # Poles 2.6 m apart: a tenth of the noise of a pixel at each end.
    assert np.allclose(calibration.rig_from_camera["p2-3"].translation, true.translation, atol=3.0)


@pytest.mark.parametrize("squares", [6, 7])
def test_a_square_board_may_be_numbered_from_any_corner(tmp_path: Path, squares: int) -> None:
    board = Board(name="board", columns=squares, rows=squares, square_mm=60)
    rng = np.random.default_rng(1)
    grid = (squares - 1, squares - 1, 2)
    found = {
        name: np.rot90(pixels.reshape(grid), int(rng.integers(4))).reshape(-1, 2)
        for name, pixels in seen_corners(board=board).items()
    }
    write_corners(tmp_path / "corners.vnl", as_listed(found))
    calibration, _ = calibrate_folder(rig_file(tmp_path, board=board), tmp_path / "out")
    placings, _ = ring_of_cameras(poles=1, heights=(700, 1000, 1300))
    true = placings["p1-1"].inverse() @ placings["p1-3"]
    assert sum(pair.quality.poses for pair in calibration.pairs.values()) == len(found)
    assert np.allclose(calibration.rig_from_camera["p1-3"].translation, true.translation, atol=2.0)
    assert set(calibration.pairs) == {"p1-1", "p1-2", "p1-3"}


@pytest.mark.parametrize("squares", [7, 8])
def test_a_square_board_is_found_in_an_image(squares: int) -> None:
    board = Board(name="board", columns=squares, rows=squares, square_mm=60)
    colours = 40 + 180 * (np.indices((squares, squares)).sum(axis=0) % 2)
    image = np.pad(np.kron(colours, np.ones((40, 40))), 60, constant_values=220).astype(np.uint8)
    (view,) = find_boards(cv2.GaussianBlur(image, (0, 0), 1.0), [board], pair="p", shot="s")
    assert len(view.pixels) == (squares - 1) ** 2
    assert view.turnable
