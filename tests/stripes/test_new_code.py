"""A new stripe code is one new file: nothing else of the package names it."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
import pytest
import shifted_binary
from copied_package import run_with_file
from shifted_binary import ShiftedBinary
from small_captures import RIG, write

from bodyscan.captures.check import check
from bodyscan.captures.folder import open_captures
from bodyscan.captures.pattern_files import write_patterns
from bodyscan.errors import BadInput, RigFileError
from bodyscan.rig.rig import load_rig, write_rig
from bodyscan.simulation import simulate
from bodyscan.stripes import codes
from bodyscan.stripes.codes.gray import PATTERN
from bodyscan.stripes.stripe_code import ImageKind, StripeCode
from bodyscan.workflows.decode import decode_sequence

PROJECTOR = "{code: shifted-binary, stripes: 12, direction: horizontal, first: 9}"
ITS_RIG = RIG.replace("{code: gray, stripes: 12, direction: horizontal}", PROJECTOR)
NAMED = ITS_RIG + "frames: {digit: 'd{digit}'}\n"


@pytest.fixture
def registered() -> Iterator[None]:
    codes.register(ShiftedBinary)
    yield
    del codes._CODES["shifted-binary"]


@pytest.mark.usefixtures("registered")
def test_it_goes_all_the_way_from_the_rig_file_to_stripes(tmp_path: Path) -> None:
    rig = load_rig(write(tmp_path / "rig.yaml", NAMED))
    code = rig.pair("p1").projector
    assert code == ShiftedBinary(stripes=12, direction="horizontal", first=9)
    write_rig(tmp_path / "again.yaml", rig)
    assert load_rig(tmp_path / "again.yaml") == rig
    # What is projected is what the camera sees, in three shots.
    listed = write_patterns(rig, tmp_path / "patterns", width=40, height=30)
    told = json.loads(listed[0].read_text())
    assert told["code"]["code"] == "shifted-binary"
    shown = [entry["file"] for entry in told["show"]]
    assert shown == ["lit.png", "dark.png", *(f"d{digit}.png" for digit in range(5))]
    for name in shown:
        image = cv2.imread(str(listed[0].parent / name), cv2.IMREAD_GRAYSCALE) // 2 + 20
        for shot in ("b1", "b2", "b3"):
            write(tmp_path / "captures" / shot / "p1" / name, image)
    assert not [error for error in check(tmp_path / "rig.yaml").errors if "p1" in error]
    sequence = open_captures(rig, tmp_path / "rig.yaml").pair_sequences("p1")[1]
    seen = decode_sequence(sequence, rig.pair("p1"))
    true = (np.arange(30) + 0.5)[:, None] * 12 / 30
    known = np.isfinite(seen.s)
    assert known.mean() > 0.99
    assert np.abs(seen.s - true)[known].max() < 0.6, "a stripe is 2.5 pixels wide"


@pytest.mark.usefixtures("registered")
@pytest.mark.parametrize(
    ("old", "new", "line"),
    [
        ("first: 9", "first: -1", "8:82: pairs[0].projector.first: must be 0 or more (got -1)"),
        (
            "first: 9",
            "frist: 9",
            "projector.frist: is not a key known here (did you mean 'first'?)",
        ),
        ("first: 9", "steps: 4", "steps: is for code: phase-shift (the code here is shifted-bin"),
        ("shifted-binary", "gray", "first: is for code: shifted-binary (the code here is gray)"),
        ("shifted-binary", "shiftd-binary", "(did you mean 'shifted-binary'?)"),
        ("digit: 'd", "dgit: 'd", "frames.dgit: is not a key known here (did you mean 'digit'?)"),
        ("d{digit}", "d{bit}", "frames.digit: may only hold {digit}"),
        ("'d{digit}'", "[a, b]", "has 2 names, but the 12 stripes of pair p1 take 5 digits"),
        ("frames: {", "frames: {dark: null, ", "frames.dark: is needed: pair p1"),
    ],
)
def test_its_keys_are_checked_as_all_are(tmp_path: Path, old: str, new: str, line: str) -> None:
    with pytest.raises(RigFileError) as caught:
        load_rig(write(tmp_path / "rig.yaml", NAMED.replace(old, new)))
    assert line in str(caught.value)
    assert len(str(caught.value).splitlines()) == 2


def test_its_file_in_the_folder_is_all_it_needs(tmp_path: Path) -> None:
    rig = write(tmp_path / "rig.yaml", ITS_RIG)
    call = ("patterns", rig, "--out", "out", "--width", 40, "--height", 30)
    done = run_with_file(tmp_path, shifted_binary, "stripes/codes/shifted_binary.py", *call)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "out" / "shifted-binary-12-horizontal" / "digit04.png").is_file()


@pytest.mark.usefixtures("registered")
def test_the_simulator_refuses_a_code_that_it_has_no_formulas_for(tmp_path: Path) -> None:
    rig = write(tmp_path / "rig.yaml", ITS_RIG)
    with pytest.raises(BadInput, match="cannot project its stripe code, shifted-binary") as caught:
        simulate(rig, tmp_path / "made")
    assert caught.value.where == "pair p1"
    assert not (tmp_path / "made").exists()


def test_a_name_that_is_taken_is_refused() -> None:
    class Another(ShiftedBinary):
        code: Literal["gray"] = "gray"  # type: ignore[assignment]  # the very thing refused

    class Clash(ShiftedBinary):
        kinds = (ImageKind(PATTERN.name, "other{bit}", "bit", 16),)

    with pytest.raises(ValueError, match="a stripe code 'gray' already"):
        codes.register(Another)
    with pytest.raises(ValueError, match="kind 'pattern' is already registered"):
        codes.register(Clash)
    assert Clash.kinds[0] not in codes.list_image_kinds()
    assert issubclass(Clash, StripeCode)
