"""What makes a calibration good, usable, or to be repeated."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import astuple, dataclass

import numpy as np

from bodyscan.calibration.board_views import covered_share
from bodyscan.geometry.uncertainty import position_sigma
from bodyscan.registration.rig_calibration import RigCalibration, nominal_size
from bodyscan.report.page import Column
from bodyscan.verdict import Grade, Verdict

PAIR_COLUMNS = (
    Column("pair"),
    # Corners are found to less than a tenth of a pixel in sharp, well-lit images.
    Column("corners", "px RMS", "distance of corners from where camera and pose put them.", 0.3),
    Column("poses", "", "views of a board that were used.", 6, True, 0),
    Column("covered", "% of picture", "by the boards' corners; the lens is extrapolated beyond.",
           40.0, True, 0),
    # A scan's overlaps are doubted from 0.4 mm on (fusion/verdict/overlaps.py).
    Column("sheets", "mm RMS", "distance of stripe boundaries on boards from their sheet.", 0.3),
    Column("held out", "mm mean", "distance of points from boards that the light was not fitted to; "
           "outliers capped.", 0.5),
    Column("striped", "", "boards on which stripes were decoded.", 4, True, 0),
    Column("stripes", "% known", "boundaries between stripes that have a sheet, of those projected; "
           "the others fell beyond the boards.", 50.0, True, 0),
    Column("sigma", "mm", "of the camera's position in the rig frame, all axes together, from the "
           "covariance of the joint solve.", 0.5),
    Column("light", "", "model of the light sheets, chosen by held-out boards."),
    Column("lens", "", "chosen by held-out boards, or named in the rig file; see below."),
)  # fmt: skip
REASONS = (
    "corner residuals are {:.3g} px RMS",
    "was calibrated from {:.3g} board poses",
    "boards covered {:.3g} % of its picture",
    "light sheets have residuals of {:.3g} mm RMS",
    "held-out boards are missed by {:.3g} mm",
    "stripes were decoded on {:.3g} boards",
    "has planes for {:.3g} % of its stripes",
    "its position has a sigma of {:.3g} mm",
)
"""What a verdict says of a figure beyond its limit, in the order of the columns with a limit."""


@dataclass(frozen=True)
class PairFigures:
    """The figures by which a calibrated pair is judged, in the order of `PAIR_COLUMNS`; None if not
    applicable or not stored."""

    name: str
    corners_rms_px: float | None
    poses: int | None
    covered_percent: float | None
    sheets_rms_mm: float | None
    held_out_mm: float | None
    stripe_shots: int | None
    stripes_percent: float | None
    sigma_mm: float | None

    def beyond(self) -> Iterator[tuple[float, str]]:
        """Yield each limit that is exceeded: by what factor, and in words."""
        limited = (column for column in PAIR_COLUMNS if column.limit is not None)
        for column, reason, value in zip(limited, REASONS, astuple(self)[1:], strict=True):
            if column.keeps_limit(value) is False:
                limit = float(column.limit or 0.0)
                times = limit / max(value, 1e-9) if column.at_least else value / limit
                side = "at least" if column.at_least else "at most"
                yield times, f"{reason.format(value)} ({side} {limit:g} is good)"


def figures_of(calibration: RigCalibration) -> list[PairFigures]:
    """Collect the figures of every calibrated pair, in the order of the rig."""
    names = [pair.name for pair in calibration.rig.pairs if pair.name in calibration.pairs]
    return [_figures(calibration, name) for name in names]


def grade_calibration(calibration: RigCalibration) -> Verdict:
    """Grade a calibration by how far its pairs are beyond their limits: recalibrate from twice on."""
    findings = [
        (np.inf, f"recalibrate: pair {name} failed: {reason}")
        for name, reason in calibration.failed.items()
    ]
    for pair in figures_of(calibration):
        for times, words in pair.beyond():
            far = times > 2.0
            findings.append((times, f"{'recalibrate: ' if far else ''}pair {pair.name}: {words}"))
    size = nominal_size(calibration.rig, calibration.rig_from_camera)
    if size and size.mark != "good":  # one in use is reported; a new one is not made
        findings.append((1.0, f"{size.words}: {size.remedy}"))
    findings.sort(key=lambda finding: -finding[0])
    worst = findings[0][0] if findings else 0.0
    unjudged = [
        f"pair {name}: imported from {pair.quality.imported}, its accuracy is not known: check it with "
        "a board (check-calibration), or state it (import --sigma-px)"
        for name, pair in calibration.pairs.items()
        if pair.quality.unjudged
    ]
    grade: Grade = "recalibrate" if worst > 2.0 else "usable" if findings else "good"
    if unjudged and grade != "recalibrate":
        grade = "not judged"
    return Verdict(grade, (*(words for _, words in findings), *unjudged))


def _figures(calibration: RigCalibration, name: str) -> PairFigures:
    pair = calibration.pairs[name]
    quality, camera, seen = pair.quality, pair.camera, calibration.observed.get(name)
    position = calibration.rig_from_camera[name].translation
    striped, ours = pair.sheets is not None, not quality.imported
    sigma = position_sigma(calibration.covariance, name, position)
    share = None
    if seen is not None:
        views = [seen.pixels[seen.target == k].astype(float) for k in np.unique(seen.target)]
        share = 100.0 * covered_share(views, camera.width, camera.height)
    return PairFigures(
        name,
        quality.corners_rms_px,
        quality.poses if ours else None,
        share,
        quality.planes_rms_mm,
        next((tried.mean_mm for tried in quality.held_out if tried.chosen), None),
        quality.stripe_shots if striped and ours else None,
        100.0 * quality.stripes_calibrated / max(quality.stripes_projected, 1) if striped else None,
        None if quality.unjudged else float(np.linalg.norm(sigma)),
    )
