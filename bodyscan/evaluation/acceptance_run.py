"""Artefacts measured as a person is: captures decoded, placed by the calibration, merged, judged."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bodyscan.calibration.rig_calibration import RigCalibration
from bodyscan.capture.folder import Captures
from bodyscan.errors import BodyscanError
from bodyscan.evaluation import acceptance
from bodyscan.evaluation.acceptance_file import AcceptanceFile
from bodyscan.fusion.cleaning import clean
from bodyscan.fusion.merging import merge
from bodyscan.progress import Progress, silent
from bodyscan.reconstruction.pairs import range_images

Array = NDArray[np.float64]

ALL = "all pairs"
POINTS = 200_000
FEWEST_OF_ONE = 400
"""A single pair's sphere or plate is judged from so many points on."""


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
    """All that was read.  problems: places where an artefact was not found, or not by all."""

    spheres: tuple[SphereRow, ...] = ()
    spacings: tuple[SpacingRow, ...] = ()
    plates: tuple[PlateRow, ...] = ()
    problems: tuple[str, ...] = ()

    def __add__(self, other: Readings) -> Readings:
        return Readings(
            self.spheres + other.spheres,
            self.spacings + other.spacings,
            self.plates + other.plates,
            self.problems + other.problems,
        )


@dataclass(frozen=True)
class Figure:
    """One figure of the test: its largest value, where that was, and the limit if one was given."""

    name: str
    value_mm: float | None
    where: str
    limit_mm: float | None
    meaning: str

    @property
    def exceeded(self) -> bool:
        """A limit on what was not measured is not kept either."""
        return self.limit_mm is not None and (
            self.value_mm is None or abs(self.value_mm) > self.limit_mm
        )


@dataclass(frozen=True, eq=False)
class _Cloud:
    view: str
    points: Array
    normals: Array


def read_spheres(
    calibration: RigCalibration,
    captures: Captures,
    place: str,
    file: AcceptanceFile,
    progress: Progress = silent,
) -> Readings:
    """Every shot of a folder of the spheres at one place."""
    centres, radius = np.array(file.spheres.centres_mm), file.spheres.radius_mm
    total = Readings()
    for shot in captures.shots:
        try:
            merged, *single = _clouds(calibration, captures, shot, progress)
            near = acceptance.locate_spheres(merged.points, merged.normals, radius, centres)
            read = [acceptance.read_sphere(merged.points, merged.normals, s, radius) for s in near]
        except BodyscanError as error:
            total += Readings(problems=(f"{place}, {shot}: {error.what}",))
            continue
        rows = [_row(place, shot, ALL, k, one) for k, one in enumerate(read, start=1)]
        for cloud in single:
            rows += _of_one(cloud, place, shot, read, radius)
        pairs = combinations(range(1, len(centres) + 1), 2)
        errors = acceptance.spacing_errors(read, centres)
        spacings = tuple(
            SpacingRow(place, shot, f"{a}-{b}", float(error))
            for (a, b), error in zip(pairs, errors, strict=True)
        )
        total += Readings(tuple(rows), spacings)
    return total


def read_plates(
    calibration: RigCalibration,
    captures: Captures,
    place: str,
    file: AcceptanceFile,
    progress: Progress = silent,
) -> Readings:
    """Every shot of a folder of the plate at one place."""
    width, height = file.plate.size_mm
    total = Readings()
    for shot in captures.shots:
        try:
            clouds = _clouds(calibration, captures, shot, progress)
            read = [(clouds[0].view, acceptance.read_plate(clouds[0].points, clouds[0].normals))]
        except BodyscanError as error:
            total += Readings(problems=(f"{place}, {shot}: {error.what}",))
            continue
        for cloud in clouds[1:]:
            if len(cloud.points) >= FEWEST_OF_ONE:
                try:
                    read.append((cloud.view, acceptance.read_plate(cloud.points, cloud.normals)))
                except BodyscanError:
                    continue  # it sees an edge of it alone
        rows = tuple(
            PlateRow(
                place,
                shot,
                view,
                one.points,
                one.flatness_mm,
                one.rms_mm,
                100.0 * one.area_mm2 / (width * height),
            )
            for view, one in read
        )
        total += Readings(plates=rows)
    return total


def figures(readings: Readings, file: AcceptanceFile) -> list[Figure]:
    """The test's figures, the worst of all places and shots, with their limits."""
    merged = [row for row in readings.spheres if row.view == ALL]
    single = [row for row in readings.spheres if row.view != ALL]
    plates = [row for row in readings.plates if row.view == ALL]
    alone = [row for row in readings.plates if row.view != ALL]
    found = (
        ("probing_form_mm", _worst(merged, "form_mm"),
         "range of the points' distances from the best sphere, all pairs merged, 3 in 1000 points "
         "left out"),
        ("probing_size_mm", _worst(merged, "size_mm"),
         "diameter of the best sphere less the calibrated diameter"),
        ("sphere_spacing_mm", _worst(readings.spacings, "error_mm"),
         "distance of two spheres' centres less the calibrated distance"),
        ("flatness_mm", _worst(plates, "flatness_mm"),
         "range of the points' distances from the best plane, all pairs merged, 3 in 1000 points "
         "left out"),
        ("repeatability_mm", _repeatability(readings.spacings),
         "range of one distance between spheres over repeated shots at one place"),
        ("single_probing_form_mm", _worst(single, "form_mm"),
         "probing form of one pair by itself, not merged"),
        ("single_flatness_mm", _worst(alone, "flatness_mm"),
         "flatness by one pair by itself, not merged"),
    )  # fmt: skip
    return [
        Figure(name, value, where, getattr(file.limits, name), meaning)
        for name, (value, where), meaning in found
    ]


def document(
    readings: Readings, found: Sequence[Figure], file: AcceptanceFile, **origin: Any
) -> dict[str, Any]:
    """What acceptance.json holds."""
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


def _clouds(
    calibration: RigCalibration, captures: Captures, shot: str, progress: Progress
) -> list[_Cloud]:
    """All pairs' points merged as a scan's are (without alignment), then each pair's own, rig
    frame. Raises ScanFailed."""
    one = replace(captures, shots=(shot,), sequences=captures.of_shot(shot))
    images, _ = range_images(calibration, one, progress)
    cleaned = clean(images, calibration.rig_from_camera, calibration.rig.volume)
    seen = [image for image in cleaned if image.valid.any()]
    cloud = merge(seen, calibration.rig_from_camera, points=POINTS)
    found = [_Cloud(ALL, cloud.points, cloud.normals.astype(np.float64))]
    for image in seen:
        valid = image.valid & np.isfinite(image.normals).all(axis=-1)
        placing = calibration.rig_from_camera[image.pair]
        found.append(
            _Cloud(
                image.pair,
                placing.apply(image.points[valid].astype(np.float64)),
                placing.rotate(image.normals[valid].astype(np.float64)),
            )
        )
    return found


def _of_one(
    cloud: _Cloud,
    place: str,
    shot: str,
    merged: Sequence[acceptance.SphereReading],
    radius_mm: float,
) -> Iterator[SphereRow]:
    for k, sphere in enumerate(merged, start=1):
        try:
            one = acceptance.read_sphere(cloud.points, cloud.normals, sphere.fitted, radius_mm)
        except BodyscanError:
            continue  # this pair does not see it
        if one.points >= FEWEST_OF_ONE:
            yield _row(place, shot, cloud.view, k, one)


def _row(place: str, shot: str, view: str, sphere: int, one: acceptance.SphereReading) -> SphereRow:
    return SphereRow(place, shot, view, sphere, one.points, one.form_mm, one.shell_mm, one.size_mm)


def _worst(rows: Sequence[Any], name: str) -> tuple[float | None, str]:
    if not rows:
        return None, "not measured"
    row = max(rows, key=lambda one: abs(getattr(one, name)))
    view = getattr(row, "view", ALL)
    return getattr(row, name), ", ".join([row.place, row.shot, *([view] if view != ALL else [])])


def _repeatability(rows: Sequence[SpacingRow]) -> tuple[float | None, str]:
    groups: dict[tuple[str, str], list[float]] = {}
    for row in rows:
        groups.setdefault((row.place, row.between), []).append(row.error_mm)
    ranges = {key: max(own) - min(own) for key, own in groups.items() if len(own) > 1}
    if not ranges:
        return None, "not repeated"
    (place, between), value = max(ranges.items(), key=lambda item: item[1])
    return value, f"{place}, spheres {between}"
