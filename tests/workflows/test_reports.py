"""Reports of a real calibration and scan, and an acceptance test, on the small simulated rig."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import open3d as o3d
import pytest
from small_workspace import Workspace, run, simulate_subject
from typer.testing import Result

from bodyscan.evaluation.acceptance import load_acceptance
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.registration.storage import load_calibration, save_calibration
from bodyscan.simulation.settings import Person


def report(workspace: Workspace, *arguments: object) -> str:
    result = run("report", *arguments)
    assert result.exit_code == 0, f"{result.output}\n{result.exception!r}"
    return Path(str(arguments[2])).read_text("utf-8")


def test_corners_are_kept_with_their_residuals(workspace: Workspace) -> None:
    calibration = load_calibration(workspace.folder / "calibration")
    assert set(calibration.observed) == set(calibration.pairs)
    for name, seen in calibration.observed.items():
        quality, camera = calibration.pairs[name].quality, calibration.pairs[name].camera
        assert len(np.unique(seen.target)) == quality.poses
        assert seen.target.max() < len(calibration.rig_from_board)
        assert np.all((seen.pixels > -0.5) & (seen.pixels < [camera.width, camera.height]))
        # The robust RMS of the quality leaves outliers out; the median of a Rayleigh distribution
        # is 1.18 sigma, its RMS 1.41.
        median = float(np.median(np.linalg.norm(seen.residuals_px, axis=1)))
        assert quality.corners_rms_px is not None
        assert 0.4 < median / quality.corners_rms_px < 1.2


def test_the_calibration_has_a_report(workspace: Workspace, tmp_path: Path) -> None:
    text = report(workspace, workspace.folder / "calibration", "--out", tmp_path / "c.html")
    assert len(text) < 8_000_000
    for part in ("synthetic", "Verdict:", "Coverage of each camera", "View graph", "Residuals",
                 "Baseline, projection angle", "held-out boards", "Sigma over the scan volume",
                 "enlarged"):  # fmt: skip
        assert part in text
    for name in ("p1-2", "p1-3", "p2-2", "p2-3"):
        assert f"<th>{name}</th>" in text


def test_the_scan_has_a_report_held_against_the_truth(workspace: Workspace, tmp_path: Path) -> None:
    truth = workspace.folder / "truth" / "subject.ply"
    text = report(
        workspace, workspace.folder / "scan", "--out", tmp_path / "s.html", "--compare", truth
    )
    assert len(text) < 8_000_000
    for part in ("synthetic", "Deviation map", "Residuals of the overlaps", "sway", "Holes"):
        assert part in text


def test_a_calibration_is_not_compared(workspace: Workspace) -> None:
    result = run("report", workspace.folder / "calibration", "--compare", workspace.folder / "scan")
    assert getattr(result.exception, "exit_code", None) == 2


@pytest.fixture(scope="module")
def spheres(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A scan of two spheres in the middle of the small rig's volume, high above a foot."""
    folder, file = tmp_path_factory.mktemp("spheres"), load_acceptance(None).spheres
    shown = o3d.geometry.TriangleMesh.create_box(0.02, 0.02, 0.01)
    for centre in np.array(file.centres_mm) / 1000.0:
        ball = o3d.geometry.TriangleMesh.create_sphere(file.radius_mm / 1000.0, resolution=200)
        shown += ball.translate(centre + [0.0, 0.0, 1.0])
    o3d.io.write_triangle_mesh(str(folder / "spheres.ply"), shown)
    simulate_subject(folder / "made", folder / "spheres.ply", 0, Person(subdivisions=0))
    return folder / "made" / "captures" / "person"


def accept(
    folder: Path, calibration: Path, out: Path, *more: object
) -> tuple[Result, dict[str, Any]]:
    result = run("accept", "--spheres", folder, "--calibration", calibration, "--out", out, *more)
    return result, json.loads((out / "acceptance.json").read_text("utf-8"))


def test_spheres_are_accepted_from_captures(
    workspace: Workspace, spheres: Path, tmp_path: Path
) -> None:
    # Half the pixels, two of three poles and ten boards: cameras stand within 0.6 mm (see
    # test_whole_way), so 500 mm between centres are known to about that.
    limits = ("--limit", "sphere_spacing_mm=0.6", "--limit", "probing_size_mm=0.6")
    result, found = accept(spheres, workspace.folder / "calibration", tmp_path, *limits)
    assert result.exit_code == 0, result.output
    assert found["synthetic"]
    assert "synthetic" in result.output
    assert found["figures"]["flatness_mm"]["value"] is None
    text = (tmp_path / "acceptance.html").read_text("utf-8")
    assert "Verdict: accepted" in text
    assert "is no test by these standards" in text


def test_a_person_is_taken_for_no_artefact_and_no_test_is_replaced_unasked(
    workspace: Workspace, tmp_path: Path
) -> None:
    person, calibration = workspace.folder / "captures" / "person", workspace.folder / "calibration"
    result, found = accept(person, calibration, tmp_path, "--plate", person)
    assert result.exit_code == 1
    assert not found["spheres"]
    assert not found["plates"]
    assert "was not found" in found["problems"][0]
    assert "check that the folder shows the plate" in found["problems"][1]
    (tmp_path / "acceptance.json").write_text("{}", "utf-8")
    again, kept = accept(person, calibration, tmp_path)
    assert getattr(again.exception, "exit_code", None) == 2
    assert kept == {}
    assert "--overwrite" in str(again.exception)
    assert accept(person, calibration, tmp_path, "--overwrite")[1]["problems"]


def test_a_calibration_of_the_wrong_size_is_not_accepted(
    workspace: Workspace, spheres: Path, tmp_path: Path
) -> None:
    right = load_calibration(workspace.folder / "calibration")
    shifted = {
        name: RigidTransform(t.rotation, 1.003 * t.translation) if name.startswith("p2") else t
        for name, t in right.rig_from_camera.items()
    }
    right.rig_from_camera.update(shifted)
    save_calibration(right, tmp_path / "wrong")
    limits = ("--limit", "probing_form_mm=1.5")
    result, found = accept(spheres, tmp_path / "wrong", tmp_path / "out", *limits)
    assert result.exit_code == 1
    assert found["figures"]["probing_form_mm"]["exceeded"]
