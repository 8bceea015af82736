"""A new format is one new file, for bodies and for rigs: nothing else of the package names it."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import xyz_format
from small_bodies import ball, points

from bodyscan.errors import BadInput
from bodyscan.export.body_file import Provenance, write_body
from bodyscan.export.formats import BODY_FORMATS
from bodyscan.export.scan import export_scan
from bodyscan.fusion.storage import StoredScan
from bodyscan.interchange.rig_format import RIG_FORMATS
from bodyscan.jobs.pipeline import Pipeline

SCAN = StoredScan(points(), ball(), {"subject": None, "calibration_id": "3f2a"})


@pytest.fixture
def registered() -> Iterator[None]:
    BODY_FORMATS.register("xyz", xyz_format.FORMAT)
    yield
    del BODY_FORMATS.registered["xyz"]


@pytest.mark.usefixtures("registered")
def test_it_is_exported_as_all_are(tmp_path: Path) -> None:
    (written,) = export_scan(SCAN, tmp_path, ["XYZ"], ["full"])
    assert written == tmp_path / "body.xyz"
    np.testing.assert_allclose(np.loadtxt(written)[:, :3], ball().vertices, atol=6e-4)
    info = json.loads((tmp_path / "body.xyz.json").read_text())
    assert (info["kind"], info["units"], info["axes"]["z"]) == ("mesh", "mm", "up")
    write_body(tmp_path / "cloud.xyz", points(), Provenance(None, "3f2a"))
    assert len(np.loadtxt(tmp_path / "cloud.xyz")) == 500
    pipeline = {"name": "p", "kind": "fuse", "export": {"formats": ["ply", "xyz"]}}
    assert Pipeline.model_validate(pipeline).export.formats == ("ply", "xyz")


@pytest.mark.usefixtures("registered")
def test_a_name_that_is_taken_is_refused() -> None:
    for name in ("xyz", "ply"):
        with pytest.raises(ValueError, match=f"there is a format '{name}' already"):
            BODY_FORMATS.register(name, xyz_format.FORMAT)


def test_an_unknown_format_is_refused_with_a_list_of_formats(tmp_path: Path) -> None:
    with pytest.raises(BadInput, match=r"'xyz'") as caught:
        export_scan(SCAN, tmp_path, ["xyz"])
    assert caught.value.remedy == "choose from glb, obj, ply, stl"
    with pytest.raises(BadInput, match=r"'gbl' \(did you mean 'glb'\?\)"):
        export_scan(SCAN, tmp_path, ["gbl"])
    with pytest.raises(BadInput, match=r"'opencvv' \(did you mean 'opencv'\?\)"):
        RIG_FORMATS.find("opencvv")
    assert not list(tmp_path.iterdir())


def test_names_are_known_without_importing_what_writes_them() -> None:
    code = (
        "import sys, bodyscan.jobs.pipeline as p; p.Pipeline(name='p', kind='fuse')\n"
        "print([m for m in ('numpy', 'cv2', 'pycolmap') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_the_docs_have_every_format_with_what_it_holds() -> None:
    text = (Path(__file__).parents[2] / "docs" / "formats.md").read_text("utf-8")
    rows = dict(re.findall(r"^\| `\.(\w+)` \| (.*?) \|", text, re.MULTILINE))
    assert set(rows) == set(BODY_FORMATS.names())
    for name, info in rows.items():
        assert set(info.split(", ")) == set(BODY_FORMATS.find(name).holds), name
