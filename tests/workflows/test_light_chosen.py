"""Which model of the light a pair needs is found from its boards, whatever throws the stripes."""

from __future__ import annotations

from pathlib import Path

import pytest
from small_workspace import PROJECT, run

from bodyscan.registration.storage import load_calibration

SHEETS = {"bowed sheets", "bowed sheets, 3 terms"}
LENSES = {"lens k1 k2", "lens k1 k2 p1 p2"}


@pytest.mark.parametrize(("projector", "expected"), [("pinhole", LENSES), ("mirror", SHEETS)])
def test_held_out_boards_choose_a_lens_for_a_lens_and_planes_for_a_mirror(
    tmp_path: Path, projector: str, expected: set[str]
) -> None:
    rig, folder = PROJECT / "rigs" / "one-pair.yaml", tmp_path / "work"
    size = ("--scale", 0.4, "--board-shots", 6, "--preset", "ideal")
    for command in (
        ("simulate", rig, "--out", folder, "--projector", projector, *size),
        ("calibrate-rig", folder / "rig.yaml"),
    ):
        result = run(*command)
        assert result.exit_code == 0, result.output
    quality = load_calibration(folder / "calibration").pairs["pair"].quality
    assert quality.light_model in expected
    errors = {tried.model: tried.mean_mm for tried in quality.held_out}
    if projector == "pinhole":
        planes = min(errors["free planes"], errors["smooth planes"])
        assert planes > 1.5 * errors[quality.light_model]
