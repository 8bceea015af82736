"""Grade a scan: good, usable for some purposes, or to be repeated."""

from __future__ import annotations

from bodyscan.fusion.verdict import coverage, motion, overlaps, rig, shape
from bodyscan.fusion.verdict.evidence import Check, Finding, ScanEvidence
from bodyscan.optional import optional
from bodyscan.verdict import Grade, Verdict

CHECKS: tuple[Check, ...] = (
    *(rig.check_exchanged, rig.check_pictures, rig.check_pairs, rig.check_calibration),
    rig.check_nominal_size,
    rig.check_stripe_directions,
    *(motion.check_common_error, motion.check_times, rig.check_floor, coverage.check_brightness),
    *(coverage.check_exposure, coverage.check_views, rig.check_silent_poles),
    *(
        motion.check_displaced_poles,
        motion.check_posture_step,
        rig.check_refused,
        overlaps.check_seams,
        motion.check_displaced_pairs,
    ),
    *(overlaps.check_disagreement, motion.check_motion, overlaps.check_contradictions),
    *(shape.check_pieces, shape.check_limbs, shape.check_posture, shape.check_volume),
    *(shape.check_omissions, shape.check_contacts),
    *(coverage.check_yields, coverage.check_rings, coverage.check_gaps, coverage.check_crown),
)
"""Causes before what may be their consequence."""
WORST_FIRST: tuple[Grade, ...] = ("repeat", "usable", "good")


def grade_scan(scan: ScanEvidence) -> Verdict:
    """Grade a scan by the worst of all findings.

    The reasons come worst first, of equally bad ones those that explain others. A cause is as bad as
    the worst of its consequences, which are no reasons of their own; one that is good by itself is no
    reason without them. A check that itself fails leaves
    the scan usable at best, and is reported.
    """
    causes: list[Finding] = []
    followers: dict[Finding, list[Finding]] = {}
    failures: list[str] = []
    for check in CHECKS:
        subject = check.__name__.removeprefix("check_").replace("_", " ")
        with optional(f"verdict on {subject}", failures.append):
            for found in check(scan):
                alone = [cause for cause in causes if cause.explains_finding(found)][:1]
                jointly = alone or _explain_jointly(causes, found)
                for cause in jointly or [found]:
                    followers.setdefault(cause, []).append(found)
                causes += [] if jointly else [found]
    causes += [Finding("usable", line) for line in failures]

    def grade(cause: Finding) -> int:
        return min(WORST_FIRST.index(found.grade) for found in followers.get(cause, [cause]))

    good = WORST_FIRST.index("good")
    causes = [cause for cause in causes if grade(cause) < good]
    causes = sorted(causes, key=lambda cause: (grade(cause), not cause.explains))
    # Their own possible causes would be read as causes.
    consequences = [
        found.words.partition(". Possible causes")[0].partition(": ")[0]
        for cause in causes
        for found in followers.get(cause, ())
        if found is not cause
    ]
    worst = WORST_FIRST[grade(causes[0])] if causes else "good"
    reasons = tuple(cause.words for cause in causes)
    return Verdict(worst, reasons, tuple(dict.fromkeys(consequences)))


def _explain_jointly(causes: list[Finding], found: Finding) -> list[Finding]:
    """List the causes that all explain a finding in part, as pairs that were each left out explain a
    gap; empty if they do not."""
    parts = [cause for cause in causes if cause.explains & found.pairs]
    joint = Finding(found.grade, "", explains=frozenset().union(*(c.explains for c in parts)))
    return parts if joint.explains_finding(found) else []
