"""People cast by rays: accuracy and repeatability of scans of people who move."""

from __future__ import annotations

import multiprocessing
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from benchmarks.cast_people import SCALE, STANCE_DEG, STANCE_MM, cast_person
from bodyscan.arrays import Array, Mask
from bodyscan.evaluation.body import WHOLE, measure_true_girths
from bodyscan.evaluation.surface import compute_signed_distances, fit_to_surface, normalize_errors
from bodyscan.geometry.robust import rms
from bodyscan.measurement.measurements import Measurements, measure
from bodyscan.outcome import Outcome
from bodyscan.progress import THREADS
from bodyscan.settings import ScanSettings
from bodyscan.simulation.living import LivingBody
from bodyscan.workflows.scan_person import fuse

WOMAN, MAN = "woman_average", "man_average"
THREE, FOUR = "three-pole-12", "four-pole-16"
SCANS = tuple(((THREE, FOUR)[seed % 2], seed) for seed in range(31, 41))
"""For each person who stands: alternately on both rigs."""
RESTLESS = ((THREE, WOMAN, 21), (THREE, MAN, 22), (FOUR, WOMAN, 23), (FOUR, MAN, 24))
ARMPITS = 0.75
"""Share of the stature: above it, what counts as trunk depends on where the arms hang."""
MOSTLY = 0.5
"""A vertex is an arm's if it follows more than half of the arm's rotation."""
Job = tuple[str, str, str, int]
"""Rig, subject, preset, seed."""


@dataclass(frozen=True, eq=False)
class Found:
    """One scan compared with the truth.

    errors_mm, over_sigmas: (N,) of the cloud, aligned to the body of the scan's moment.
    of_arms: (N,) which of its points lie on arms.
    girths_mm: by the number of its height, as a tape runs, at mean breath.
    true_mm: of the true body then.
    grade: the verdict.
    """

    errors_mm: Array
    over_sigmas: Array
    of_arms: Mask
    girths_mm: dict[int, float]
    true_mm: dict[int, float]
    grade: str

    @property
    def girth_errors_mm(self) -> Array:
        return np.array([ours - self.true_mm[at] for at, ours in self.girths_mm.items()])


def report() -> str:
    """The section of docs/results.md: minutes."""
    restless = [(rig, who, "restless", seed) for rig, who, seed in RESTLESS]
    stood = {who: [(rig, who, "standing", seed) for rig, seed in SCANS] for who in (WOMAN, MAN)}
    asked = [*restless, *(job for jobs in stood.values() for job in jobs)]
    with ProcessPoolExecutor(THREADS, multiprocessing.get_context("spawn")) as pool:
        found = dict(zip(asked, pool.map(scan_person, asked), strict=True))
    rows = [_row(f"restless, {who}, {rig}", [found[rig, who, p, s]]) for rig, who, p, s in restless]
    rows += [_row("**restless, all**", [found[job] for job in restless])]
    for who, jobs in stood.items():
        for rig in (THREE, FOUR):
            rows += [_row(f"standing, {who}, {rig}", [found[job] for job in jobs if job[0] == rig])]
    every = [found[job] for jobs in stood.values() for job in jobs]
    rows += [_row("**standing, all**", every)]
    spreads = [_spread(who, [found[job] for job in jobs]) for who, jobs in stood.items()]
    return f"""## People cast by rays: exactness and repeatability (synthetic)

No images: depths of the simulator's people are cast at {SCALE:g} of full size as each pair finds them,
pair after pair; noise, speeds and calibration are off by what those of rendered scans are
(`benchmarks/cast_people.py`). Cleaning, alignment, following, cloud, mesh and measurement are the
real ones. The cloud against the body at the scan's moment, laid rigidly onto it; tape girths of the
trunk below the armpits, every 20 mm, against mean breath. In mm; over sigma: errors, root mean
square; the rest is trunk, legs and head; of girths the worst of all, and the worst of each scan's
heights, in the median over scans.

| who | bias, RMS, 95 % | RMS: arms; rest | over sigma | beyond 3 | girths: RMS, worst, median | good |
|---|---|---|---|---|---|---|
{chr(10).join(rows)}

Who stands was scanned {len(SCANS)} times, on three and on four poles by turns, each time with a new
stance (by some {STANCE_DEG:g} degrees and {STANCE_MM:g} mm), a new breath and a rig built and
calibrated anew. Of the girths at all heights: standard deviation over these scans, and errors.

| person | standard deviation: RMS, worst mm | errors: RMS, worst mm |
|---|---|---|
{chr(10).join(spreads)}
"""


def scan_person(job: Job) -> Found:
    """Cast, fuse and measure one person."""
    cast = cast_person(*job)
    scan = fuse(cast.calibration, Outcome(cast.images), ScanSettings())
    vertices, faces = cast.vertices(), cast.faces
    points = fit_to_surface(scan.cloud.points, vertices, faces).apply(scan.cloud.points)
    errors = compute_signed_distances(points, vertices, faces)
    true = measure_true_girths(cast.vertices(breathing=False), faces)
    ours = measure(scan.mesh, [one.height_mm for one in true.slices])
    over = errors / scan.cloud.sigma_mm
    arms = of_arms(points, vertices, cast.body)
    return Found(errors, over, arms, _tapes(ours), _tapes(true), scan.verdict.grade)


def of_arms(points: Array, vertices: Array, body: LivingBody) -> Mask:
    """Whether points (N, 3) lie on an arm, (N,). vertices: the body's at that time."""
    left, right = (limb.weights for limb in body.limbs[:2])
    return np.asarray((np.maximum(left, right) > MOSTLY)[cKDTree(vertices).query(points)[1]])


def _tapes(measured: Measurements) -> dict[int, float]:
    """Tape girths of the trunk below the armpits, where it was measured."""
    below = [one for one in measured.slices if one.height_mm < ARMPITS * measured.stature_mm]
    trunks = {number: one.find_girth("trunk") for number, one in enumerate(below)}
    return {
        number: trunk.tape_mm
        for number, trunk in trunks.items()
        if trunk is not None and trunk.measured > WHOLE
    }


def _row(people: str, found: Sequence[Found]) -> str:
    errors = np.concatenate([one.errors_mm for one in found])
    arms = np.concatenate([one.of_arms for one in found])
    girths = np.concatenate([one.girth_errors_mm for one in found])
    good = sum(one.grade == "good" for one in found)
    return (
        f"| {people} | {errors.mean():+.3f}, {rms(errors):.3f}, "
        f"{np.percentile(np.abs(errors), 95.0):.3f} | {rms(errors[arms]):.3f}; "
        f"{rms(errors[~arms]):.3f} | {_over_sigmas(found)} | "
        f"{rms(girths):.2f}, {np.abs(girths).max():.2f}; {median_of_worst(found):.2f} | "
        f"{good} of {len(found)} |"
    )


def median_of_worst(found: Sequence[Found]) -> float:
    """mm, what the issue on living people asks of girths: the worst of a scan's heights, in the median
    over scans."""
    return float(np.median([np.abs(one.girth_errors_mm).max() for one in found]))


def _over_sigmas(found: Sequence[Found]) -> str:
    """Errors over sigmas as `evaluate` reports them."""
    spread, beyond = normalize_errors(
        np.concatenate([one.over_sigmas for one in found]), np.ones(())
    )
    return f"{spread:.2f} | {100.0 * beyond:.1f} %"


def _spread(who: str, found: Sequence[Found]) -> str:
    shared = set.intersection(*(set(one.girths_mm) for one in found))
    girths = np.array([[one.girths_mm[at] for at in sorted(shared)] for one in found])
    spread = girths.std(axis=0, ddof=1)
    errors = np.concatenate([one.girth_errors_mm for one in found])
    return (
        f"| {who} | {rms(spread):.2f}, {spread.max():.2f} | "
        f"{rms(errors):.2f}, {np.abs(errors).max():.2f} |"
    )
