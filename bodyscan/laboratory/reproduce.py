"""`bodyscan reproduce`: simulates the chapter's set-up for its Tables 1 and 2, its Fig. 6 and 7."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from bodyscan.files.atomic import write_text
from bodyscan.geometry.transforms import fit_rigid_transform
from bodyscan.laboratory import apparatus
from bodyscan.laboratory.approaches import Approach
from bodyscan.laboratory.calibrating import Calibrations, calibrate_all
from bodyscan.laboratory.chapter_captures import ChapterCaptures, take_captures
from bodyscan.laboratory.measuring import (
    ApproachAccuracy,
    compare_point_sigmas,
    make_true_approach,
    measure_artefacts,
    triangulate_pixels,
)
from bodyscan.laboratory.text import Reproduction, figure_names, reproduction_text, text_name
from bodyscan.progress import Progress, silent
from bodyscan.reconstruction.triangulation import grid_normals

if TYPE_CHECKING:
    from bodyscan.laboratory.figures import RangeData


def reproduce(
    out: Path,
    *,
    seed: int = 0,
    quick: bool = False,
    real_light: bool = False,
    boards: int = apparatus.BOARDS,
    progress: Progress = silent,
) -> str:
    """Simulate, calibrate every approach, measure; returns the text, which is also written into
    `out` beside the figures.

    seed: of all noise.
    quick: coarser rendering and fewer shots, for a trial.
    real_light: a bowed board, speckle and everything else that an ideal simulation leaves out.
    boards: number of board poses, from 3 as in the chapter to 10.
    """
    settings = (apparatus.real_settings if real_light else apparatus.ideal_settings)(
        3 if quick else 5
    )
    setup = apparatus.chapter_setup(settings, seed)
    stops = 3 if quick else 7
    captures = take_captures(setup, boards=boards, stage_stops=stops, progress=progress)
    calibrated = calibrate_all(captures)
    found = _measure_all(captures, calibrated, seed, real_light, progress)
    text = reproduction_text(found)
    draw(captures, calibrated, Path(out), figure_names(real_light))
    write_text(Path(out) / text_name(real_light), text)
    return text


def _measure_all(
    captures: ChapterCaptures,
    calibrated: Calibrations,
    seed: int,
    real_light: bool,
    progress: Progress,
) -> Reproduction:
    """Measure the artefacts by every approach, whole-stripe and sub-pixel."""
    compared = [*calibrated.approaches, make_true_approach(captures.setup)]
    total = 2 * len(compared) + len(calibrated.by_stage) + len(calibrated.by_reference)
    done = 0

    def measure(
        approaches: Sequence[Approach], whole: bool = False
    ) -> tuple[ApproachAccuracy, ...]:
        nonlocal done
        progress("measuring", done, total)
        done += len(approaches)
        return tuple(measure_artefacts(one, captures, whole=whole) for one in approaches)

    found = Reproduction(
        seed=seed,
        real_light=real_light,
        boards=len(captures.boards),
        calibrated=calibrated,
        whole=measure(compared, whole=True),
        fine=measure(compared),
        by_stage=measure(calibrated.by_stage),
        by_reference=measure(calibrated.by_reference),
        # Of the approaches whose sheets know their covariance.
        sigmas=tuple(
            compare_point_sigmas(one, captures) for one in compared if one.name in ("(iii)", "ours")
        ),
    )
    progress("measuring", total, total)
    return found


def draw(
    captures: ChapterCaptures, calibrated: Calibrations, out: Path, names: tuple[str, str]
) -> None:
    """Write Fig. 6 and Fig. 7 into the folder `out`, in files of these names."""
    # Matplotlib takes a second to import; only drawing should wait for it.
    from bodyscan.laboratory.figures import PlaneCurve, draw_projector, draw_range_data

    by_name = {approach.name: approach for approach in calibrated.approaches}
    s = np.arange(apparatus.PROJECTOR.stripes + 1.0)
    curves = [
        PlaneCurve(name, s, by_name[name].sheets.tangent_planes(s))
        for name in ("(iii)", "ours", "(i)")
    ]
    true = PlaneCurve("true", s, apparatus.true_planes(captures.setup))
    distances = calibrated.planes.distances_mm
    known = distances[np.isfinite(distances)]
    draw_projector(curves, true, known, apparatus.PROJECTOR.direction, out / names[0])
    wanted = [by_name[name] for name in ("(i)", "(ii)", "(iii)", "ours")]
    draw_range_data([_range_data(approach, captures) for approach in wanted], out / names[1])


def _range_data(approach: Approach, captures: ChapterCaptures) -> RangeData:
    """Triangulate the spheres by an approach and align them with the truth, for Fig. 7."""
    from bodyscan.laboratory.figures import RangeData

    s = captures.spheres.stripes.s
    points = triangulate_pixels(approach, s).reshape(*s.shape, 3)
    true = (
        apparatus.CAMERA.directions(apparatus.CAMERA.grid())
        * captures.spheres.truth.depth[..., None]
    )
    both = np.isfinite(points[..., 2]) & np.isfinite(captures.spheres.truth.s)
    laid = np.full(points.shape, np.nan)
    laid[both] = fit_rigid_transform(points[both], true[both]).apply(points[both])
    normals = grid_normals(laid.astype(np.float32)).astype(float)
    return RangeData(approach.name, normals, laid[..., 2] - true[..., 2])
