"""An acceptance test: read artefacts at several places, judge the readings, write the report."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import combinations, product
from pathlib import Path

import numpy as np

from bodyscan.arrays import Array
from bodyscan.captures.folder import Captures, open_scan
from bodyscan.errors import BadInput, BodyscanError
from bodyscan.evaluation import artefacts
from bodyscan.evaluation.acceptance import (
    ALL,
    AcceptanceFile,
    Figure,
    PlateRow,
    Readings,
    SpacingRow,
    SphereRow,
    figures,
    grade_acceptance,
    make_acceptance_document,
)
from bodyscan.files.atomic import write_json, write_text
from bodyscan.fusion.cleaning import clean
from bodyscan.fusion.merging import merge
from bodyscan.optional import optional
from bodyscan.progress import Progress, silent
from bodyscan.registration.rig_calibration import RigCalibration
from bodyscan.registration.storage import calibration_id
from bodyscan.report.acceptance_page import make_acceptance_page
from bodyscan.report.page import render
from bodyscan.settings import FusionSettings
from bodyscan.verdict import Verdict
from bodyscan.workflows.range_images import reconstruct_range_images

FILE_NAME = "acceptance.json"


@dataclass(frozen=True)
class Acceptance:
    """The result of an acceptance test."""

    figures: tuple[Figure, ...]  # the worst over all places, with their limits
    verdict: Verdict
    file: Path  # path of acceptance.json
    page: Path | None  # path of the report, None if it could not be made, as `notes` say
    notes: tuple[str, ...]


def refuse_existing_test(folder: Path, overwrite: bool) -> None:
    """Raise BadInput if `folder` holds a test that may not be replaced."""
    if (folder / FILE_NAME).exists() and not overwrite:
        raise BadInput(
            "holds an acceptance test already",
            where=str(folder),
            remedy="give another --out, or --overwrite to replace it",
        )


def read_captures(
    calibration: RigCalibration,
    spheres: Sequence[Path],
    plates: Sequence[Path],
    file: AcceptanceFile,
    progress: Progress = silent,
) -> Readings:
    """Read captured artefacts, one folder a place; a shot that fails is listed as a problem."""
    # Open them all before reading the first, so that a wrong folder fails before any work is done.
    sites = [
        (folder, open_scan(calibration.rig, folder), read)
        for folders, read in ((spheres, read_spheres), (plates, read_plates))
        for folder in folders
    ]
    total = Readings()
    for folder, captures, read in sites:
        for shot in captures.shots:
            try:
                clouds = _merge_clouds(calibration, captures, shot, progress)
                total += read(file, folder.name, shot, clouds)
            except BodyscanError as error:
                problem = "; ".join(filter(None, (error.what, error.remedy)))
                total += Readings(problems=(f"{folder.name}, {shot}: {problem}",))
    return total


def judge_readings(
    readings: Readings,
    file: AcceptanceFile,
    calibration: RigCalibration,
    stored: Path,
    out: Path,
    *,
    synthetic: bool,
) -> Acceptance:
    """Write figures and verdict to acceptance.json and acceptance.html in `out`, and return them.

    stored: path of the calibration.
    """
    found = figures(readings, file)
    origin = calibration_id(stored)
    content = make_acceptance_document(
        readings, found, file, synthetic=synthetic, calibration_id=origin
    )
    file_path, page_path = out / FILE_NAME, out / "acceptance.html"
    write_json(file_path, content)
    notes: list[str] = []
    page_path.unlink(missing_ok=True)  # left by an earlier test
    with optional("report", notes.append):
        page = make_acceptance_page(found, readings, calibration, origin, synthetic)
        write_text(page_path, render(page))
    verdict = grade_acceptance(found, readings)
    made = page_path if page_path.exists() else None
    return Acceptance(tuple(found), verdict, file_path, made, tuple(notes))


MIN_POINTS = 400
"""Points from which a single pair's sphere or plate is judged."""


_Cloud = tuple[str, Array, Array]
"""The points of all pairs, or of one: its name, points and normals (N, 3), rig frame."""


def read_spheres(file: AcceptanceFile, site: str, shot: str, clouds: Sequence[_Cloud]) -> Readings:
    """Read the spheres at one place in one shot."""
    centres, radius = np.array(file.spheres.centres_mm), file.spheres.radius_mm
    (_, points, normals), *single = clouds

    def row(view: str, k: int, one: artefacts.SphereReading) -> SphereRow:
        return SphereRow(site, shot, view, k, one.points, one.form_mm, one.shell_mm, one.size_mm)

    near = artefacts.locate_spheres(points, normals, radius, centres)
    spheres = [artefacts.read_sphere(points, normals, each, radius) for each in near]
    artefacts.require_spheres(spheres, radius, centres)
    rows = [row(ALL, k, one) for k, one in enumerate(spheres, start=1)]
    for (view, points, normals), (k, sphere) in product(single, enumerate(spheres, start=1)):
        with suppress(BodyscanError):  # this pair does not see it
            one = artefacts.read_sphere(points, normals, sphere.fitted, radius)
            rows += [row(view, k, one)] if one.points >= MIN_POINTS else []
    pairs = combinations(range(1, len(centres) + 1), 2)
    errors = artefacts.compute_spacing_errors(spheres, centres)
    spacings = tuple(
        SpacingRow(site, shot, f"{a}-{b}", float(error))
        for (a, b), error in zip(pairs, errors, strict=True)
    )
    return Readings(tuple(rows), spacings)


def read_plates(file: AcceptanceFile, site: str, shot: str, clouds: Sequence[_Cloud]) -> Readings:
    """Read the plate at one place in one shot."""
    width, height = file.plate.size_mm

    def row(view: str, points: Array, normals: Array) -> PlateRow:
        one = artefacts.read_plate(points, normals)
        share = 100.0 * one.area_mm2 / (width * height)
        return PlateRow(site, shot, view, one.points, one.flatness_mm, one.rms_mm, share)

    rows = [row(*clouds[0])]
    for cloud in clouds[1:]:
        if len(cloud[1]) >= MIN_POINTS:
            with suppress(BodyscanError):  # this pair sees only an edge of it
                rows.append(row(*cloud))
    return Readings(plates=tuple(rows))


def _merge_clouds(
    calibration: RigCalibration, captures: Captures, shot: str, progress: Progress
) -> list[_Cloud]:
    """All pairs' points merged like a scan's, without alignment, then those of each pair; rig frame.
    Raises ScanFailed."""
    one = replace(captures, shots=(shot,), sequences=captures.shot_sequences(shot))
    images = reconstruct_range_images(calibration, one, progress).value
    cleaned = clean(images, calibration.rig_from_camera, calibration.rig.volume)
    measured = [image for image in cleaned if image.valid.any()]
    # About 3,000 of the points lie on a sphere of 60 mm.
    cloud = merge(measured, calibration.rig_from_camera, FusionSettings(points=200_000)).cloud
    found = [(ALL, cloud.points, cloud.normals.astype(np.float64))]
    for image in measured:
        valid = image.valid & np.isfinite(image.normals).all(axis=-1)
        pose = calibration.rig_from_camera[image.pair]
        points = pose.apply(image.points[valid].astype(np.float64))
        normals = pose.rotate(image.normals[valid].astype(np.float64))
        found.append((image.pair, points, normals))
    return found
