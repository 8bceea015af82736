"""Remarks on a calibrated rig, apart from the calibration itself: boards, ties, halves."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

from bodyscan.boards.view import BoardView
from bodyscan.calibration.coverage import coverage_notes
from bodyscan.calibration.pair import PairCalibration
from bodyscan.optional import optional
from bodyscan.progress import Progress, silent, step
from bodyscan.registration.advice import advise
from bodyscan.registration.board_checks import boards_not_found
from bodyscan.registration.halves import compare_halves
from bodyscan.registration.rig_calibration import RigCalibration
from bodyscan.registration.rig_solve import RigSolution


@dataclass(frozen=True, eq=False)
class JoinedRig:
    """A calibration and what the remarks on it are made from.

    placed: the joint solve, including pairs that failed later.
    views: all boards that were found.
    images: number of images that could be searched.
    """

    calibration: RigCalibration
    placed: RigSolution
    views: Sequence[BoardView]
    images: int


def remarked(found: JoinedRig, progress: Progress = silent) -> RigCalibration:
    """The calibration with notes on its boards, and advice.

    None of these is essential: a remark that fails is replaced by a note.
    """
    own, placed = found.calibration, found.placed
    notes: list[str] = list(own.notes)
    advice: list[str] = []
    with optional("coverage of the pictures", notes.append):
        notes += coverage_notes(own.rig, found.views)
    with optional("boards that were not found", notes.append):
        notes += boards_not_found(own.rig, found.views, found.images)
    if len(placed.rig_from_camera) > 1 and not own.failed:
        with step(progress, "advice"):
            with optional("advice", notes.append):
                advice += advise(own.rig, placed).lines
            with optional("halves of the shots", notes.append):
                advice.append(compare_halves(own.rig, placed).summary)
    with optional("boards by the stripes", notes.append):
        advice += stripe_board_notes(own.pairs)
    return replace(own, notes=tuple(notes), advice=tuple(advice))


def stripe_board_notes(pairs: Mapping[str, PairCalibration]) -> Iterator[str]:
    """A line on how far the boards as measured by the stripes lie from their corners."""
    boards = {n: p.quality.boards_mm for n, p in pairs.items() if p.quality.boards_mm is not None}
    if boards:
        worst = max(sorted(boards), key=lambda name: boards[name][1])
        mean = sum(mean for mean, _ in boards.values()) / len(boards)
        rms = (sum(rms**2 for _, rms in boards.values()) / len(boards)) ** 0.5
        yield (
            f"measured by the stripes, boards lie {mean:+z.3f} mm (mean) and {rms:.3f} mm (RMS) from "
            f"where the corners put them; worst: {worst}, {boards[worst][1]:.3f} mm"
        )
