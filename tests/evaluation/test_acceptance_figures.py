"""Artefacts read from points whose figures can be counted, and the worst of them judged."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from bodyscan.errors import FailedWork
from bodyscan.evaluation.acceptance import (
    ALL,
    Figure,
    PlateRow,
    Readings,
    SpacingRow,
    SphereRow,
    figures,
    grade_acceptance,
    make_acceptance_document,
)
from bodyscan.evaluation.artefacts import (
    compute_spacing_errors,
    locate_spheres,
    read_plate,
    read_sphere,
    require_spheres,
)
from bodyscan.evaluation.primitives import Sphere


class File:
    """Artefacts with limits for some figures."""

    class limits:
        probing_form_mm = 0.5
        probing_size_mm = None
        sphere_spacing_mm = 0.2
        flatness_mm = None
        repeatability_mm = 0.1
        single_probing_form_mm = None
        single_flatness_mm = 0.3


def sphere(place: str, view: str, form: float, size: float) -> SphereRow:
    return SphereRow(place, "s1", view, 1, 1000, form, 0.1, size)


def plate_row(place: str, view: str, flatness: float) -> PlateRow:
    return PlateRow(place, "s1", view, 1000, flatness, 0.1, 99.0)


READ = Readings(
    spheres=(
        sphere("a", ALL, 0.3, 0.1), sphere("b", ALL, 0.4, -0.2), sphere("b", "p1", 0.9, 0.7),
    ),
    spacings=(
        SpacingRow("a", "s1", "1-2", 0.05), SpacingRow("a", "s2", "1-2", -0.10),
        SpacingRow("b", "s1", "1-2", 0.15), SpacingRow("b", "s1", "2-3", 0.05),
        SpacingRow("b", "s2", "2-3", 0.12),
    ),
    plates=(plate_row("a", ALL, 0.2), plate_row("a", "p2", 0.31), plate_row("b", "p3", 0.25)),
)  # fmt: skip


def by_name(readings: Readings) -> dict[str, Figure]:
    return {one.name: one for one in figures(readings, File())}  # type: ignore[arg-type]


def test_each_figure_is_the_worst_of_its_kind_and_says_where() -> None:
    found = by_name(READ)
    assert {name: (one.value_mm, one.where, one.limit_mm) for name, one in found.items()} == {
        "probing_form_mm": (0.4, "b, s1", 0.5),
        "probing_size_mm": (-0.2, "b, s1", None),
        "sphere_spacing_mm": (0.15, "b, s1", 0.2),
        "flatness_mm": (0.2, "a, s1", None),
        # One distance at one place, from shot to shot: others are others.
        "repeatability_mm": (pytest.approx(0.15), "a, spheres 1-2", 0.1),
        "single_probing_form_mm": (0.9, "b, s1, p1", None),
        "single_flatness_mm": (0.31, "a, s1, p2", 0.3),
    }
    assert found["probing_form_mm"].title == "probing form"


def test_what_exceeds_its_limit_or_was_not_found_is_not_accepted() -> None:
    verdict = grade_acceptance(list(by_name(READ).values()), READ)
    assert verdict.grade == "not accepted"
    assert verdict.reasons == (
        "repeatability_mm: 0.150 mm (a, spheres 1-2), limit 0.1 mm",
        "single_flatness_mm: 0.310 mm (a, s1, p2), limit 0.3 mm",
    )
    kept = Readings(READ.spheres[:1], READ.spacings[2:4], READ.plates[:1])
    verdict = grade_acceptance(list(by_name(kept).values()), kept)
    assert verdict.reasons == (
        "repeatability_mm: not measured, though it has a limit",
        "single_flatness_mm: not measured, though it has a limit",
    )
    none: list[Figure] = [Figure("flatness_mm", 0.2, "a", 0.3, "")]
    assert grade_acceptance(none, Readings()).grade == "accepted"
    missed = Readings(problems=("place b: no plate",))
    assert grade_acceptance(none, missed).reasons == ("place b: no plate",)
    unjudged = [Figure("flatness_mm", 0.2, "a", None, "")]
    assert grade_acceptance(unjudged, Readings()).grade == "not judged"


def test_the_file_says_what_it_is_and_holds_every_figure_and_reading() -> None:
    class Described(File):
        def model_dump(self, mode: str) -> dict[str, str]:
            return {"mode": mode}

    file: Any = Described()
    found = make_acceptance_document(READ, figures(READ, file), file, synthetic=True)
    assert (found["schema"], found["version"]) == ("bodyscan-acceptance", 1)  # docs/formats.md
    assert found["synthetic"]
    assert found["artefacts"] == {"mode": "json"}
    assert found["figures"]["sphere_spacing_mm"]["value"] == 0.15
    assert not found["figures"]["sphere_spacing_mm"]["exceeded"]
    assert [len(found[rows]) for rows in ("spheres", "spacings", "plates")] == [3, 5, 3]


CENTRE, RADIUS = np.array([30.0, -20.0, 900.0]), 50.0


def directions(count: int) -> np.ndarray:
    """Evenly over a sphere (Fibonacci's spiral)."""
    k = np.arange(count) + 0.5
    z, angle = 1.0 - 2.0 * k / count, np.pi * (1.0 + np.sqrt(5.0)) * k
    across = np.sqrt(1.0 - z**2)
    return np.column_stack([across * np.cos(angle), across * np.sin(angle), z])


def test_form_is_the_range_without_three_in_a_thousand_and_size_the_diameters_error() -> None:
    out = directions(1000)
    off = np.linspace(-0.2, 0.2, 1000)[np.random.default_rng(0).permutation(1000)]
    off[[10, 500, 900]] = [3.0, -2.5, 2.0]
    points = CENTRE + (RADIUS + 0.05 + off)[:, None] * out
    found = read_sphere(points, out, Sphere(CENTRE + 1.0, RADIUS), RADIUS)
    assert found.points == 1000
    assert found.form_mm == pytest.approx(0.4, abs=0.02)  # those left out pull a little
    assert found.shell_mm == pytest.approx(0.36, abs=0.01)  # nine tenths of an even spread
    assert found.size_mm == pytest.approx(0.1, abs=0.01)
    np.testing.assert_allclose(found.fitted.centre, CENTRE, atol=0.02)  # 0.12 / sqrt(1000 / 3)
    off[700] = 1.5  # a fourth is one too many
    points = CENTRE + (RADIUS + 0.05 + off)[:, None] * out
    assert read_sphere(points, out, Sphere(CENTRE, RADIUS), RADIUS).form_mm > 1.5


def test_points_of_a_stand_are_not_the_spheres() -> None:
    out = directions(600)
    points = CENTRE + RADIUS * out
    rim = out[:40] * [1.0, 1.0, 0.0]
    for far, turned, own in (
        (1.14, out[:40], True), (1.16, out[:40], False), (0.86, out[:40], True),
        (0.84, out[:40], False), (1.0, -out[:40], False), (1.0, rim, False),
    ):  # fmt: skip
        more = CENTRE + far * RADIUS * out[:40]
        found = read_sphere(
            np.vstack([points, more]), np.vstack([out, turned]), Sphere(CENTRE, RADIUS), RADIUS
        )
        assert found.points == 600 + 40 * own


def test_spheres_are_told_apart_by_their_distances() -> None:
    wanted = np.array([[0.0, 0.0, 0.0], [300.0, 0.0, 0.0], [0.0, 200.0, 0.0]])
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    there = wanted @ turn.T + [100.0, 50.0, 900.0]
    out = directions(400)
    points = np.concatenate([centre + 30.0 * out for centre in there[[2, 0, 1]]])
    found = locate_spheres(points, np.tile(out, (3, 1)), 30.0, wanted)
    np.testing.assert_allclose([one.centre for one in found], there, atol=0.5)
    readings = [read_sphere(points, np.tile(out, (3, 1)), one, 30.0) for one in found]
    longer = wanted * [1.001, 0.999, 1.0]
    hypotenuse = np.hypot(300.0, 200.0) - np.hypot(300.3, 199.8)
    np.testing.assert_allclose(
        compute_spacing_errors(readings, longer), [-0.3, 0.2, hypotenuse], atol=0.01
    )


@pytest.mark.parametrize(
    ("squeeze", "separation_mm", "message"),
    [
        (0.8, 500.0, "sphere 1 of radius 50 mm was not found: .* lies in a shell of"),
        (1.0, 350.0, "between two candidates is off by -150 mm"),
    ],
)
def test_what_is_no_sphere_or_stands_elsewhere_is_not_read(
    squeeze: float, separation_mm: float, message: str
) -> None:
    """A head is an egg. A rig of a wrong size, some hundredths, has its spheres read."""
    out, wanted = directions(1000), np.array([[0.0, 0.0, 0.0], [500.0, 0.0, 0.0]])
    readings = [
        read_sphere(RADIUS * out * [squeeze, 1.0, 1.0] + at, out, Sphere(at, RADIUS), RADIUS)
        for at in np.array([[0.0, 0.0, 0.0], [separation_mm, 0.0, 0.0]])
    ]
    with pytest.raises(FailedWork, match=message):
        require_spheres(readings, RADIUS, wanted)
    scaled = [
        replace(reading, fitted=Sphere(1.05 * at, RADIUS), shell_mm=2.4)
        for reading, at in zip(readings, wanted, strict=True)
    ]
    require_spheres(scaled, RADIUS, wanted)


def plate(width: float = 300.0, height: float = 200.0, spacing: float = 4.0) -> np.ndarray:
    x, y = np.meshgrid(np.arange(0.0, width + 0.1, spacing), np.arange(0.0, height + 0.1, spacing))
    return np.column_stack([x.ravel(), y.ravel(), np.full(x.size, 700.0)])


UP = np.array([0.0, 0.0, 1.0])


def facing(points: np.ndarray) -> np.ndarray:
    return np.tile(UP, (len(points), 1))


def test_a_plate_is_read_without_its_rim() -> None:
    points = plate(spacing=5.0)
    off = np.where(np.arange(len(points)) % 2, 0.1, -0.1)
    at_rim = (points[:, 0] < 10) | (points[:, 0] > 290) | (points[:, 1] < 10) | (points[:, 1] > 190)
    points[:, 2] += off + np.where(at_rim, 1.0, 0.0)
    found = read_plate(points, facing(points))
    assert found.area_mm2 == pytest.approx(300.0 * 200.0, rel=1e-3)
    assert found.flatness_mm == pytest.approx(0.2, abs=0.01)
    assert found.rms_mm == pytest.approx(0.1, rel=0.05)
    # 12 mm off the rim: 5 mm apart, from 15 to 285 and from 15 to 185.
    assert found.points == 55 * 35


def test_what_lies_apart_stands_across_or_faces_away_is_not_the_plates() -> None:
    points = plate()
    alone = read_plate(points, facing(points))
    apart = plate(60.0, 60.0) + [325.0, 0.0, 0.0]  # two empty cells away
    wall = plate(100.0, 100.0)[:, [2, 0, 1]] * [0.2, 1.0, 1.0] + [0.0, 0.0, 705.0]
    inside = np.column_stack([np.full(50, 150.0), np.linspace(50, 150, 50), np.full(50, 703.0)])
    every = np.vstack([points, apart, wall, inside])
    normals = np.vstack(
        [facing(points), facing(apart), np.tile([1.0, 0, 0], (len(wall), 1)),
         np.tile([0.7, 0.0, 0.714], (50, 1))]
    )  # fmt: skip
    found = read_plate(every, normals)
    assert found.points == alone.points
    assert found.rms_mm == pytest.approx(0.0, abs=1e-9)


def test_too_few_points_and_no_plane_are_refused() -> None:
    with pytest.raises(FailedWork, match="299 points are too few"):
        read_plate(plate()[:299], facing(plate()[:299]))
    rng = np.random.default_rng(0)
    with pytest.raises(FailedWork, match="no plate"):
        read_plate(rng.uniform(0, 500, (2000, 3)), facing(plate()[:2000]))
    with pytest.raises(FailedWork, match="no plate"):
        read_plate(np.zeros((400, 3)), facing(plate()[:400]))
    waved = plate() + 3.0 * np.cos(plate()[:, :1] / 15.0) * UP
    with pytest.raises(FailedWork, match=r"the flattest surface is [12].* mm RMS off a plane"):
        read_plate(waved, facing(waved))
