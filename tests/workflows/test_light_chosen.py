"""Which model of the light a pair needs is found from its boards, whatever throws the stripes."""

from __future__ import annotations

from pathlib import Path

from small_workspace import PROJECT, Workspace, run

from bodyscan.registration.storage import load_calibration

LENSES = {"lens k1 k2", "lens k1 k2 p1 p2"}


def test_held_out_boards_choose_a_lens_for_a_lens(tmp_path: Path) -> None:
    rig, folder = PROJECT / "rigs" / "one-pair.yaml", tmp_path / "work"
    size = ("--scale", 0.4, "--board-shots", 6, "--preset", "ideal")
    for command in (
        ("simulate", rig, "--out", folder, "--projector", "pinhole", *size),
        ("calibrate-rig", folder / "rig.yaml"),
    ):
        result = run(*command)
        assert result.exit_code == 0, result.output
    quality = load_calibration(folder / "calibration").pairs["pair"].quality
    assert quality.light_model in LENSES
    errors = {tried.model: tried.mean_mm for tried in quality.held_out}
    planes = min(errors["free planes"], errors["smooth planes"])
    assert planes > 1.5 * errors[quality.light_model]


def test_held_out_boards_choose_no_lens_for_a_mirror(workspace: Workspace) -> None:
    for pair in load_calibration(workspace.folder / "calibration").pairs.values():
        quality = pair.quality
        assert quality.light_model is not None
        assert "planes" in quality.light_model or "sheets" in quality.light_model
        errors = {tried.model: tried.mean_mm for tried in quality.held_out}
        lens = min(mean for model, mean in errors.items() if "lens" in model)
        assert lens > 3.0 * errors[quality.light_model]
