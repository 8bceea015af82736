"""`bodyscan check`: every fault of a rig's captures found and reported, without decoding an image."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from real_captures import real_rig_file
from small_captures import FRAMES, RIG, encoded, picture, write, write_small_captures
from small_workspace import run

from bodyscan.captures.check import check, format_report
from bodyscan.captures.image_header import read_header


@pytest.fixture
def rig_path(tmp_path: Path) -> Path:
    return write_small_captures(tmp_path)


def image(rig_path: Path, shot: str, pair: str, frame: str) -> Path:
    return rig_path.parent / "captures" / shot / pair / f"{frame}.png"


def lines_with(rig_path: Path, word: str) -> list[str]:
    return [line for line in format_report(check(rig_path)) if word in line]


def test_complete_captures_are_good(rig_path: Path) -> None:
    report = check(rig_path)
    assert report.ok
    assert report.images == 3 * (2 * len(FRAMES) + 1)
    assert [(p.pair.name, p.stripe_shots, p.lit_shots) for p in report.pairs] == [
        ("p1", 3, 0),
        ("p2", 3, 0),
        ("cam", 0, 3),
    ]
    assert format_report(report)[-1] == "good"
    assert any(
        line.endswith("mm in all: every length rests on it") for line in format_report(report)
    )
    assert sum("3 board poses will do" in warning for warning in report.warnings) == 3


def test_missing_images_are_grouped_by_pair_and_shot(rig_path: Path) -> None:
    for frame in ("bit00", "bit01", "dark"):
        image(rig_path, "b2", "p1", frame).unlink()
    report = check(rig_path)
    assert not report.ok
    assert {(bad.pair, bad.shot, bad.what) for bad in report.bad_images} == {
        ("p1", "b2", "is missing")
    }
    assert len(report.bad_images) == 3
    (line,) = lines_with(rig_path, "is missing")
    first = image(rig_path, "b2", "p1", "dark")
    assert line == f"error: pair p1, shot b2: {first}: is missing (and 2 more)"
    assert report.pairs[0].stripe_shots == 2  # that sequence cannot be used
    (few,) = lines_with(rig_path, "calibration needs 3")
    assert few.startswith("error: pair p1: has 2 whole stripe sequences")


def test_unknown_pairs_and_missing_shots_are_reported(rig_path: Path) -> None:
    file = rig_path.parent / "captures" / "captures.yaml"
    write(file, "kind: calibration\nshots: [{name: b1, stripes: [p7]}]")
    (line,) = lines_with(rig_path, "names no pair of rig small")
    assert line.startswith(f"error: {file}:2:30: shots[0].stripes[0]")
    write(file, "kind: calibration\nshots: [{name: b1}, {name: b2}, {name: b3}, {name: b4}]")
    assert lines_with(rig_path, "shot b4: no image")


def test_one_bad_folder_does_not_hide_the_others(rig_path: Path) -> None:
    write(rig_path, RIG + "  - folder: gone\n")
    report = check(rig_path)
    assert len(report.errors) == 1
    assert "gone: the capture folder does not exist" in report.errors[0]
    assert report.shots == ("b1", "b2", "b3")


def test_checking_decodes_nothing_and_imports_nothing_heavy(rig_path: Path) -> None:
    code = (
        "import sys; from bodyscan.captures.check import check\n"
        f"assert check({str(rig_path)!r}).ok\n"
        "print([m for m in ('numpy', 'cv2', 'open3d', 'scipy', 'pycolmap') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


@pytest.mark.parametrize(
    ("rig", "images"), [("procam-board", 4 * (20 + 2)), ("charuco-ring", 4 * 17)]
)
def test_real_captures_are_read_where_they_lie(
    captures: Path, tmp_path: Path, rig: str, images: int
) -> None:
    report = check(real_rig_file(rig, captures, tmp_path))
    assert report.ok, format_report(report)
    assert report.images == images


def test_a_bad_file_is_found_by_its_header(rig_path: Path) -> None:
    write(image(rig_path, "b1", "p2", "bit03"), encoded(picture("lit")[:-1]))
    (bad,) = check(rig_path).bad_images
    assert (bad.pair, bad.shot, bad.path.name) == ("p2", "b1", "bit03.png")
    assert "is 40 x 29 pixels, but the rig file says 40 x 30" in bad.what


@pytest.mark.parametrize(("folder", "renamed"), [("b2/p1", "b2/P1"), ("b2", "pose-2")])
def test_images_in_a_renamed_folder_are_reported(rig_path: Path, folder: str, renamed: str) -> None:
    captures = rig_path.parent / "captures"
    (captures / folder).rename(captures / renamed)
    write(
        captures / "captures.yaml", "kind: calibration\nshots: [{name: b1}, {name: b2}, {name: b3}]"
    )
    (warning,) = lines_with(rig_path, "check the spelling")
    assert "images belong to no pair" in warning
    assert str(captures / renamed) in warning


def test_images_of_a_shot_with_another_suffix_are_reported(rig_path: Path) -> None:
    for path in [*(rig_path.parent / "captures" / "b2").rglob("*.png")]:
        path.rename(path.with_suffix(".bmp"))
    (warning,) = lines_with(rig_path, "check the spelling")
    assert f"{2 * len(FRAMES) + 1} images belong to no pair" in warning


def test_images_of_unwanted_shots_are_ignored(rig_path: Path) -> None:
    folder = rig_path.parent / "captures"
    shutil.copytree(folder / "b2", rig_path.parent / "captures" / "elsewhere" / "b9")
    assert lines_with(rig_path, "check the spelling") == []
    for path in [*folder.rglob("*.png")]:
        path.rename(folder / "-".join(path.relative_to(folder).parts))
    text = RIG.replace("folder: captures", "{folder: captures, shots: [b1, b2]}")
    write(rig_path, text + "files: '{shot}-{pair}-{frame}.png'\n")
    assert lines_with(rig_path, "check the spelling") == []


def test_the_same_fault_in_many_shots_is_one_line(rig_path: Path) -> None:
    captures = rig_path.parent / "captures"
    for shot in ("b4", "b5"):
        shutil.copytree(captures / "b2", captures / shot)
    shots = list(captures.glob("b*/p1/lit.png"))
    for path in shots:
        path.unlink()
    (line,) = lines_with(rig_path, "error: pair p1, ")
    assert f"{len(shots)} shots: " in line
    assert f"and {len(shots) - 1} more" in line


@pytest.mark.parametrize(
    ("board", "turned"),
    [
        ("columns: 5, rows: 4", False),
        ("columns: 9, rows: 7", True),
        ("columns: 5, rows: 4, faces: 2", True),
        ("kind: charuco, columns: 9, rows: 7, marker_mm: 20", False),
    ],
)
def test_a_symmetric_board_gives_a_warning(rig_path: Path, board: str, turned: bool) -> None:
    write(rig_path, RIG.replace("columns: 5, rows: 4", board))
    assert len(lines_with(rig_path, "board board looks the same rotated")) == turned


@pytest.mark.parametrize(("quality", "warned"), [(40, True), (96, False)])
def test_low_jpeg_quality_gives_a_warning(rig_path: Path, quality: int, warned: bool) -> None:
    for path in sorted(rig_path.parent.rglob("p2/*.png")):
        content = cv2.imencode(".jpg", picture("lit"), [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
        write(path, content.tobytes())
    found = lines_with(rig_path, "JPEG of low quality")
    assert len(found) == warned
    assert not warned or "images of p2 are" in found[0]


def test_the_rounding_error_of_jpeg_follows_from_its_tables(tmp_path: Path) -> None:
    """Of noise, which has everything in it that rounding can take."""
    noise = np.random.default_rng(0).integers(0, 256, (256, 256)).astype(np.uint8)
    path = tmp_path / "noise.jpg"
    for quality in (50, 80, 95):
        cv2.imwrite(str(path), noise, [cv2.IMWRITE_JPEG_QUALITY, quality])
        error = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE).astype(float) - noise
        # Grey levels beyond 0 and 255 are cut, which takes some of the error.
        assert read_header(path).rounding_error == pytest.approx(error.std(), rel=0.15)


def test_groups_of_pairs_without_a_common_shot_are_reported(rig_path: Path) -> None:
    for shot in ("b1", "b2", "b3"):
        folder = rig_path.parent / "captures" / shot / "p2"
        shutil.copytree(folder, rig_path.parent / "captures" / f"c{shot}" / "p2")
        shutil.rmtree(folder)
    (line,) = lines_with(rig_path, "no shot in common")
    assert "cam, p1 | p2;" in line
    assert not check(rig_path).ok
    for shot in ("b1", "b2", "b3"):
        folder = rig_path.parent / "captures" / f"cb{shot[1]}"
        folder.rename(folder.with_name(f"b0{shot[1]}"))
    assert lines_with(rig_path, "shots 'b1' (cam) and 'b01' (p2) differ only in zeros")


def test_the_shot_that_fixes_the_rig_frame_must_be_complete(rig_path: Path) -> None:
    write(rig_path, RIG + "rig_frame: {shot: b22}\n")
    assert lines_with(rig_path, "no shot 'b22' (did you mean 'b2'?)")
    write(rig_path, RIG + "rig_frame: {shot: b2}\n")
    assert check(rig_path).ok
    placed = "    nominal: {position_mm: [9, 0, 0], look_at_mm: [0, 0, 0]}\n  - name: p2\n"
    for text, code in (RIG, 2), (RIG.replace("  - name: p2\n", placed), 0):
        done = run("check", write(rig_path, text + "rig_frame: {shot: b2}\n"))
        assert ("no image of 'b2' shows board board" in done.output, done.exit_code) == (True, code)
    for pair in ("p1", "p2", "cam"):
        image(rig_path, "b2", pair, "lit").write_bytes(b"damaged")
    assert lines_with(rig_path, "no pair has its images of 'b2', which fixes the rig frame")


def test_a_known_rig_needs_no_poses(captures: Path, tmp_path: Path) -> None:
    report = check(real_rig_file("two-frequency", captures, tmp_path))
    assert report.ok, format_report(report)
    assert sum("bodyscan import" in warning for warning in report.warnings) == 1
    assert not any("poses" in warning or "sequences" in warning for warning in report.warnings)
