"""An acceptance test: its file, its command, and what it leaves written."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from typer.testing import CliRunner

from bodyscan.cli.main import app
from bodyscan.errors import BadInput
from bodyscan.evaluation.acceptance import ALL, Readings, SphereRow, load_acceptance
from bodyscan.workflows import accept_rig


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("spheres: {radius_mm: -1}", "spheres.radius_mm"),
        ("limits: {flatness: 1}", "limits.flatness"),
        ("spheres: {centres_mm: [[0, 0, 0], [50, 0, 0]]}", "lies inside sphere 1"),
    ],
)
def test_a_wrong_file_is_explained(tmp_path: Path, text: str, said: str) -> None:
    path = tmp_path / "acceptance.yaml"
    path.write_text(text)
    with pytest.raises(BadInput, match=said):
        load_acceptance(path)


@pytest.mark.parametrize(
    "arguments", [[], ["--spheres", "a"], ["--spheres", "a", "--limit", "flatness_mm=flat"]]
)
def test_what_cannot_be_measured_is_bad_input(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, arguments: list[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    result = CliRunner().invoke(app, ["accept", "--calibration", "c", *arguments])
    assert result.exception is not None
    assert getattr(result.exception, "exit_code", None) == 2


def test_a_test_is_written_down_and_the_page_of_an_earlier_one_does_not_stay(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(accept_rig, "calibration_id", lambda stored: "0123")
    calibration: Any = SimpleNamespace(rig=SimpleNamespace(name="r"), axes="wherever")
    readings = Readings((SphereRow("a", "s01", ALL, 1, 5000, 0.3, 0.2, 0.1),), (), ())
    file = load_acceptance(None, ["probing_size_mm=0.4"])

    def judge() -> accept_rig.Acceptance:
        return accept_rig.judge_readings(
            readings, file, calibration, tmp_path, tmp_path, synthetic=True
        )

    found = judge()
    assert found.verdict.grade == "accepted"
    assert found.page is not None
    assert "0123" in found.page.read_text("utf-8")
    content = json.loads(found.file.read_text("utf-8"))
    assert content["calibration_id"] == "0123"
    assert content["synthetic"]
    assert not found.notes

    def broken(*_: object) -> None:
        raise OSError("no fonts")

    monkeypatch.setattr(accept_rig, "make_acceptance_page", broken)
    again = judge()
    assert again.page is None
    assert not found.page.exists()
    assert len(again.notes) == 1
