"""Remarks on a calibrated rig, which the calibration itself does not need: notes and advice."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

from bodyscan.boards.view import BoardView
from bodyscan.calibration.board_views import coverage_notes
from bodyscan.calibration.pair import PairCalibration
from bodyscan.optional import optional
from bodyscan.progress import Progress, silent, step
from bodyscan.registration.advice import advise
from bodyscan.registration.board_checks import boards_not_found
from bodyscan.registration.halves import compare_halves
from bodyscan.registration.rig_calibration import RigCalibration
from bodyscan.registration.rig_solve import RigSolution


@dataclass(frozen=True, eq=False)
class SolvedRig:
    """A calibration and what the remarks on it are made from.

    solution: the joint solve, including pairs that failed later.
    views: all boards that were found.
    images: number of images in which boards were looked for.
    """

    calibration: RigCalibration
    solution: RigSolution
    views: Sequence[BoardView]
    images: int


def add_remarks(solved: SolvedRig, progress: Progress = silent) -> RigCalibration:
    """Add notes on the boards, and advice, to a calibration.

    None of these is essential: a remark that fails is replaced by a note.
    """
    found = solved.calibration
    notes: list[str] = list(found.notes)
    advice: list[str] = []
    with optional("coverage of the pictures", notes.append):
        notes += coverage_notes(found.rig, solved.views)
    with optional("boards that were not found", notes.append):
        notes += boards_not_found(found.rig, solved.views, solved.images)
    if len(solved.solution.rig_from_camera) > 1 and not found.failed:
        with step(progress, "advice"):
            with optional("advice", notes.append):
                advice += advise(found.rig, solved.solution).lines
            with optional("halves of the shots", notes.append):
                advice.append(compare_halves(found.rig, solved.solution).summary)
    with optional("boards by the stripes", notes.append):
        advice += stripe_board_notes(found.pairs)
    return replace(found, notes=tuple(notes), advice=tuple(advice))


def stripe_board_notes(pairs: Mapping[str, PairCalibration]) -> Iterator[str]:
    """Say how far the boards as measured by the stripes lie from their corners."""
    boards = {n: p.quality.boards_mm for n, p in pairs.items() if p.quality.boards_mm is not None}
    if boards:
        worst = max(sorted(boards), key=lambda name: boards[name][1])
        mean = sum(mean for mean, _ in boards.values()) / len(boards)
        rms = (sum(rms**2 for _, rms in boards.values()) / len(boards)) ** 0.5
        yield (
            f"measured by the stripes, boards lie {mean:+z.3f} mm (mean) and {rms:.3f} mm (RMS) from "
            f"where the corners put them; worst: {worst}, {boards[worst][1]:.3f} mm"
        )
