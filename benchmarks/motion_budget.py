"""What is left of people who stand, and of which motion: with the truth in place of what was found."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree

from benchmarks.cast_people import PROJECT, SCALE, CastScan, cast_person
from benchmarks.people import FOUR, MAN, THREE, WOMAN, Job, of_arms
from bodyscan.alignment.bending import at_once
from bodyscan.alignment.icp import align
from bodyscan.alignment.part_names import CROTCH, NECK
from bodyscan.alignment.together import bring_together
from bodyscan.arrays import Array
from bodyscan.evaluation.comparison import fit_to_surface
from bodyscan.evaluation.surface import signed_distances
from bodyscan.fusion.cleaning import clean, require_subject
from bodyscan.fusion.merging import merge
from bodyscan.geometry.robust import rms
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.reconstruction.range_image import RangeImage
from bodyscan.rig.rig_file import load_rig
from bodyscan.settings import ScanSettings
from bodyscan.simulation.files import scale_rig
from bodyscan.simulation.presets import settings_for
from bodyscan.simulation.simulate import CALIBRATION, true_pairs

SEEDS = range(101, 111)
"""Others than those of `people`."""
CELL_MM = 25.0
Images = Sequence[RangeImage]
Places = dict[str, RigidTransform]
FOUND, BREATH, MOTION, ALL = "as found", "true breath", "true motion", "and true places"


def report() -> str:
    """The section of docs/results.md: minutes."""
    jobs = [((THREE, FOUR)[n % 2], (WOMAN, MAN)[n // 2 % 2], "standing", n) for n in SEEDS]
    scans = [_errors(job) for job in jobs]
    rows = "\n".join(_row(name, [scan[name] for scan in scans]) for name in scans[0])
    return f"""## What of a standing person's motion is left (synthetic)

People as in `people`, seeds {SEEDS[0]} to {SEEDS[-1]}: the cloud's RMS error in mm, with the truth in
place of what following found of a motion. Together: of trunk, legs and head, what cells of
{CELL_MM:g} mm have in common, which is motion and places; within: what they have not.

| motion | trunk, legs, head | head | trunk | legs | arms | together, within |
|---|---|---|---|---|---|---|
{rows}
"""


def _errors(job: Job) -> dict[str, tuple[Array, Array, Array]]:
    """Of each way: errors, parts (head, trunk, legs, arms) and places of the cloud."""
    cast, settings = cast_person(*job), ScanSettings()
    placed = dict(cast.calibration.rig_from_camera)
    images = require_subject(clean(cast.images, placed, cast.calibration.rig.volume))
    true = _true_places(job)
    moved = _carried(cast, images, true, breath=False)
    ways: dict[str, tuple[Images, Places]] = {
        FOUND: _followed(cast, images, settings),
        BREATH: _followed(cast, _carried(cast, images, true, breath=True), settings),
        MOTION: (moved, placed),
        ALL: (moved, true),
    }
    found = {}
    vertices = cast.vertices()
    for name, (seen, there) in ways.items():
        cloud = merge(seen, there, settings.fusion).cloud.points
        points = fit_to_surface(cloud, vertices, cast.faces).apply(cloud)
        height = points[:, 2] / vertices[:, 2].max()
        part = np.where(height > NECK, 0, np.where(height < CROTCH, 2, 1))
        part[of_arms(points, vertices, cast.body)] = 3
        found[name] = signed_distances(points, vertices, cast.faces), part, points
    return found


def _true_places(job: Job) -> Places:
    rig = scale_rig(load_rig(PROJECT / "rigs" / f"{job[0]}.yaml"), SCALE, CALIBRATION)
    pairs = true_pairs(rig, settings_for("mirror", preset="workshop", subject=job[2]), job[3])
    return {name: pair.rig_from_camera for name, pair in pairs.items()}


def _followed(cast: CastScan, images: Images, settings: ScanSettings) -> tuple[Images, Places]:
    placed, known = dict(cast.calibration.rig_from_camera), cast.calibration.covariance
    aligned = align(images, placed, known, settings.alignment)
    poles = cast.calibration.rig.poles
    together = bring_together(images, placed, aligned, known, poles, settings.alignment)
    placed |= together.alignment.rig_from_camera
    return at_once(images, placed, together.followed), placed


def _carried(cast: CastScan, images: Images, true: Places, *, breath: bool) -> list[RangeImage]:
    """By the truth to the middle of the scan: by all that moved, or by breath alone."""

    def at(ms: float | None = None) -> Array:
        whole = cast.vertices(ms)
        return whole - cast.vertices(ms, breathing=False) if breath else whole

    carried = []
    for image in images:
        ms, there, valid = image.time_ms, true[image.pair], image.valid
        assert ms is not None
        tree = cKDTree(cast.vertices(ms))
        places = there.apply(image.points[valid].astype(float))
        far, near = tree.query(places, k=3)
        weight = 1.0 / (np.asarray(far) + 1e-3)
        weight /= weight.sum(axis=1, keepdims=True)
        places = places + np.einsum("nk,nkc->nc", weight, (at() - at(ms))[near])
        points = image.points.copy()
        points[valid] = there.inverse().apply(places)
        carried.append(replace(image, points=points, bent=not breath))
    return carried


def _row(name: str, found: Sequence[tuple[Array, Array, Array]]) -> str:
    errors = np.concatenate([one for one, _, _ in found])
    part = np.concatenate([one for _, one, _ in found])
    common, own = np.sqrt(np.mean([_shared(e[p < 3], at[p < 3]) for e, p, at in found], axis=0))
    each = " | ".join(f"{rms(errors[part == n]):.3f}" for n in range(4))
    return f"| {name} | {rms(errors[part < 3]):.3f} | {each} | {common:.3f}, {own:.3f} |"


def _shared(errors: Array, points: Array) -> tuple[float, float]:
    """Mean squares of cells' means and of what is about them."""
    cell = np.unique(np.floor(points / CELL_MM).astype(int), axis=0, return_inverse=True)[1].ravel()
    mean = (np.bincount(cell, errors) / np.bincount(cell))[cell]
    return float(np.mean(mean**2)), float(np.mean((errors - mean) ** 2))
