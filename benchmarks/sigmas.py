"""Errors over their sigmas, over seeds: for the chapter's unit."""

from __future__ import annotations

import multiprocessing
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass

import numpy as np
from scipy.spatial.distance import pdist

from bodyscan.arrays import Array
from bodyscan.boards.board_layout import compute_corner_points
from bodyscan.evaluation.primitives import compare_centre_distances
from bodyscan.geometry.camera import camera_from_fields
from bodyscan.geometry.robust import rms
from bodyscan.laboratory import apparatus
from bodyscan.laboratory.apparatus import take_captures
from bodyscan.laboratory.approaches import calibrate_by_reference_plane, calibrate_ours
from bodyscan.laboratory.measuring import (
    ApproachAccuracy,
    PointSigma,
    compare_point_sigmas,
    make_true_approach,
    measure_artefacts,
)
from bodyscan.progress import THREADS
from bodyscan.simulation.files import describe_camera

SEEDS = range(10)
"""Of units: what is unknown of one is common to all its points, so that five gave 0.6 for 0.9."""
BOARDS = (3, 10)


def report() -> str:
    """The section of docs/results.md."""
    kinds = [(boards, light) for boards in BOARDS for light in ("ideal", "real light")]
    asked = [(boards, light == "real light", seed) for boards, light in kinds for seed in SEEDS]
    with ProcessPoolExecutor(THREADS, multiprocessing.get_context("spawn")) as pool:
        found = iter(list(pool.map(_unit, *zip(*asked, strict=True))))
    units = [(*kind, [next(found) for _ in SEEDS]) for kind in kinds]
    return f"""## Errors over their sigmas (synthetic)

Root mean square over all seeds of error over sigma, 1 if sigmas are honest; in brackets that of each
seed, since what is open of one calibration is common to all its points and a seed is one draw of it.
The chapter's unit (`bodyscan reproduce`; depth on spheres and plate, and the camera's seven
parameters), {len(SEEDS)} seeds:

| boards | light | spheres | plate | beyond three | camera | beyond three |
|---|---|---|---|---|---|---|
{chr(10).join(_unit_row(*unit) for unit in units)}

How far off they are: of the whole plate what no noise of stripes explains, RMS from flat, in the
median of the seeds and the worst; the ten distances between the spheres' centres, RMS, in the
same way; and what no calibration can better, "true": the same distances from the same images with
the true camera and light, and "+ print": together with the size of the board as it was printed
(0.02 mm RMS in real light), which no image tells. Then the scale of the distances, that of the
print, and what is left with the print's known.

| boards | light | plate, mm | distances, mm | true | + print | scale, ppm | print | less print |
|---|---|---|---|---|---|---|---|---|
{chr(10).join(_size_row(*unit) for unit in units)}
"""


@dataclass(frozen=True, eq=False)
class UnitErrors:
    """camera: (7,) errors over sigmas of its parameters. best: with the true calibration, from the
    same images. print_ppm: how much larger the board is than it is said to be."""

    points: PointSigma
    camera: Array
    accuracy: ApproachAccuracy
    best: ApproachAccuracy
    print_ppm: float

    @property
    def with_print_mm(self) -> float:
        """RMS error of the spheres' distances with the true calibration and a board of this size."""
        of_print = 1e-6 * self.print_ppm * rms(pdist(apparatus.CENTRES))
        return float(np.hypot(self.best.distances.rms_mm, of_print))


def _unit(boards: int, real_light: bool, seed: int) -> UnitErrors:
    settings = apparatus.make_real_settings() if real_light else apparatus.make_ideal_settings()
    setup = apparatus.build_chapter_setup(settings, seed)
    captures = take_captures(setup, boards=boards, stage_stops=0)
    ours, covariance, *_ = calibrate_ours(captures, *calibrate_by_reference_plane(captures.boards))
    true = camera_from_fields(describe_camera(apparatus.CAMERA)).parameters
    off = (ours.camera.parameters - true) / np.sqrt(np.diag(covariance))
    print_ppm = compare_centre_distances(
        setup.board.corners, compute_corner_points(apparatus.BOARD)
    ).scale_ppm
    accuracy, best = (measure_artefacts(one, captures) for one in (ours, make_true_approach(setup)))
    return UnitErrors(compare_point_sigmas(ours, captures), off, accuracy, best, print_ppm)


def _unit_row(boards: int, light: str, seeds: Sequence[UnitErrors]) -> str:
    beyond = 100.0 * np.mean([one.points.beyond_three for one in seeds])
    spheres, plate = [s.points.spheres for s in seeds], [s.points.plate for s in seeds]
    camera = [rms(s.camera) for s in seeds]
    apart = 100.0 * np.mean(np.abs([s.camera for s in seeds]) > 3.0)
    return (
        f"| {boards} | {light} | {each_seed(spheres)} | {each_seed(plate)} | {beyond:.2f} % | "
        f"{each_seed(camera)} | {apart:.1f} % |"
    )


def _size_row(boards: int, light: str, seeds: Sequence[UnitErrors]) -> str:
    millimetres = [
        [s.accuracy.plate_systematic_mm for s in seeds],
        [s.accuracy.distances.rms_mm for s in seeds],
        [s.best.distances.rms_mm for s in seeds],
        [s.with_print_mm for s in seeds],
    ]
    # What is measured by a board that is larger than it is said to be comes out smaller.
    scales = [
        [abs(s.accuracy.distances.scale_ppm) for s in seeds],
        [abs(s.print_ppm) for s in seeds],
        [abs(s.accuracy.distances.scale_ppm + s.print_ppm) for s in seeds],
    ]
    cells = [f"{np.median(of):.4f}, {max(of):.4f}" for of in millimetres]
    cells += [f"{np.median(of):.0f}, {max(of):.0f}" for of in scales]
    return f"| {boards} | {light} | {' | '.join(cells)} |"


def each_seed(spreads: Sequence[float]) -> str:
    """The root mean square over all seeds, and in brackets each of them."""
    return f"{rms(np.array(spreads)):.2f} ({', '.join(f'{one:.2f}' for one in spreads)})"
