"""The examples run, and give what they say."""

from __future__ import annotations

import json
import runpy
from pathlib import Path

import open3d as o3d
import pytest
from made_scan import make_scan

from bodyscan.export.formats import BODY_FORMATS

EXAMPLES = Path(__file__).parents[2] / "examples"


def test_a_new_exporter(tmp_path: Path) -> None:
    scan = make_scan(tmp_path / "scan")
    try:
        runpy.run_path(str(EXAMPLES / "new_exporter.py"))["main"](scan.folder, tmp_path / "out")
    finally:
        BODY_FORMATS.registered.clear()
    seen = o3d.io.read_triangle_mesh(str(tmp_path / "out" / "body.off"))
    assert len(seen.vertices) == len(scan.mesh.vertices)
    assert len(seen.triangles) == len(scan.mesh.faces)
    assert json.loads((tmp_path / "out" / "body.off.json").read_text())["units"] == "mm"


def test_one_pair_triangulated(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.delenv("BODYSCAN_CAPTURES", raising=False)
    found = runpy.run_path(str(EXAMPLES / "triangulate_pair.py"))
    assert "mm off the board" in capsys.readouterr().out
    height = found["height"]
    assert len(height) > 5_000
    # 400 mm away, a pixel is 1 mm wide: an error of a pixel or a stripe would be seen at once.
    assert abs(height.mean()) < 0.2
    assert height.std() < 0.5


@pytest.mark.parametrize("path", sorted(EXAMPLES.glob("*.py")), ids=lambda path: path.stem)
def test_an_example_is_short_and_says_how_it_is_run(path: Path) -> None:
    text = path.read_text("utf-8")
    assert len(text.splitlines()) < 62
    assert text.startswith('"""')
