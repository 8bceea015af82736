"""Measure artefacts as a person is measured: decode, place by the calibration, merge, judge."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from bodyscan.arrays import Array
from bodyscan.captures.folder import Captures
from bodyscan.errors import BodyscanError
from bodyscan.evaluation import artefacts
from bodyscan.evaluation.acceptance_file import AcceptanceFile
from bodyscan.evaluation.acceptance_readings import (
    ALL,
    PlateRow,
    Readings,
    SpacingRow,
    SphereRow,
)
from bodyscan.fusion.cleaning import clean
from bodyscan.fusion.merging import merge
from bodyscan.progress import Progress, silent
from bodyscan.registration.rig_calibration import RigCalibration
from bodyscan.settings import FusionSettings
from bodyscan.workflows.range_images import reconstruct_range_images

FUSION = FusionSettings(points=200_000)  # about 3,000 of them on a sphere of 60 mm
FEWEST_OF_ONE = 400
"""Fewest points from which a single pair's sphere or plate is judged."""


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
    """Read every shot of a folder of the spheres at one place."""
    centres, radius = np.array(file.spheres.centres_mm), file.spheres.radius_mm

    def read(shot: str, clouds: Sequence[_Cloud]) -> Readings:
        merged, *single = clouds
        near = artefacts.locate_spheres(merged.points, merged.normals, radius, centres)
        read = [artefacts.read_sphere(merged.points, merged.normals, s, radius) for s in near]
        artefacts.require_spheres(read, radius, centres)
        rows = [_row(place, shot, ALL, k, one) for k, one in enumerate(read, start=1)]
        for cloud in single:
            rows += _of_one(cloud, place, shot, read, radius)
        pairs = combinations(range(1, len(centres) + 1), 2)
        errors = artefacts.spacing_errors(read, centres)
        spacings = tuple(
            SpacingRow(place, shot, f"{a}-{b}", float(error))
            for (a, b), error in zip(pairs, errors, strict=True)
        )
        return Readings(tuple(rows), spacings)

    return _each_shot(calibration, captures, place, read, progress)


def read_plates(
    calibration: RigCalibration,
    captures: Captures,
    place: str,
    file: AcceptanceFile,
    progress: Progress = silent,
) -> Readings:
    """Read every shot of a folder of the plate at one place."""
    width, height = file.plate.size_mm

    def row(shot: str, cloud: _Cloud) -> PlateRow:
        one = artefacts.read_plate(cloud.points, cloud.normals)
        share = 100.0 * one.area_mm2 / (width * height)
        return PlateRow(place, shot, cloud.view, one.points, one.flatness_mm, one.rms_mm, share)

    def read(shot: str, clouds: Sequence[_Cloud]) -> Readings:
        rows = [row(shot, clouds[0])]
        for cloud in clouds[1:]:
            if len(cloud.points) >= FEWEST_OF_ONE:
                with suppress(BodyscanError):  # this pair sees only an edge of it
                    rows.append(row(shot, cloud))
        return Readings(plates=tuple(rows))

    return _each_shot(calibration, captures, place, read, progress)


def _each_shot(
    calibration: RigCalibration,
    captures: Captures,
    place: str,
    read: Callable[[str, Sequence[_Cloud]], Readings],
    progress: Progress,
) -> Readings:
    """Sum `read` over the clouds of every shot; a shot that fails is listed as a problem."""
    total = Readings()
    for shot in captures.shots:
        try:
            total += read(shot, _clouds(calibration, captures, shot, progress))
        except BodyscanError as error:
            said = "; ".join(filter(None, (error.what, error.remedy)))
            total += Readings(problems=(f"{place}, {shot}: {said}",))
    return total


def _clouds(
    calibration: RigCalibration, captures: Captures, shot: str, progress: Progress
) -> list[_Cloud]:
    """All pairs' points merged like a scan's (without alignment), then each pair's own; rig frame.

    Raises ScanFailed.
    """
    one = replace(captures, shots=(shot,), sequences=captures.of_shot(shot))
    images = reconstruct_range_images(calibration, one, progress).value
    cleaned = clean(images, calibration.rig_from_camera, calibration.rig.volume)
    seen = [image for image in cleaned if image.valid.any()]
    cloud = merge(seen, calibration.rig_from_camera, FUSION).cloud
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
    merged: Sequence[artefacts.SphereReading],
    radius_mm: float,
) -> Iterator[SphereRow]:
    for k, sphere in enumerate(merged, start=1):
        try:
            one = artefacts.read_sphere(cloud.points, cloud.normals, sphere.fitted, radius_mm)
        except BodyscanError:
            continue  # this pair does not see it
        if one.points >= FEWEST_OF_ONE:
            yield _row(place, shot, cloud.view, k, one)


def _row(place: str, shot: str, view: str, sphere: int, one: artefacts.SphereReading) -> SphereRow:
    return SphereRow(place, shot, view, sphere, one.points, one.form_mm, one.shell_mm, one.size_mm)
