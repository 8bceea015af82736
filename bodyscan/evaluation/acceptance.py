"""An acceptance test: its file (artefacts as calibrated, limits), its readings, and their figures."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from bodyscan.errors import BadInput
from bodyscan.files.model import Model, Problem
from bodyscan.files.model_file import apply_settings, load_model
from bodyscan.rig.gauge import Vector
from bodyscan.verdict import Verdict

Positive = Annotated[float, Field(gt=0)]


class Spheres(Model):
    """Spheres on one carrier: their calibrated radius, and centres in the carrier's own frame."""

    radius_mm: Positive = 60.0
    centres_mm: tuple[Vector, ...] = Field(
        default=((0.0, 0.0, 0.0), (500.0, 0.0, 0.0)), min_length=1, max_length=6
    )

    def problems(self) -> Iterator[Problem]:
        for k, centre in enumerate(self.centres_mm):
            for j, other in enumerate(self.centres_mm[:k]):
                if np.linalg.norm(np.subtract(centre, other)) < 2.0 * self.radius_mm:
                    yield ("centres_mm", k), f"lies inside sphere {j + 1} (got {centre})"


class Plate(Model):
    """A flat plate: its width and height."""

    size_mm: tuple[Positive, Positive] = (400.0, 300.0)


class Limits(Model):
    """Largest values allowed, mm; figures without a limit are reported but not judged."""

    probing_form_mm: Positive | None = None
    probing_size_mm: Positive | None = None
    sphere_spacing_mm: Positive | None = None
    flatness_mm: Positive | None = None
    repeatability_mm: Positive | None = None
    single_probing_form_mm: Positive | None = None
    single_flatness_mm: Positive | None = None


class AcceptanceFile(Model):
    """The whole acceptance file."""

    version: Literal[1] = 1
    spheres: Spheres = Spheres()
    plate: Plate = Plate()
    limits: Limits = Limits()


def load_acceptance(path: Path | None, limits: Iterable[str] = ()) -> AcceptanceFile:
    """Read an acceptance file, or take the defaults if `path` is None, and change limits such as
    `flatness_mm=0.5`.

    Raises BadInput that names every problem.
    """
    file = AcceptanceFile()
    remedy = "Correct the acceptance file; docs/report.md explains every key."
    if path is not None:
        file = load_model(path, AcceptanceFile, BadInput, remedy=remedy)
    return apply_settings(file, (f"limits.{text}" for text in limits), BadInput)


ALL = "all pairs"


@dataclass(frozen=True)
class SphereRow:
    """One sphere in one shot, by all pairs together or by one; see `SphereReading`."""

    place: str
    shot: str
    view: str
    sphere: int
    points: int
    form_mm: float
    shell_mm: float
    size_mm: float


@dataclass(frozen=True)
class SpacingRow:
    """Distance of two spheres' centres less the calibrated one, by all pairs together."""

    place: str
    shot: str
    between: str
    error_mm: float


@dataclass(frozen=True)
class PlateRow:
    """The plate in one shot; see `PlateReading`."""

    place: str
    shot: str
    view: str
    points: int
    flatness_mm: float
    rms_mm: float
    measured_percent: float


@dataclass(frozen=True)
class Readings:
    """All readings.  problems: places where artefacts were not found, or not all of them."""

    spheres: tuple[SphereRow, ...] = ()
    spacings: tuple[SpacingRow, ...] = ()
    plates: tuple[PlateRow, ...] = ()
    problems: tuple[str, ...] = ()

    def __add__(self, other: Readings) -> Readings:
        return Readings(*(getattr(self, f.name) + getattr(other, f.name) for f in fields(self)))


@dataclass(frozen=True)
class Figure:
    """One figure of the test: its largest value, where that was, and the limit if one was given."""

    name: str
    value_mm: float | None
    where: str
    limit_mm: float | None
    meaning: str

    @property
    def title(self) -> str:
        """The name in words."""
        return self.name.removesuffix("_mm").replace("_", " ")

    @property
    def exceeded(self) -> bool:
        """Whether a limit is violated, which includes one on a figure that was not measured."""
        return self.limit_mm is not None and (
            self.value_mm is None or abs(self.value_mm) > self.limit_mm
        )


def figures(readings: Readings, file: AcceptanceFile) -> list[Figure]:
    """The test's figures, the worst over all places and shots, with their limits."""
    merged = [row for row in readings.spheres if row.view == ALL]
    single = [row for row in readings.spheres if row.view != ALL]
    plates = [row for row in readings.plates if row.view == ALL]
    alone = [row for row in readings.plates if row.view != ALL]
    found = (
        ("probing_form_mm", _find_worst(merged, "form_mm"),
         "range of the points' distances from the best sphere, all pairs merged, 3 in 1000 points "
         "left out"),
        ("probing_size_mm", _find_worst(merged, "size_mm"),
         "diameter of the best sphere less the calibrated diameter"),
        ("sphere_spacing_mm", _find_worst(readings.spacings, "error_mm"),
         "distance of two spheres' centres less the calibrated distance"),
        ("flatness_mm", _find_worst(plates, "flatness_mm"),
         "range of the points' distances from the best plane, all pairs merged, 3 in 1000 points "
         "left out"),
        ("repeatability_mm", _find_widest_range(readings.spacings),
         "range of one distance between spheres over repeated shots at one place"),
        ("single_probing_form_mm", _find_worst(single, "form_mm"),
         "probing form of one pair by itself, not merged"),
        ("single_flatness_mm", _find_worst(alone, "flatness_mm"),
         "flatness by one pair by itself, not merged"),
    )  # fmt: skip
    return [
        Figure(name, value, where, getattr(file.limits, name), meaning)
        for name, (value, where), meaning in found
    ]


def grade_acceptance(found: Sequence[Figure], readings: Readings) -> Verdict:
    """The verdict: not accepted if a limit is exceeded or an artefact was not read."""
    reasons = [
        f"{one.name}: {one.value_mm:.3f} mm ({one.where}), limit {one.limit_mm:g} mm"
        if one.value_mm is not None
        else f"{one.name}: not measured, though it has a limit"
        for one in found
        if one.exceeded
    ]
    reasons += readings.problems
    if reasons:
        return Verdict("not accepted", tuple(reasons))
    if all(one.limit_mm is None for one in found):
        return Verdict("not judged", ("no limits were given",))
    return Verdict("accepted")


def make_acceptance_document(
    readings: Readings, found: Sequence[Figure], file: AcceptanceFile, **origin: Any
) -> dict[str, Any]:
    """The content of acceptance.json."""
    return origin | {
        "schema": "bodyscan-acceptance",
        "version": 1,
        "units": "mm",
        "artefacts": file.model_dump(mode="json"),
        "figures": {
            one.name: {
                "value": one.value_mm,
                "where": one.where,
                "limit": one.limit_mm,
                "exceeded": one.exceeded,
                "meaning": one.meaning,
            }
            for one in found
        },
        "spheres": [asdict(row) for row in readings.spheres],
        "spacings": [asdict(row) for row in readings.spacings],
        "plates": [asdict(row) for row in readings.plates],
        "problems": readings.problems,
    }


def _find_worst(rows: Sequence[Any], name: str) -> tuple[float | None, str]:
    if not rows:
        return None, "not measured"
    row = max(rows, key=lambda one: abs(getattr(one, name)))
    view = getattr(row, "view", ALL)
    return getattr(row, name), ", ".join([row.place, row.shot, *([view] if view != ALL else [])])


def _find_widest_range(rows: Sequence[SpacingRow]) -> tuple[float | None, str]:
    """Largest range of a spacing's errors over its repetitions at one place, and where it is."""
    groups: dict[tuple[str, str], list[float]] = {}
    for row in rows:
        groups.setdefault((row.place, row.between), []).append(row.error_mm)
    ranges = {key: max(errors) - min(errors) for key, errors in groups.items() if len(errors) > 1}
    if not ranges:
        return None, "not repeated"
    (position, between), value = max(ranges.items(), key=lambda item: item[1])
    return value, f"{position}, spheres {between}"
