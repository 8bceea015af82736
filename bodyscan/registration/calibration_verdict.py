"""What makes a calibration good, usable, or to be repeated."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from bodyscan.calibration.board_views import measure_covered_share
from bodyscan.errors import group_reasons
from bodyscan.geometry.uncertainty import compute_position_sigma
from bodyscan.registration.board_checks import find_common_aspect
from bodyscan.registration.rig_calibration import RigCalibration, find_nominal_size
from bodyscan.rig.rig import find_unusual_lengths
from bodyscan.verdict import Grade, Verdict


@dataclass(frozen=True)
class Limit:
    """How large, or how small, a figure of a good pair may be."""

    value: float
    reason: str  # the sentence for a figure beyond it, with a field for the figure
    # It bounds from below how much was seen; otherwise from above how large an error is.
    at_least: bool = False


LIMITS = {
    # Corners are found to less than a tenth of a pixel in sharp, well-lit images.
    "corners_rms_px": Limit(0.3, "corner residuals are {:.3g} px RMS"),
    "poses": Limit(6, "was calibrated from {:.3g} board poses", at_least=True),
    "covered_percent": Limit(40.0, "boards covered {:.3g} % of its image", at_least=True),
    # A scan whose overlaps disagree by 0.4 mm is no longer good (fusion/verdict/overlaps.py).
    "sheets_rms_mm": Limit(0.3, "light sheets have residuals of {:.3g} mm RMS"),
    "held_out_mm": Limit(0.5, "held-out boards are missed by {:.3g} mm"),
    "stripe_shots": Limit(4, "stripes were decoded on {:.3g} boards", at_least=True),
    "stripes_percent": Limit(50.0, "has planes for {:.3g} % of its stripes", at_least=True),
    "sigma_mm": Limit(0.5, "its position has a sigma of {:.3g} mm"),
}
"""The limits of a pair's figures, by the names that these have in `PairFigures`."""


@dataclass(frozen=True)
class PairFigures:
    """The figures by which a calibrated pair is judged; None if not applicable or not stored."""

    name: str
    corners_rms_px: float | None
    poses: int | None
    covered_percent: float | None
    sheets_rms_mm: float | None
    held_out_mm: float | None
    stripe_shots: int | None
    stripes_percent: float | None
    sigma_mm: float | None

    def beyond(self) -> Iterator[tuple[float, bool, str]]:
        """Yield each limit that is exceeded: by what factor, whether by an error, and in words."""
        for figure, limit in LIMITS.items():
            value = getattr(self, figure)
            if value is None or (value >= limit.value if limit.at_least else value <= limit.value):
                continue
            times = limit.value / max(value, 1e-9) if limit.at_least else value / limit.value
            side = "at least" if limit.at_least else "at most"
            sentence = f"{limit.reason.format(value)} ({side} {limit.value:g} is good)"
            yield times, not limit.at_least, sentence


def collect_figures(calibration: RigCalibration) -> list[PairFigures]:
    """Collect the figures of every calibrated pair, in the order of the rig."""
    names = [pair.name for pair in calibration.rig.pairs if pair.name in calibration.pairs]
    return [_collect_figures(calibration, name) for name in names]


def grade_calibration(calibration: RigCalibration) -> Verdict:
    """Grade a calibration: recalibrate if an error of a pair is beyond twice its limit.

    Pairs that failed cost a scan what they alone would have measured, and boards that covered little
    leave the rest of a picture to extrapolation: such a rig is usable, where it measures.
    """
    failed = group_reasons(calibration.failed.items())
    findings = [(False, np.inf, f"failed: {', '.join(names)}: {why}") for names, why in failed]
    for pair in collect_figures(calibration):
        for times, error, words in pair.beyond():
            far = error and times > 2.0
            prefix = "recalibrate: " if far else ""
            findings.append((far, times, f"{prefix}pair {pair.name}: {words}"))
    pairs = calibration.pairs.values()
    aspect = find_common_aspect((one.camera, one.camera_covariance) for one in pairs)
    if aspect != 1.0:
        words = (
            f"fy is {aspect:.3f} times fx in all cameras: pixels that are not square, or a print that "
            "is stretched, and lengths with it: measure squares both ways, turn the board in some shots"
        )
        findings.append((False, 1.0, words))
    size = find_nominal_size(calibration.rig, calibration.rig_from_camera)
    if size is None and not calibration.rig.references:  # nothing confirms them
        findings[:0] = [(False, np.inf, words) for words in find_unusual_lengths(calibration.rig)]
    if size and size.mark != "good":  # one in use is reported; a new one is not made
        findings.append((False, 1.0, f"{size.words}: {size.remedy}"))
    # What forbids its use comes first.
    findings.sort(key=lambda finding: (not finding[0], -finding[1]))
    unjudged = [
        f"pair {name}: imported from {pair.quality.imported}, its accuracy is not known: check it with "
        "a board (check-calibration), or state it (import --sigma-px)"
        for name, pair in calibration.pairs.items()
        if pair.quality.unjudged
    ]
    grade: Grade = "not judged" if unjudged else "usable" if findings else "good"
    if any(far for far, _, _ in findings):
        grade = "recalibrate"
    return Verdict(grade, (*(words for _, _, words in findings), *unjudged))


def _collect_figures(calibration: RigCalibration, name: str) -> PairFigures:
    pair = calibration.pairs[name]
    quality, camera, corners = pair.quality, pair.camera, calibration.observed.get(name)
    position = calibration.rig_from_camera[name].translation
    striped, ours = pair.sheets is not None, not quality.imported
    sigma = compute_position_sigma(calibration.covariance, name, position)
    share = None
    if corners is not None:
        views = [
            corners.pixels[corners.target == k].astype(float) for k in np.unique(corners.target)
        ]
        share = 100.0 * measure_covered_share(views, camera.width, camera.height)
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
