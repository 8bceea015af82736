"""Artefacts of known size among points of known error: every figure against what was put in."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from bodyscan.arrays import Array
from bodyscan.cli.main import app
from bodyscan.errors import BadInput, FailedWork
from bodyscan.evaluation.acceptance import (
    ALL,
    PlateRow,
    Readings,
    SpacingRow,
    SphereRow,
    figures,
    load_acceptance,
)
from bodyscan.evaluation.artefacts import (
    locate_spheres,
    read_plate,
    read_sphere,
    require_spheres,
    spacing_errors,
)
from bodyscan.evaluation.primitives import Sphere
from bodyscan.workflows import accept_rig

RADIUS = 60.0
CENTRES = np.array([[0.0, 0.0, 0.0], [400.0, 0.0, 0.0], [0.0, 250.0, 150.0]])
AT = np.array([-120.0, 80.0, 1100.0])


def ball(
    centre: Array | list[float],
    radius: float,
    count: int = 20_000,
    wave_mm: float = 0.0,
    seed: int = 0,
) -> tuple[Array, Array]:
    """Points all over a ball, waved by so much to either side, and outward normals."""
    normals = np.random.default_rng(seed).normal(size=(count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    wave = wave_mm * np.sin(12.0 * np.arctan2(normals[:, 1], normals[:, 0]))
    return np.asarray(centre) + (radius + wave)[:, None] * normals, normals


def test_form_and_size_are_what_was_put_in() -> None:
    points, normals = ball(AT, RADIUS + 0.2, wave_mm=0.1)
    read = read_sphere(points, normals, Sphere(AT + 0.5, RADIUS), RADIUS)
    assert read.size_mm == pytest.approx(0.4, abs=0.005)
    # Waves of 0.1 mm to either side: all of their range, but for the 3 in 1000 farthest off.
    assert read.form_mm == pytest.approx(0.2, abs=0.005)
    # The narrowest shell leaves out one crest or half of each: sin is beyond x in arccos(x)/pi.
    assert read.shell_mm == pytest.approx(0.1 * (1.0 + np.cos(0.1 * np.pi)), abs=0.004)
    assert np.linalg.norm(read.fitted.centre - AT) < 0.01


def test_three_in_a_thousand_may_be_left_out_but_no_more() -> None:
    points, normals = ball(AT, RADIUS)
    few, many = points.copy(), points.copy()
    few[:50] += 3.0 * normals[:50]
    many[:100] += 3.0 * normals[:100]
    near = Sphere(AT, RADIUS)
    assert read_sphere(few, normals, near, RADIUS).form_mm < 0.02
    assert read_sphere(many, normals, near, RADIUS).form_mm == pytest.approx(3.0, abs=0.05)


def test_a_stand_is_no_part_of_its_sphere() -> None:
    points, normals = ball(AT, RADIUS)
    angle, zero = np.linspace(0.0, 100.0 * np.pi, 4000), np.zeros(4000)
    outward = np.stack([np.cos(angle), np.sin(angle), zero], axis=1)
    down = np.linspace(RADIUS - 3.0, RADIUS + 40.0, 4000)
    stand = AT + 12.0 * outward - np.stack([zero, zero, down], axis=1)
    both = np.concatenate([points, stand]), np.concatenate([normals, outward])
    read = read_sphere(*both, Sphere(AT, RADIUS), RADIUS)
    assert read.points == len(points)
    assert read.form_mm < 0.01


def test_spheres_are_told_apart_whatever_their_order() -> None:
    turn = np.array([[0.0, -1, 0], [0.6, 0, -0.8], [0.8, 0, 0.6]])
    places = (1.001 * CENTRES) @ turn.T + AT
    parts = [ball(places[k], RADIUS, seed=k) for k in (2, 0, 1)]
    points = np.concatenate([part[0] for part in parts])
    normals = np.concatenate([part[1] for part in parts])
    found = locate_spheres(points, normals, RADIUS, CENTRES)
    assert np.stack([one.centre for one in found]) == pytest.approx(places, abs=0.05)
    read = [read_sphere(points, normals, one, RADIUS) for one in found]
    errors = spacing_errors(read, CENTRES)
    # A scale of 1.001 makes every distance longer by a thousandth.
    pairs = ((0, 1), (0, 2), (1, 2))
    expected = [0.001 * np.linalg.norm(CENTRES[a] - CENTRES[b]) for a, b in pairs]
    assert errors == pytest.approx(expected, abs=0.02)

    with pytest.raises(FailedWork, match="1 spheres of radius 60 mm found, 3 were expected"):
        locate_spheres(*parts[0], RADIUS, CENTRES)


@pytest.mark.parametrize(
    ("squeeze", "apart", "said"),
    [
        (0.8, 1.0, "sphere 1 of radius 60 mm was not found: .* lies in a shell of"),
        (1.0, 0.7, "between two candidates is off by -150 mm"),
    ],
)
def test_what_is_no_sphere_or_stands_elsewhere_is_not_read(
    squeeze: float, apart: float, said: str
) -> None:
    """A head is an egg. A rig of a wrong size, some hundredths, has its spheres read."""
    centres = np.array([[0.0, 0.0, 0.0], [500.0, 0.0, 0.0]])
    read = []
    for k, centre in enumerate(apart * centres):
        points, normals = ball(centre, RADIUS, seed=k)
        points = centre + (points - centre) * [squeeze, 1.0, 1.0]
        read.append(read_sphere(points, normals, Sphere(centre, RADIUS), RADIUS))
    with pytest.raises(FailedWork, match=said):
        require_spheres(read, RADIUS, centres)
    scaled = [
        replace(one, fitted=Sphere(1.05 * at, RADIUS), shell_mm=2.9)
        for one, at in zip(read, centres, strict=True)
    ]
    require_spheres(scaled, RADIUS, centres)


def plate(wave_mm: float = 0.0) -> tuple[Array, Array]:
    """400 x 300 mm, tilted, with a rim that curls up by 3 mm, and clutter beside it."""
    rng = np.random.default_rng(3)
    u, v = rng.uniform(-200.0, 200.0, 40_000), rng.uniform(-150.0, 150.0, 40_000)
    off = wave_mm * np.cos(u / 15.0)  # even: no plane tilts to meet it
    at_rim = np.minimum(200.0 - np.abs(u), 150.0 - np.abs(v)) < 12.0 - 4.0
    off[at_rim] += 3.0
    along, up = np.array([0.8, 0.6, 0.0]), np.array([0.0, 0.28, 0.96])
    up = up - (up @ along) * along
    up /= np.linalg.norm(up)
    surface = u[:, None] * along + v[:, None] * up + off[:, None] * np.cross(along, up)
    clutter, outward = ball([300.0, 0.0, 900.0], 80.0, 8000)
    normals = np.broadcast_to(np.cross(along, up), surface.shape)
    return np.concatenate([surface + AT, clutter]), np.concatenate([normals, outward])


def test_flatness_is_what_was_put_in_and_the_rim_is_left_out() -> None:
    read = read_plate(*plate(wave_mm=0.15))
    assert read.flatness_mm == pytest.approx(0.3, abs=0.02)
    assert read.rms_mm == pytest.approx(0.15 / np.sqrt(2.0), abs=0.01)
    assert read.area_mm2 == pytest.approx(400.0 * 300.0, rel=0.02)


def test_no_plate_is_said() -> None:
    with pytest.raises(FailedWork, match="too few"):
        read_plate(*(part[:100] for part in plate()))
    with pytest.raises(FailedWork, match="no plate"):
        read_plate(*ball(AT, 30.0, 200_000))
    with pytest.raises(FailedWork, match=r"the flattest surface is [12].* mm RMS off a plane"):
        read_plate(*plate(wave_mm=3.0))


def sphere_row(**more: Any) -> SphereRow:
    row = SphereRow("a", "s01", ALL, 1, 5000, 0.3, 0.2, 0.1)
    return replace(row, **more)


def test_the_worst_of_all_places_is_judged() -> None:
    readings = Readings(
        (sphere_row(), sphere_row(place="b", size_mm=-0.4), sphere_row(view="p1", form_mm=2.0)),
        (
            SpacingRow("a", "s01", "1-2", 0.1),
            SpacingRow("a", "s02", "1-2", 0.25),
            SpacingRow("b", "s01", "1-2", -0.2),
        ),
        (PlateRow("a", "s01", "p1", 900, 0.9, 0.1, 80.0),),
    )
    file = load_acceptance(
        None, {"probing_size_mm": 0.4, "sphere_spacing_mm": 0.2, "flatness_mm": 1.0}
    )
    found = {one.name: one for one in figures(readings, file)}
    assert (found["probing_size_mm"].value_mm, found["probing_size_mm"].where) == (-0.4, "b, s01")
    assert not found["probing_size_mm"].exceeded
    assert found["sphere_spacing_mm"].value_mm == 0.25
    assert found["sphere_spacing_mm"].exceeded
    assert found["repeatability_mm"].value_mm == pytest.approx(0.15)
    assert found["probing_form_mm"].value_mm == 0.3  # by all pairs, not by one
    assert found["single_probing_form_mm"].value_mm == 2.0
    # Nothing measured the plate by all pairs: a limit on it is not kept.
    assert found["flatness_mm"].value_mm is None
    assert found["flatness_mm"].exceeded


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
    "arguments",
    [
        [],
        ["--spheres", "a"],
        ["--spheres", "a", "--limit", "flatness_mm=flat"],
    ],
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
    readings = Readings((sphere_row(),), (), ())
    file = load_acceptance(None, {"probing_size_mm": 0.4})

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

    monkeypatch.setattr(accept_rig, "acceptance_page", broken)
    again = judge()
    assert again.page is None
    assert not found.page.exists()
    assert len(again.notes) == 1
