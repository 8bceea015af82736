"""Checks of what moved: poles since the calibration, or the person during the scan."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from bodyscan.alignment.displaced_poles import STILL_MM, DisplacedPole
from bodyscan.alignment.pose_evidence import ScaleError
from bodyscan.fusion.verdict.evidence import GIRTH_PER_MM, Finding, ScanEvidence
from bodyscan.motion.person_motion import describe_posture
from bodyscan.settings import UseLimits

UNCORRECTED_SHARE = 0.2
"""Share of a pair's motion that no rigid motion of the whole body explains: arms and breath."""
MAX_RESIDUAL_MM = UseLimits().usable_girth_mm / GIRTH_PER_MM
"""Motion left after correction that costs the usable girth error."""
MAX_MOTION_MM = MAX_RESIDUAL_MM / UNCORRECTED_SHARE


def check_displaced_poles(scan: ScanEvidence) -> Iterator[Finding]:
    """Poles and pairs that alignment found displaced, and corrected.

    What the correction left shows at the seams. But a single pair may instead measure wrongly, and
    if several poles moved, the overlaps alone determine the body's size.
    """
    moved: list[DisplacedPole] = []
    for step in scan.person_alignment.displaced if scan.person_alignment else ():
        # A bumped pole turns about its foot and carries its view of the body along, by the turn
        # times its distance, at least a metre. If the body's middle stays within a quarter of
        # that, and 5 degrees are too large for a bump, it was the body that turned.
        lever_mm = np.radians(step.rotation_deg) * 1000.0
        if step.rotation_deg > 5.0 and step.shift_mm < 0.25 * lever_mm:
            yield Finding(
                "repeat",
                f"the person turned by {step.rotation_deg:.0f} degrees between captures (turning "
                f"{step.name} by that much would have shifted the body by {lever_mm:.0f} mm, not "
                f"{step.shift_mm:.0f})",
                step.pairs,
                step.pairs,
                spoils=True,
            )
        else:
            moved.append(step)
    if not moved:
        return
    poles = [step for step in moved if len(step.pairs) > 1]
    largest = max(moved, key=lambda step: step.size_mm)
    far = len(poles) < len(moved) and largest.size_mm > MAX_MOTION_MM
    unknown_size = len(poles) > 1 or any(step.all_moved for step in moved)
    which = f"{largest.name} is displaced by"
    if len(moved) > 1:
        which = f"{', '.join(step.name for step in moved)} are displaced, by up to"
    yield Finding(
        "repeat" if far or unknown_size else "usable",
        f"{which} {largest.shift_mm:.1f} mm and {largest.rotation_deg:.2f} degrees, from the "
        "calibrated pose and in one step, which no motion of a person explains; this was corrected. "
        "Possible causes: a knock; cameras or projectors are warmer or colder than when calibrated; "
        "wrong `timing` in captures.yaml. Calibrate again",
    )


def check_posture_step(scan: ScanEvidence) -> Iterator[Finding]:
    """Another posture while one pole fired: what it changed in shape may be of either."""
    found = scan.person_alignment
    if found is None or found.posture is None or found.motion is None:
        return
    yield Finding(
        "usable",
        f"{describe_posture(found.motion)} while {found.posture.pole} fired than while others did: "
        "the two were aligned, so girths there mix both. Stand still, breathe quietly and scan again",
        explains=found.posture.pairs,
    )


def check_common_error(scan: ScanEvidence) -> Iterator[Finding]:
    """One displacement of all pairs, corrected too: outwards, inwards, or as their cameras look."""
    found = scan.person_alignment.common_error if scan.person_alignment else None
    if found is None or not found.certain or scan.alignment is None:
        return
    if isinstance(found, ScaleError):
        girth_mm = abs(found.outward_mm) * GIRTH_PER_MM
        away, wrong = (
            ("farther from", "small") if found.outward_mm > 0.0 else ("nearer to", "large")
        )
        what = (
            f"all poles are {abs(found.outward_mm):.1f} mm (sigma {found.sigma_mm:.1f} mm) {away} the "
            "body than calibrated, which no motion of a person explains. Girths would be "
            f"{girth_mm:.0f} mm too {wrong}"
        )
    else:
        girth_mm = found.shift_mm * GIRTH_PER_MM
        what = (
            f"all pairs are displaced alike, each by {found.shift_mm:.1f} mm and "
            f"{found.rotation_deg:.2f} degrees in its camera's frame: one cause, not poles that moved"
        )
    yield Finding(
        "repeat" if girth_mm > scan.use.usable_girth_mm else "usable",
        f"{what}; now the overlaps alone determine the body's size. Possible causes: cameras or "
        "projectors are warmer or colder than when calibrated; all lenses were refocused; the "
        "calibration was edited. Let the rig warm up and calibrate again",
        explains=frozenset(scan.alignment.rig_from_camera),
        spoils=not isinstance(found, ScaleError),
    )


def check_times(scan: ScanEvidence) -> Iterator[Finding]:
    """Moments that the motion contradicts."""
    name = scan.person_alignment.other_times if scan.person_alignment else ""
    if name and scan.alignment:
        yield Finding(
            "usable",
            f"the motion suggests frame times {name} those in `timing`; they were not used. Correct "
            "`timing` in captures.yaml: unit, order, start, or its file `times`",
            explains=frozenset(scan.alignment.rig_from_camera),
        )


def check_displaced_pairs(scan: ScanEvidence) -> Iterator[Finding]:
    """Pairs displaced by more than sway and their calibration's errors explain."""
    if scan.person_alignment is None:
        return
    search = scan.person_alignment.search
    boards_mm = np.array(list(scan.rig.boards_mm.values()) or [0.0])
    expected_mm = float(np.sqrt(np.mean(boards_mm**2) / 3.0))  # along one axis
    girth_mm = float(np.sqrt(max(search.offset_mm**2 - expected_mm**2, 0.0))) * GIRTH_PER_MM
    if girth_mm <= scan.use.good_girth_mm:
        return
    sways = search.sway_mm > STILL_MM
    yield Finding(
        "repeat" if girth_mm > scan.use.usable_girth_mm and not sways else "usable",
        f"the pairs are displaced by {search.offset_mm:.1f} mm RMS from their calibrated poses, and no "
        f"sway explains it. Possible causes: {'head or arms moved; ' if sways else ''}the rig was "
        "moved since the calibration. Take a board shot, or calibrate again",
    )


def check_motion(scan: ScanEvidence) -> Iterator[Finding]:
    """The effect of motion on girths: of what following the person left, or of how far the pairs
    were moved beyond what their own pose errors explain."""
    alignment = None if scan.poses_corrected else scan.alignment
    usable_mm = scan.use.usable_girth_mm
    for part in scan.person.parts if scan.person else ():
        girth_mm = part.left_mm * GIRTH_PER_MM
        if girth_mm > usable_mm:
            yield Finding(
                "repeat" if girth_mm > 3.0 * usable_mm else "usable",
                f"the {part.name} moved by {part.moved_mm:.1f} mm during the scan, of which "
                f"{part.left_mm:.1f} mm are left after correction: rescan if that is too much",
            )
    if scan.person or alignment is None or not alignment.motion_mm:
        return
    # Motions within three sigmas of the boards' may be errors that these left open.
    beyond_mm = {
        name: np.sqrt(max(mm**2 - (3.0 * scan.rig.boards_mm.get(name, 0.0)) ** 2, 0.0))
        for name, mm in alignment.motion_mm.items()
    }
    name = max(beyond_mm, key=lambda one: beyond_mm[one])
    girth_mm = beyond_mm[name] * UNCORRECTED_SHARE * GIRTH_PER_MM
    if girth_mm > usable_mm:
        yield Finding(
            "repeat" if girth_mm > 2.0 * usable_mm else "usable",
            f"the person moved by {alignment.motion_mm[name]:.1f} mm between the pairs' captures "
            f"(pair {name})",
        )
