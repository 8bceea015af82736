"""Grade a scan: good, usable for some purposes, or to be repeated."""

from __future__ import annotations

from collections.abc import Mapping

from bodyscan.fusion.verdict.coverage import check_crown, check_gaps, check_yields
from bodyscan.fusion.verdict.evidence import (
    Check,
    Coverage,
    Finding,
    ImageEvidence,
    RigEvidence,
    ScanEvidence,
)
from bodyscan.fusion.verdict.floor import check_floor
from bodyscan.fusion.verdict.motion import (
    check_displaced_pairs,
    check_displaced_poles,
    check_motion,
    check_size,
)
from bodyscan.fusion.verdict.overlaps import check_contradictions, check_disagreement, check_seams
from bodyscan.fusion.verdict.rig import (
    check_calibration,
    check_nominal_size,
    check_pairs,
    check_silent_poles,
    check_stripe_directions,
)
from bodyscan.fusion.verdict.shape import (
    check_contacts,
    check_limbs,
    check_omissions,
    check_pieces,
    check_posture,
    check_volume,
)
from bodyscan.mesh.body import BodyCloud, BodyMesh
from bodyscan.motion.person_alignment import PersonAlignment
from bodyscan.motion.person_motion import PersonMotion
from bodyscan.optional import optional
from bodyscan.settings import UseLimits
from bodyscan.verdict import Grade, Verdict

CHECKS: Mapping[str, Check] = {
    "pairs": check_pairs,
    "presence": check_silent_poles,
    "calibration": check_calibration,
    "nominal poses": check_nominal_size,
    "directions": check_stripe_directions,
    "seams": check_seams,
    "poles": check_displaced_poles,
    "size": check_size,
    "floor": check_floor,
    "poses": check_displaced_pairs,
    "disagreement": check_disagreement,
    "motion": check_motion,
    "contradictions": check_contradictions,
    "pieces": check_pieces,
    "limbs": check_limbs,
    "posture": check_posture,
    "cuts": check_volume,
    "omissions": check_omissions,
    "contacts": check_contacts,
    "yields": check_yields,
    "gaps": check_gaps,
    "crown": check_crown,
}
"""All checks, by what they are about. Of equally bad findings the first check's come first."""

WORST_FIRST: tuple[Grade, ...] = ("repeat", "usable", "good")


def grade_scan(
    cloud: BodyCloud,
    rig: RigEvidence,
    images: ImageEvidence,
    use: UseLimits,
    *,
    together: PersonAlignment | None = None,
    person: PersonMotion | None = None,
    mesh: BodyMesh | None = None,
    coverage: Coverage | None = None,
) -> Verdict:
    """Grade a scan by the worst of all findings; the reasons come worst first.

    See `ScanEvidence` for the arguments. A check that itself fails leaves the scan usable at best,
    and is reported.
    """
    scan = ScanEvidence(cloud, rig, images, use, together, person, mesh, coverage)
    findings: list[Finding] = []
    failures: list[str] = []
    for subject, check in CHECKS.items():
        with optional(f"verdict on {subject}", failures.append):
            findings += check(scan)
    findings += [("usable", line) for line in failures]
    findings.sort(key=lambda finding: WORST_FIRST.index(finding[0]))
    grade = findings[0][0] if findings else "good"
    return Verdict(grade, tuple(reason for _, reason in findings))
