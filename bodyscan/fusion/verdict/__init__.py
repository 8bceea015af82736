"""Grade a scan: good, usable for some purposes, or to be repeated."""

from __future__ import annotations

from bodyscan.fusion.verdict import coverage, motion, overlaps, rig, shape
from bodyscan.fusion.verdict.evidence import Check, Finding, ScanEvidence
from bodyscan.optional import optional
from bodyscan.verdict import Grade, Verdict

CHECKS: tuple[Check, ...] = (
    *(rig.check_pairs, rig.check_silent_poles, rig.check_calibration, rig.check_nominal_size),
    *(rig.check_stripe_directions, overlaps.check_seams, motion.check_displaced_poles),
    *(motion.check_size, rig.check_floor, motion.check_displaced_pairs),
    *(overlaps.check_disagreement, motion.check_motion, overlaps.check_contradictions),
    *(shape.check_pieces, shape.check_limbs, shape.check_posture, shape.check_volume),
    *(shape.check_omissions, shape.check_contacts),
    *(coverage.check_yields, coverage.check_gaps, coverage.check_crown),
)
"""Of equally bad findings the first check's come first."""
WORST_FIRST: tuple[Grade, ...] = ("repeat", "usable", "good")


def grade_scan(scan: ScanEvidence) -> Verdict:
    """Grade a scan by the worst of all findings; the reasons come worst first.

    A check that itself fails leaves the scan usable at best, and is reported.
    """
    findings: list[Finding] = []
    failures: list[str] = []
    for check in CHECKS:
        subject = check.__name__.removeprefix("check_").replace("_", " ")
        with optional(f"verdict on {subject}", failures.append):
            findings += check(scan)
    findings += [("usable", line) for line in failures]
    findings.sort(key=lambda finding: WORST_FIRST.index(finding[0]))
    grade = findings[0][0] if findings else "good"
    return Verdict(grade, tuple(reason for _, reason in findings))
