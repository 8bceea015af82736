"""`bodyscan check-calibration`: choose the check that fits the captures, and word its result."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from bodyscan.alignment.pair_drift import FEWEST_SCANS
from bodyscan.captures.folder import Captures, join_captures, open_check
from bodyscan.errors import BadInput, FailedWork
from bodyscan.progress import Progress, silent
from bodyscan.registration.rig_calibration import RigCalibration
from bodyscan.workflows.check_boards import BoardCheck, check_boards, move_line, repaired
from bodyscan.workflows.check_scans import ScanCheck, check_scans


@dataclass(frozen=True, eq=False)
class Findings:
    """The result of either check, in words; the first of `lines` is the verdict."""

    check: BoardCheck | ScanCheck
    lines: tuple[str, ...]

    @property
    def valid(self) -> bool:
        """Whether the rig is known to be unchanged; False if a check cannot tell."""
        if isinstance(self.check, ScanCheck) and not self.check.decided:
            return self.check.quiet
        return self.check.valid

    def repaired(self, calibration: RigCalibration) -> RigCalibration:
        """The repaired calibration. Raises FailedWork if the check cannot say what moved where."""
        if isinstance(self.check, ScanCheck):
            raise FailedWork(
                "people's scans tell that something moved, not exactly where it is now",
                remedy="show the board in a few shots and repair from those",
            )
        projectors = [offset.pair for offset in self.check.stripes if offset.moved]
        if projectors:
            raise FailedWork(
                f"the projector of {', '.join(projectors)} moved against its camera",
                remedy="only a new calibration of that pair mends this: capture the stripes on the "
                "board again and run calibrate-rig",
            )
        if not self.check.drift.moves:
            raise FailedWork("nothing moved: there is nothing to repair")
        return repaired(calibration, self.check.drift.moves)


def check_rig(
    calibration: RigCalibration,
    folders: Sequence[Path],
    progress: Progress = silent,
    *,
    follow_links: bool = False,
) -> Findings:
    """Check a rig with folders of one kind: shots of the board, or scans of people.

    follow_links: follow links even if the calibration's rig file does not allow it.

    Raises CaptureError for folders without captures, BadInput for a mixture of kinds,
    BoardNotFound, and ScanFailed if nobody is in a scan.
    """
    if follow_links:
        described = calibration.rig.model_copy(update={"follow_links": True})
        calibration = replace(calibration, rig=described)
    captures = [open_check(calibration.rig, folder) for folder in folders]
    kinds = {kind for kind, _ in captures}
    if len(kinds) > 1:
        raise BadInput(
            "shots of boards and scans of people cannot be checked together",
            where=", ".join(map(str, folders)),
            remedy="check one kind at a time",
        )
    if kinds == {"scan"}:
        return _of_scans(check_scans(calibration, [one for _, one in captures], progress))
    shots = join_captures(tuple(_named_apart([one for _, one in captures])))
    return _of_boards(calibration, check_boards(calibration, shots, progress))


def _named_apart(parts: Sequence[Captures]) -> list[Captures]:
    """Captures of several folders, with the folder's number before each shot's name."""
    if len(parts) == 1:
        return list(parts)
    return [
        replace(
            part,
            shots=tuple(f"{number}/{shot}" for shot in part.shots),
            sequences=tuple(replace(s, shot=f"{number}/{s.shot}") for s in part.sequences),
        )
        for number, part in enumerate(parts, start=1)
    ]


def _or_imported(calibration: RigCalibration, pair: str) -> str:
    imported = calibration.pairs[pair].quality.imported
    return f", or {imported} is not its calibration" if imported else ""


def _of_boards(calibration: RigCalibration, check: BoardCheck) -> Findings:
    drift = check.drift
    together = bool(drift.rig_from_board)
    valid = (
        "all that see the board agree" if together else "stripes lie where the board's corners are"
    )
    said = [
        f"valid: {valid}"
        if check.valid
        else "NOT valid: something moved; --repair writes a calibration with that put right"
        if drift.moves
        else "NOT valid: what stripes measure is not where the board is"
    ]
    said += [move_line(move) for move in drift.moves]
    said += [
        f"projector of {offset.pair} moved against its camera{_or_imported(calibration, offset.pair)}: "
        "the board's surface is measured "
        f"{offset.offset_mm:+z.2f} mm off, tilted by {offset.turned_mm:+z.2f} mm at its ends"
        for offset in check.stripes
        if offset.moved
    ]
    if together:
        said.append(
            f"{len(check.seen)} pairs saw a board; their views are {drift.misfit_before:.1f} sigmas "
            f"off (root mean square)"
            + (f", {drift.misfit:.1f} after the moves" if drift.moves else "")
        )
    if check.stripes:
        worst = max(check.stripes, key=lambda offset: abs(offset.offset_mm))
        said.append(
            f"stripes of {len(check.stripes)} pairs lie on the board to {abs(worst.offset_mm):.2f} mm "
            f"(farthest: {worst.pair})"
        )
    if check.unseen:
        said.append(f"not checked, for they saw no board: {', '.join(check.unseen)}")
    if drift.lonely:
        said.append(f"not checked, for nobody shares their board: {', '.join(drift.lonely)}")
    return Findings(check, (*said, *(f"note: {note}" for note in check.notes)))


def _of_scans(check: ScanCheck) -> Findings:
    step = check.search.step
    moved = [drift for drift in (*check.poles, *check.pairs) if drift.moved]
    if not check.valid:
        said = ["NOT valid: what no person's motion explains"]
    elif check.apart:
        groups = "; ".join(", ".join(group) for group in check.apart)
        said = [
            f"undecided: no surface is seen by more than one of these groups of pairs: {groups}. How "
            "they stand to each other a scan does not tell; give shots of the board that they share"
        ]
    elif check.decided:
        said = [f"valid: a pole or pair that had moved by {check.unseen_mm:.1f} mm would be seen"]
    elif check.quiet:
        said = ["valid: all pairs see the same surface, and alignment moves none of them"]
    else:
        less = f" by less than {check.unseen_mm:.1f} mm" if check.unseen_mm < np.inf else ""
        count = len(check.before_mm)
        more = f"{FEWEST_SCANS} scans or more" if count < FEWEST_SCANS else "more scans"
        said = [
            f"undecided: from {_scans(check)} a pair that moved{less} cannot be told from a person's "
            f"sway; give {more}, or a shot of the board (with `kind: calibration` in its captures.yaml)"
        ]
    if step is not None:
        said.append(
            f"{step.name} stands {step.shift_mm:.1f} mm off, turned by {step.turn_deg:.2f} degrees"
        )
    for drift in moved:
        if step is None or drift.pair not in step.name:
            said.append(f"{drift.pair}: {drift.shift_mm:.2f} mm (sigma {drift.sigma_mm:.2f})")
    before, after = max(check.before_mm), max(check.after_mm)
    if np.isfinite(before):
        overlaps = f"overlaps in {_scans(check)}: {before:.2f} mm RMS at most, {after:.2f} aligned"
        said.append(overlaps)
    farthest = max(check.pairs, key=lambda drift: drift.shift_mm)
    said.append(f"most moved on average: {farthest.pair}, {farthest.shift_mm:.2f} mm")
    return Findings(check, tuple(said))


def _scans(check: ScanCheck) -> str:
    count = len(check.before_mm)
    return "1 scan" if count == 1 else f"{count} scans"
