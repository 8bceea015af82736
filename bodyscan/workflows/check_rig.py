"""Check a calibrated rig: choose the check that fits the captures, and put its result into words."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from bodyscan.alignment.displaced_poles import MIN_SCANS
from bodyscan.captures.folder import Captures, join_captures, open_check
from bodyscan.errors import BadInput, FailedWork
from bodyscan.progress import Progress, silent
from bodyscan.registration.rig_calibration import RigCalibration
from bodyscan.workflows.check_boards import BoardCheck, apply_moves, check_boards, move_line
from bodyscan.workflows.check_scans import ScanCheck, check_scans


@dataclass(frozen=True, eq=False)
class Findings:
    """The result of either check, in words; the first of `lines` is the verdict."""

    check: BoardCheck | ScanCheck
    lines: tuple[str, ...]

    @property
    def valid(self) -> bool:
        """Whether the rig is known to be unchanged; False if that is undecided."""
        if isinstance(self.check, ScanCheck) and not self.check.decided:
            return self.check.quiet
        return self.check.valid

    def repair(self, calibration: RigCalibration) -> RigCalibration:
        """Correct the poses of what moved. Raises FailedWork if the check does not determine them."""
        if isinstance(self.check, ScanCheck):
            raise FailedWork(
                "scans of people show that something moved, but not exactly where it is now",
                remedy="take a few shots of the board and repair from those",
            )
        projectors = [offset.pair for offset in self.check.stripes if offset.moved]
        if projectors:
            raise FailedWork(
                f"the projector of {', '.join(projectors)} moved against its camera",
                remedy="capture the stripes on the board again and run calibrate-rig: only a new "
                "calibration of that pair corrects this",
            )
        if not self.check.drift.moves:
            raise FailedWork("nothing moved: there is nothing to repair")
        return apply_moves(calibration, self.check.drift.moves)


def check_rig(
    calibration: RigCalibration,
    folders: Sequence[Path],
    progress: Progress = silent,
    *,
    follow_links: bool = False,
) -> Findings:
    """Check a rig with folders of one kind: shots of the board, or scans of people.

    Raises CaptureError for folders without captures, BadInput for a mixture of kinds,
    BoardNotFound, and ScanFailed if nobody is in a scan.
    """
    if follow_links:
        described = calibration.rig.model_copy(update={"follow_links": True})
        calibration = replace(calibration, rig=described)
    opened = [open_check(calibration.rig, folder) for folder in folders]
    kinds, captures = {kind for kind, _ in opened}, [found for _, found in opened]
    if len(kinds) > 1:
        raise BadInput(
            "shots of boards and scans of people cannot be checked together",
            where=", ".join(map(str, folders)),
            remedy="check one kind at a time",
        )
    if kinds == {"scan"}:
        return describe_scan_check(check_scans(calibration, captures, progress))
    shots = join_captures(tuple(number_shots(captures)))
    return describe_board_check(calibration, check_boards(calibration, shots, progress))


def number_shots(folders: Sequence[Captures]) -> list[Captures]:
    """Put the folder's number before the name of each shot, if there are several folders."""
    if len(folders) == 1:
        return list(folders)
    return [
        replace(
            captures,
            shots=tuple(f"{number}/{shot}" for shot in captures.shots),
            sequences=tuple(replace(s, shot=f"{number}/{s.shot}") for s in captures.sequences),
        )
        for number, captures in enumerate(folders, start=1)
    ]


def describe_board_check(calibration: RigCalibration, check: BoardCheck) -> Findings:
    """Put the check by boards into words."""
    drift = check.drift
    shared = bool(drift.rig_from_board)
    agreed = "all that see the board agree" if shared else "the stripes lie on the board"
    wrong = "the stripes do not lie on the board"
    if drift.moves:
        wrong = "something moved; --repair writes a corrected calibration"
    lines = [f"valid: {agreed}" if check.valid else f"NOT valid: {wrong}"]
    lines += [move_line(move) for move in drift.moves]
    for offset in filter(lambda offset: offset.moved, check.stripes):
        imported = calibration.pairs[offset.pair].quality.imported
        other = f", or {imported} is not its calibration" if imported else ""
        lines.append(
            f"{offset.pair}: the stripes measure the board {offset.offset_mm:+z.2f} mm from its "
            f"corners, tilted by {offset.tilt_mm:+z.2f} mm at its ends. Possible causes: the projector "
            f"moved against its camera{other}"
        )
    if shared:
        after = f", {drift.misfit:.1f} after the moves" if drift.moves else ""
        lines.append(
            f"{len(check.checked)} pairs saw a board; their views differ by "
            f"{drift.misfit_before:.1f} sigmas RMS{after}"
        )
    if check.stripes:
        worst = max(check.stripes, key=lambda offset: abs(offset.offset_mm))
        lines.append(
            f"stripes of {len(check.stripes)} pairs lie within {abs(worst.offset_mm):.2f} mm of the "
            f"board (worst: {worst.pair})"
        )
    if check.unchecked:
        lines.append(f"not checked, because they saw no board: {', '.join(check.unchecked)}")
    if drift.lonely:
        lonely = ", ".join(drift.lonely)
        lines.append(f"not checked, because no other pair saw their board: {lonely}")
    return Findings(check, (*lines, *(f"note: {note}" for note in check.notes)))


def describe_scan_check(check: ScanCheck) -> Findings:
    """Put the check by scans into words."""
    step = check.search.found
    count = len(check.before_mm)
    scans = "1 scan" if count == 1 else f"{count} scans"
    if not check.valid:
        verdict = "NOT valid: no motion of a person explains how the pairs differ"
    elif check.groups:
        groups = "; ".join(", ".join(group) for group in check.groups)
        verdict = (
            f"undecided: no surface is seen by more than one of these groups of pairs: {groups}. "
            "Scans do not determine how these stand to each other: give shots of a board that they "
            "share"
        )
    elif check.decided:
        verdict = (
            f"valid: a pole or pair that moved by {check.detectable_mm:.1f} mm would be noticed"
        )
    elif check.quiet:
        verdict = "valid: all pairs see the same surface, and alignment moves none of them"
    else:
        known = np.isfinite(check.detectable_mm)
        less = f" by less than {check.detectable_mm:.1f} mm" if known else ""
        more = f"{MIN_SCANS} scans or more" if count < MIN_SCANS else "more scans"
        verdict = (
            f"undecided: in {scans}, a pair that moved{less} cannot be distinguished from a person's "
            f"sway; give {more}, or a shot of the board (with `kind: calibration` in its captures.yaml)"
        )
    lines = [verdict]
    if step is not None:
        lines.append(
            f"{step.name} is displaced by {step.shift_mm:.1f} mm and rotated by "
            f"{step.rotation_deg:.2f} degrees"
        )
    for drift in (*check.poles, *check.pairs):
        if drift.moved and (step is None or drift.pair not in step.name):
            lines.append(f"{drift.pair}: {drift.shift_mm:.2f} mm (sigma {drift.sigma_mm:.2f})")
    before, after = max(check.before_mm), max(check.after_mm)
    if np.isfinite(before):
        lines.append(f"overlaps in {scans}: {before:.2f} mm RMS at most, {after:.2f} aligned")
    farthest = max(check.pairs, key=lambda drift: drift.shift_mm)
    lines.append(f"moved most on average: {farthest.pair}, {farthest.shift_mm:.2f} mm")
    return Findings(check, tuple(lines))
