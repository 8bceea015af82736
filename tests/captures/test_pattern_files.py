"""The `patterns` command: images for projectors, and their order."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from small_captures import RIG, write
from typer.testing import CliRunner, Result

from bodyscan.cli.main import app


def patterns(rig: str, folder: Path, *arguments: str) -> Result:
    path = write(folder / "rig.yaml", rig)
    out = folder / "out"
    return CliRunner().invoke(app, ["patterns", str(path), "--out", str(out), *arguments])


def test_projectors_of_one_kind_share_one_folder(tmp_path: Path) -> None:
    write(tmp_path / "out" / "gray-12-horizontal" / f".lit.{6 * '0a'}.tmp.png", "half an image")
    done = patterns(RIG, tmp_path, "--width", "30", "--height", "24")
    assert done.exit_code == 0, done.output
    assert "cannot be equally wide" not in done.output
    (folder,) = (tmp_path / "out").iterdir()
    assert folder.name == "gray-12-horizontal"
    told = json.loads((folder / "patterns.json").read_text())
    assert told["pairs"] == ["p1", "p2"]
    assert (told["width"], told["height"]) == (30, 24)
    shown = [entry["file"] for entry in told["show"]]
    # The finest in the middle, each beside its inverse.
    assert shown == [
        "lit.png", "dark.png",
        *(f"bit0{k}{inverse}.png" for k in (1, 3, 2, 0) for inverse in ("", "-inverse")),
    ]  # fmt: skip
    assert {path.name for path in folder.iterdir()} == {*shown, "patterns.json"}
    by_code = [f"bit0{k}{inverse}.png" for inverse in ("", "-inverse") for k in range(4)]
    lit, dark, *bits = (
        cv2.imread(str(folder / name), cv2.IMREAD_UNCHANGED) for name in (*shown[:2], *by_code)
    )
    assert lit.shape == (24, 30)
    assert lit.min() == 255
    assert dark.max() == 0
    stripe = np.arange(24) // 2
    for bit, (pattern, inverse) in enumerate(zip(bits[:4], bits[4:], strict=True)):
        on = (stripe ^ (stripe >> 1)) >> (3 - bit) & 1
        np.testing.assert_array_equal(pattern, np.repeat(255 * on[:, None], 30, axis=1))
        np.testing.assert_array_equal(inverse, 255 - pattern)


def test_each_kind_has_its_folder_and_its_images(tmp_path: Path) -> None:
    rig = RIG.replace("code: gray", "code: phase-shift, steps: 3, period: 6, inverses: false")
    done = patterns(rig, tmp_path, "--width", "30", "--height", "60")
    assert done.exit_code == 0, done.output
    out = tmp_path / "out"
    assert sorted(path.name for path in out.iterdir()) == [
        "gray-12-horizontal", "phase-shift-12-horizontal",
    ]  # fmt: skip
    # Image n is 1/2 + 1/2 cos(2 pi (s / period - n / N)), at the middle of each row.
    s = (np.arange(60) + 0.5) / 5
    for step in range(3):
        path = out / "phase-shift-12-horizontal" / f"phase0{step}.png"
        wave = 127.5 + 127.5 * np.cos(2 * np.pi * (s / 6 - step / 3))
        np.testing.assert_allclose(cv2.imread(str(path), 0)[:, 7], wave, atol=0.51)


@pytest.mark.parametrize(
    ("rig", "size", "message"),
    [
        (RIG, "10", "12 stripes do not fit on 10 projector pixels"),
        (RIG.replace("stripes: 12", "code: stripe-index, stripes: 12").replace("code: gray, ", ""),
         "24", "none of its projectors displays images"),
    ],
)  # fmt: skip
def test_what_cannot_be_shown_is_said_and_nothing_written(
    tmp_path: Path, rig: str, size: str, message: str
) -> None:
    done = patterns(rig, tmp_path, "--width", "30", "--height", size)
    assert done.exit_code != 0
    assert message in str(done.exception)
    assert not (tmp_path / "out").exists()


def test_stripes_of_uneven_width_are_told(tmp_path: Path) -> None:
    done = patterns(RIG, tmp_path, "--width", "30", "--height", "25")
    assert "note: 12 stripes cannot be equally wide on 25 px" in done.output


def test_crossing_stripes_are_shown_after_the_others_from_their_first_code(tmp_path: Path) -> None:
    rig = RIG.replace(
        "code: gray, stripes: 12", "code: gray, stripes: 12, crossing: {stripes: 10, first_code: 3}"
    )
    done = patterns(rig, tmp_path, "--width", "30", "--height", "24")
    assert done.exit_code == 0, done.output
    folder = tmp_path / "out" / "gray-12-horizontal-10-vertical"
    told = json.loads((folder / "patterns.json").read_text())
    shown = [entry["file"] for entry in told["show"]]
    order = [f"bit0{k}{way}.png" for k in (1, 3, 2, 0) for way in ("", "-inverse")]
    assert shown[2:10] == order
    assert shown[10:] == [f"crossing-{name}" for name in order]
    number = np.arange(30) // 3 + 3
    for bit in range(4):
        image = cv2.imread(str(folder / f"crossing-bit0{bit}.png"), cv2.IMREAD_UNCHANGED)
        on = (number ^ (number >> 1)) >> (3 - bit) & 1
        np.testing.assert_array_equal(image, np.repeat(255 * on[None], 24, axis=0))
