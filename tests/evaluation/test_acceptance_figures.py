"""The figures of an acceptance test: the worst of what was read, each with its place and limit."""

from __future__ import annotations

from typing import Any

import pytest

from bodyscan.evaluation.acceptance import (
    ALL,
    Figure,
    PlateRow,
    Readings,
    SpacingRow,
    SphereRow,
    acceptance_document,
    figures,
    grade_acceptance,
)


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


def plate(place: str, view: str, flatness: float) -> PlateRow:
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
    plates=(plate("a", ALL, 0.2), plate("a", "p2", 0.31), plate("b", "p3", 0.25)),
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
    found = acceptance_document(READ, figures(READ, file), file, synthetic=True)
    assert (found["schema"], found["version"]) == ("bodyscan-acceptance", 1)  # docs/formats.md
    assert found["synthetic"]
    assert found["artefacts"] == {"mode": "json"}
    assert found["figures"]["sphere_spacing_mm"]["value"] == 0.15
    assert not found["figures"]["sphere_spacing_mm"]["exceeded"]
    assert [len(found[rows]) for rows in ("spheres", "spacings", "plates")] == [3, 5, 3]
