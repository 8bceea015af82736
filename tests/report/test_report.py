"""The report of a scan: what it says, that it is one file, and that a browser shows the body."""

from __future__ import annotations

import base64
import csv
import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from browser import browser_page, find_browser
from made_scan import MIDDLE_MM, SEMI_AXES_MM, MadeScan, egg, make_scan
from required import missing
from small_workspace import run
from standing_body import hanging, standing_body
from typer.testing import CliRunner

from bodyscan.cli.main import app
from bodyscan.errors import BadInput, ResultError
from bodyscan.evaluation.surface import compare_surfaces
from bodyscan.files.atomic import write_json
from bodyscan.fusion.storage import Origin, read_facts
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.jobs.forgetting import find_subject
from bodyscan.mesh.body import HAIR, SKIN, BodyCloud
from bodyscan.report.measures_section import show_measures
from bodyscan.report.model import Layer, pack
from bodyscan.report.page import Column, render
from bodyscan.report.result_page import build_page
from bodyscan.report.scan_page import make_colour_layers


@pytest.fixture(scope="module")
def scan(tmp_path_factory: pytest.TempPathFactory) -> MadeScan:
    return make_scan(tmp_path_factory.mktemp("workspace") / "scan")


@pytest.fixture(scope="module")
def html(scan: MadeScan) -> str:
    result = CliRunner().invoke(app, ["report", str(scan.folder)])
    assert result.exit_code == 0, result.output
    return (scan.folder / "report.html").read_text("utf-8")


def test_the_verdict_comes_first_with_its_reason_as_text(html: str) -> None:
    body = html[html.index("<body>") :]
    assert "Verdict: usable" in body
    assert "the person moved by 3.4 mm &lt;/script&gt;&lt;b&gt;" in body
    assert body.index("Verdict") < body.index("<canvas") < body.index("Holes</h2>")
    assert "no light" in body


def test_what_the_person_did_is_said_part_by_part(html: str) -> None:
    body = html[html.index("<h2") :]
    assert "The person moved 5 mm while being scanned; corrected to 0.17 mm." in body
    assert "as of 1.04 s after the scan began" in body
    assert "left arm" in body
    assert "breath of 2.2 mm, corrected to one moment" in body
    assert "were 1.3 +- 0.4 mm behind their position at mean breath" in body


def test_a_report_elsewhere_is_found_when_its_subject_is_forgotten(
    scan: MadeScan, tmp_path: Path
) -> None:
    path = tmp_path / "elsewhere" / "r.html"
    result = CliRunner().invoke(app, ["report", str(scan.folder), "--out", str(path)])
    assert result.exit_code == 0, result.output
    assert path in find_subject("s-17", tmp_path).files
    assert find_subject("s-18", tmp_path).files == ()


def test_nothing_lies_outside_of_the_file(html: str) -> None:
    assert len(html) < 8_000_000
    assert re.findall(r"""(?:src|href)=["'](?!data:|#)""", html) == []
    assert "default-src 'none'" in html
    assert "@import" not in html
    assert "compliant" not in html.lower()


def test_when_it_was_taken_is_said_as_people_say_it(html: str) -> None:
    assert "21 November 2026, 10:00" in html
    assert "2026-11-21T10:00" not in html[html.index("<body>") :]


def test_the_same_result_gives_the_same_bytes(scan: MadeScan, html: str) -> None:
    assert render(build_page(scan.folder)) == html


def test_simulated_is_said_and_only_where_it_is_known(tmp_path: Path, html: str) -> None:
    assert "synthetic" not in html[html.index("<body>") :]
    beside = make_scan(tmp_path / "w" / "scan")
    write_json(tmp_path / "w" / "truth" / "truth.json", {})
    assert build_page(beside.folder).synthetic
    elsewhere = make_scan(tmp_path / "x" / "scan", subject="sim-woman").folder
    assert not build_page(elsewhere).synthetic  # a person's pseudonym may begin so
    facts = json.loads((elsewhere / "scan.json").read_text("utf-8"))
    write_json(elsewhere / "scan.json", facts | {"simulated": True})
    assert build_page(elsewhere).synthetic


def test_the_body_is_packed_to_a_fraction_of_a_millimetre(html: str, scan: MadeScan) -> None:
    script = re.search(r'<script type="application/json">(.*?)</script>', html)
    assert script is not None
    model = json.loads(script[1])
    whole = np.frombuffer(base64.b64decode(model["positions"]), "<u2").reshape(-1, 3)
    vertices = np.array(model["low"]) + model["step"] * whole
    faces = np.frombuffer(base64.b64decode(model["faces"]), "<u2").reshape(-1, 3)
    # 14,000 faces are few enough to be taken as they are: half a step of 1700 / 65535 mm is left.
    assert np.abs(vertices - scan.mesh.vertices).max() < 0.014
    assert np.array_equal(faces, scan.mesh.faces)
    names = [layer["name"] for layer in model["layers"]]
    assert names == ["photo", "shape", "pairs", "sigma", "filled"]
    orange = np.frombuffer(base64.b64decode(model["layers"][4]["colours"]), np.uint8).reshape(-1, 3)
    made_up = np.unique(scan.mesh.faces[scan.mesh.filled])
    assert np.array_equal(np.flatnonzero(orange[:, 0] == 255), made_up)


def test_what_covers_the_skin_is_a_layer_of_its_own() -> None:
    mesh = egg(20)
    hair = np.where(mesh.vertices[:, 2] > 1500.0, HAIR, SKIN).astype(np.uint8)
    cloud = BodyCloud(mesh.vertices, mesh.normals, mesh.sigma_mm, mesh.colours, mesh.colours[:, 0])
    *_, last = make_colour_layers(replace(mesh, regions=hair), mesh, cloud, None, 1.0)
    assert last.name == "regions"
    assert len(np.unique(last.colours, axis=0)) == 2


def test_a_mesh_too_large_for_its_indices_is_refused() -> None:
    many = np.zeros((65_537, 3))
    with pytest.raises(ValueError, match="65537"):
        pack(replace(egg(20), vertices=many), [Layer("", many.astype(np.uint8))])


def test_a_body_is_first_seen_from_before_wherever_it_faces() -> None:
    vertices, faces = standing_body(hanging(25.0))
    for heading in (0.0, -90.0, 150.0):
        turn = RigidTransform.from_rotation_vector([0.0, 0.0, np.radians(heading)], [0.0, 0.0, 0.0])
        upwards = np.zeros(vertices.shape, np.float32)
        body = replace(egg(20), vertices=turn.apply(vertices), faces=faces, normals=upwards)
        azimuth = np.degrees(pack(body)["view"]["azimuth"])
        assert azimuth == pytest.approx(heading + 25.0, abs=3.0)


def test_a_larger_body_lies_outside_of_a_smaller_one(tmp_path: Path) -> None:
    small, large = make_scan(tmp_path / "small"), make_scan(tmp_path / "large", grown_mm=0.5)
    standing, laid = compare_surfaces(large.mesh, small.folder)
    assert (standing.fitted, laid.fitted) == (False, True)
    # A vertex went outwards by 0.5 mm of its place on the unit sphere; the normal has its share of it.
    place = (small.mesh.vertices[standing.vertices] - MIDDLE_MM) / SEMI_AXES_MM
    normal = place / SEMI_AXES_MM / np.linalg.norm(place / SEMI_AXES_MM, axis=1, keepdims=True)
    expected = 0.5 * np.sum(place * normal, axis=1)
    # Facets lie up to 0.03 mm inside of the egg whose vertices they join, where it is bent most.
    assert standing.signed_mm == pytest.approx(expected, abs=0.03)
    page = render(build_page(large.folder, small.folder))
    assert "Deviation map" in page
    assert "Compared with small" in page


def test_a_scan_without_a_model_has_a_report_of_why(tmp_path: Path) -> None:
    facts = {
        "schema": "bodyscan-scan",
        "version": 1,
        "software": "bodyscan 0.1.0",
        "calibration_id": "01",
        "subject": None,
        "when": None,
        "verdict": {"grade": "repeat", "reasons": ["nobody is in the scan volume"]},
    }
    write_json(tmp_path / "scan.json", facts)
    text = render(build_page(tmp_path))
    assert "Verdict: repeat" in text
    assert "nobody is in the scan volume" in text


@pytest.mark.parametrize("content", ["", "{}", "[]", '{"schema": "bodyscan-scan"}'])
def test_what_is_no_result_is_said(tmp_path: Path, content: str) -> None:
    with pytest.raises(BadInput, match="neither"):
        build_page(tmp_path)
    (tmp_path / "scan.json").write_text(content)
    with pytest.raises(ResultError, match="not a readable scan"):
        build_page(tmp_path)
    (tmp_path / "scan.json").unlink()
    write_json(tmp_path / "scan" / "scan.json", {})  # a batch's job holds it so
    for near in (tmp_path, tmp_path / "scan" / "mesh.ply"):
        near.touch()
        with pytest.raises(ResultError, match=r"give .*scan, which holds one"):
            read_facts(near) if near.is_file() else build_page(near)


def test_a_slip_of_the_pen_is_not_taken_for_the_folder_above(scan: MadeScan) -> None:
    with pytest.raises(BadInput, match="no such file"):
        build_page(scan.folder / "scam.json")
    with pytest.raises(BadInput, match="neither"):
        build_page(scan.folder / "mesh.ply")
    assert build_page(scan.folder / "scan.json").title == "Scan of s-17"


def test_limits_are_kept_or_not() -> None:
    assert Column("n", "mm", "", 0.4).mark(0.4) == "good"
    assert Column("n", "mm", "", 0.4).mark(0.41) == "bad"
    assert Column("n", "", "", 6, at_least=True).mark(7) == "good"
    assert Column("n", "", "", 6).mark(None) == ""
    assert Column("n", "mm", "").limit_text == "–"


@pytest.fixture(scope="module")
def executable() -> str:
    found = find_browser()
    if found is None:
        missing("no chromium here (apt-get install chromium)")
    return found


def test_a_browser_shows_the_body_and_turns_it(
    scan: MadeScan, html: str, executable: str, tmp_path: Path
) -> None:
    with browser_page(executable, tmp_path / "profile") as page:
        page.open(scan.folder / "report.html")
        page.evaluate("document.querySelector('.stage').scrollIntoView()")
        page.settle()
        box = page.box("canvas")
        before = page.picture(box)
        top = page.evaluate("document.querySelector('canvas').getBoundingClientRect().y")
        page.drag((box[0] + 0.5 * box[2], top + 0.5 * box[3]), (180.0, 0.0))
        after = page.picture(box)
        page.evaluate("document.querySelectorAll('.layers button')[4].click()")
        page.settle()
        filled = page.picture(box)
        pdf = page.pdf()
        requests, errors = page.requests, page.errors
    assert [url for url in requests if not url.startswith(("data:", "file:"))] == []
    assert len([url for url in requests if url.startswith("file:")]) == 1
    assert [error for error in errors if "GPU stall" not in error] == []
    assert coloured(before) > 10_000  # of 660,000: an egg that stands upright in the middle
    assert moved(before, after) > 3_000
    assert moved(after, filled) > 3_000
    orange = np.all(np.abs(filled.astype(int) - [60, 160, 255]) < 90, axis=-1)
    assert orange.sum() > 30
    assert pdf.startswith(b"%PDF")


def coloured(picture: np.ndarray) -> int:
    """Pixels with a colour of their own: paper and words are grey, the egg is tinted."""
    hsv = cv2.cvtColor(picture, cv2.COLOR_BGR2HSV)
    return int(np.count_nonzero(hsv[..., 1] > 60))


def moved(first: np.ndarray, second: np.ndarray) -> int:
    """Pixels that differ visibly."""
    return int(np.count_nonzero(np.abs(first.astype(int) - second).max(axis=-1) > 25))


def test_the_footer_says_where_the_rig_frame_lies(tmp_path: Path) -> None:
    folder = make_scan(tmp_path).folder
    facts = json.loads((folder / "scan.json").read_text("utf-8"))
    del facts["sha256"]  # no model, and a quick report
    for axes in ("origin on the floor", "that of camera L"):
        write_json(folder / "scan.json", facts | Origin("01", None, None, axes=axes).facts)
        assert f"Rig frame: {axes}. This" in render(build_page(folder))


def test_measurements_are_written_as_csv_by_their_suffix(tmp_path: Path) -> None:
    scan = make_scan(tmp_path / "scan")
    for name in ("girths.csv", "girths.json"):
        assert run("measure", scan.folder, "--anyway", "--out", tmp_path / name).exit_code == 0
    whole = json.loads((tmp_path / "girths.json").read_text("utf-8"))
    with (tmp_path / "girths.csv").open(newline="", encoding="utf-8") as stream:
        rows = list(csv.DictReader(stream))
    girths = [girth for level in whole["slices"] for girth in level["girths"]]
    assert len(rows) == len(girths) > 3
    for row, girth in zip(rows, girths, strict=True):
        assert float(row["tape_mm"]) == girth["tape_mm"]
        assert [float(row["tape_low_mm"]), float(row["tape_high_mm"])] == girth["tape_range_mm"]
        assert float(row["stature_mm"]) == whole["stature_mm"]
    beside = json.loads((tmp_path / "girths.csv.json").read_text("utf-8"))
    assert beside == {"subject": whole["subject"]}


def test_landmarks_that_cannot_be_written_are_refused_before_reading(tmp_path: Path) -> None:
    for options, name, said in (
        (["--named"], "landmarks.xyz", "cannot be written as '.xyz'"),
        ([], "landmarks.csv", "needs --named"),
    ):
        refused = run("measure", tmp_path, *options, "--landmarks", name)
        assert said in str(refused.exception)


def test_a_body_that_the_jobs_measures_did_not_fit_is_not_fitted_again(tmp_path: Path) -> None:
    (tmp_path / "measures").mkdir()
    write_json(tmp_path / "measures" / "measurements.json", {"slices": []})
    no_scan: Any = None
    with pytest.raises(BadInput, match=r"measures\.csv says why"):
        show_measures(no_scan, tmp_path / "scan")
