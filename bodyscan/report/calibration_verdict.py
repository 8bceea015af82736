"""What makes a calibration good, usable, or to be repeated."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from bodyscan.calibration.board_views import covered_share
from bodyscan.geometry.uncertainty import position_sigma
from bodyscan.registration.rig_calibration import RigCalibration, nominal_size
from bodyscan.verdict import Grade, Verdict

CORNERS_RMS_PX = 0.3
"""Corners are found to less than a tenth of a pixel in sharp, well-lit images."""
SHEETS_RMS_MM, HELD_OUT_MM = 0.3, 0.5
"""A scan's overlaps are doubted from 0.4 mm on (fusion/verdict/overlaps.py)."""
COVERED_PERCENT = 40.0
"""Share of the image: a lens is only known where boards were."""
POSES, STRIPE_SHOTS = 6, 4
STRIPES_PERCENT = 50.0
SIGMA_MM = 0.5


@dataclass(frozen=True)
class PairFigures:
    """The figures by which a calibrated pair is judged, in the order of the report's columns; None
    if not applicable or not stored."""

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
        checks = (
            ("corner residuals are", self.corners_rms_px, CORNERS_RMS_PX, "px RMS", False),
            ("was calibrated from", self.poses, POSES, "board poses", True),
            ("boards covered", self.covered_percent, COVERED_PERCENT, "% of its picture", True),
            ("light sheets have residuals of", self.sheets_rms_mm, SHEETS_RMS_MM, "mm RMS", False),
            ("held-out boards are missed by", self.held_out_mm, HELD_OUT_MM, "mm", False),
            ("stripes were decoded on", self.stripe_shots, STRIPE_SHOTS, "boards", True),
            ("has planes for", self.stripes_percent, STRIPES_PERCENT, "% of its stripes", True),
            ("its position has a sigma of", self.sigma_mm, SIGMA_MM, "mm", False),
        )
        for words, value, limit, unit, at_least in checks:
            if value is None or (value >= limit if at_least else value <= limit):
                continue
            times = limit / max(value, 1e-9) if at_least else value / limit
            side = "at least" if at_least else "at most"
            yield times, f"{words} {value:.3g} {unit} ({side} {limit:g} is good)"


def figures_of(calibration: RigCalibration) -> list[PairFigures]:
    """Collect the figures of every calibrated pair, in the order of the rig."""
    return [
        _figures(calibration, pair.name)
        for pair in calibration.rig.pairs
        if pair.name in calibration.pairs
    ]


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
    quality, camera, seen = pair.quality, pair.camera, calibration.seen.get(name)
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
