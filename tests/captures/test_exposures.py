"""Several exposures of one sequence: the best of each pixel, and what is refused."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from small_captures import encoded, write
from stripe_rendering import code_light, render

from bodyscan.captures.folder import open_scan
from bodyscan.captures.images import merge_exposures, read_sequence
from bodyscan.errors import ImageError, RigFileError
from bodyscan.geometry.robust import estimate_robust_scale
from bodyscan.rig.rig import load_rig
from bodyscan.stripes.codes import parse_stripe_code
from bodyscan.stripes.decoding import decode_stripes
from bodyscan.stripes.stripe_map import StripeMap

STRIPES, SHAPE = 64, (120, 180)
GRAY = {"code": "gray"}
WAVES = {"code": "phase-shift", "period": (16, 64), "steps": 4}


def s_at(u: np.ndarray, v: np.ndarray) -> np.ndarray:
    return 2 + (u + 0.1 * v + 2 * np.sin(v / 20)) / 3.2


def hair_and_skin(u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Black hair on top, pale skin below."""
    return np.where(v < 60, 0.02, 1.0)


def exposed(code: dict[str, Any], times: float) -> tuple[np.ndarray, np.ndarray]:
    """(F, H, W) images, lit and dark first, of light that a camera sees `times` as long; and s."""
    lights = code_light(stripes=STRIPES, **code)
    lit, dark, coded, s = render(
        s_at,
        lights,
        stripes=STRIPES,
        shape=SHAPE,
        albedo=hair_and_skin,
        light=200 * times,
        ambient=8 * times,
        noise=1.0,
        seed=round(10 * times),
    )
    return np.concatenate([[lit, dark], coded]), s


def decoded(code: dict[str, Any], images: np.ndarray) -> StripeMap:
    named = {k: list(v) if isinstance(v, tuple) else v for k, v in code.items()}
    spec = parse_stripe_code({**named, "stripes": STRIPES, "direction": "vertical"})
    return decode_stripes(spec, images[0], images[1], np.ascontiguousarray(images[2:]))


def read(code: dict[str, Any], images: np.ndarray, s: np.ndarray) -> np.ndarray:
    """How far s is off, NaN where there is none."""
    return np.asarray(decoded(code, images).s - s)


def known(off: np.ndarray, rows: slice) -> float:
    return float(np.isfinite(off[rows, 5:-5]).mean())


@pytest.mark.slow
@pytest.mark.parametrize("code", [GRAY, WAVES], ids=lambda code: str(code["code"]))
def test_hair_and_skin_come_in_one_scan(code: dict[str, Any]) -> None:
    (short, s), (long, _) = exposed(code, 1.0), exposed(code, 16.0)
    hair, skin = slice(3, 56), slice(64, 117)
    off = read(code, merge_exposures([short, long], ["short", "long"], ""), s)
    assert known(off, hair) > 0.95
    assert known(off, skin) > 0.95
    assert np.nanmax(np.abs(off[hair, 5:-5])) < 1.0
    alone = read(code, short, s)
    assert known(alone, hair) < 0.3
    # What the short one told is told as well by both.
    both = np.isfinite(alone[skin]) & np.isfinite(off[skin])
    assert np.std(off[skin][both]) < 1.1 * np.std(alone[skin][both]) + 0.001


@pytest.mark.parametrize("code", [GRAY, WAVES], ids=lambda code: str(code["code"]))
def test_sigmas_of_hair_and_of_skin_are_as_large_as_their_errors(code: dict[str, Any]) -> None:
    (short, s), (long, _) = exposed(code, 1.0), exposed(code, 16.0)
    seen = decoded(code, merge_exposures([short, long], ["short", "long"], ""))
    for rows in (slice(3, 56), slice(64, 117)):
        normalised = ((seen.s - s) / seen.sigma)[rows, 5:-5]
        # Of some 2,500 boundaries a robust sigma is known to 2 %; the least sigma of a boundary
        # covers imperfect devices, which these are not: sigmas may be a sixth too large.
        assert estimate_robust_scale(normalised[np.isfinite(normalised)]) == pytest.approx(
            1.0, abs=0.2
        )


def test_the_merged_images_are_the_shorter_ones_with_less_noise() -> None:
    (short, _), (long, _) = exposed(GRAY, 1.0), exposed(GRAY, 8.0)
    merged = merge_exposures([short, long], ["short", "long"], "")
    exact, _ = exposed(GRAY, 1.0)
    # Dark frames are white in neither: 1.04 / 8 of noise on skin and hair.
    for rows, level in ((slice(5, 50), 0.16), (slice(70, 115), 8.0)):
        assert np.std(merged[1][rows, 5:-5]) < 0.25
        assert np.mean(merged[1][rows, 5:-5]) == pytest.approx(level, abs=0.15)
    assert abs(float(np.mean(merged - exact))) < 0.1
    assert merged.max() <= 255


def test_three_exposures_are_chained() -> None:
    stacks = [exposed(GRAY, times)[0] for times in (1.0, 4.0, 16.0)]
    merged = merge_exposures(stacks, ["a", "b", "c"], "")
    hair = merged[0][10:50, 10:-10]
    assert hair.mean() == pytest.approx(0.02 * 208, abs=0.1)
    assert hair.std() < 0.25  # 1.04 / 16, and what the lights' edges leave


def test_exchanged_exposures_are_named() -> None:
    (short, _), (long, _) = exposed(GRAY, 1.0), exposed(GRAY, 6.0)
    with pytest.raises(ImageError) as refused:
        merge_exposures([long, short], ["short", "long"], "pair a, shot b")
    # A sixth, fitted to what is white in neither.
    said = r"long is 0\.1[678] times as bright as short, which is listed as the shorter one"
    assert re.search(said, str(refused.value))
    assert "`exposures: [long, short]`" in str(refused.value)


def test_exposures_that_share_nothing_are_refused() -> None:
    black, white = np.zeros((4, 50, 50), np.uint8), np.full((4, 50, 50), 255, np.uint8)
    with pytest.raises(ImageError, match="exposures short and long cannot be compared"):
        merge_exposures([black, white], ["short", "long"], "")
    grey, brighter = (exposed(GRAY, times)[0] for times in (1.0, 4.0))
    over = np.full_like(grey, 255)
    with pytest.raises(ImageError, match="exposures long and longest cannot be compared"):
        merge_exposures([grey, brighter, over], ["short", "long", "longest"], "")


def rig_file(folder: Path, **changes: Any) -> Path:
    rig = {
        "version": 1,
        "name": "one",
        "pairs": [{
            "name": "p1",
            "camera": {"width": SHAPE[1], "height": SHAPE[0]},
            "projector": {"stripes": STRIPES, "direction": "vertical"},
        }],
        "files": "{shot}/{pair}-{exposure}-{frame}.png",
        "exposures": ["short", "long"],
        **changes,
    }  # fmt: skip
    path = folder / "rig.yaml"
    path.write_text(yaml.safe_dump(rig), "utf-8")
    return path


def test_a_rig_file_names_its_exposures(tmp_path: Path) -> None:
    rig = load_rig(rig_file(tmp_path))
    projector = rig.pairs[0].projector
    assert projector is not None
    frames = ("lit", "dark", *rig.frames.code_names(projector))
    (tmp_path / "scan/a").mkdir(parents=True)
    for name, times in (("short", 1.0), ("long", 8.0)):
        images, _ = exposed(GRAY, times)
        for frame, image in zip(frames, images, strict=True):
            write(tmp_path / f"scan/a/p1-{name}-{frame}.png", encoded(image))
    captures = open_scan(rig, tmp_path / "scan")
    (sequence,) = captures.sequences
    assert captures.shots == ("a",)
    assert not sequence.missing
    assert len(sequence.paths) == 2 * len(frames)
    found = read_sequence(sequence, rig.pairs[0].camera)
    assert found.coded.dtype == np.float32
    (tmp_path / "scan/a/p1-long-bit02.png").unlink()
    gone = [path for s in open_scan(rig, tmp_path / "scan").sequences for path in s.missing]
    assert [path.name for path in gone] == ["p1-long-bit02.png"]


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"files": "{shot}/{pair}/{frame}.png"}, "needs {exposure}"),
        ({"exposures": []}, "holds {exposure}, but the rig file names no `exposures`"),
        ({"exposures": ["short"]}, "exposures: names one exposure"),
        ({"exposures": ["short", "short"]}, "is named twice"),
    ],
)
def test_what_does_not_fit_in_a_rig_file_is_named(
    tmp_path: Path, changes: dict[str, Any], said: str
) -> None:
    with pytest.raises(RigFileError) as refused:
        load_rig(rig_file(tmp_path, **changes))
    assert said in str(refused.value)
