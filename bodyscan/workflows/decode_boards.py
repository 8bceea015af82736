"""The stripes of all pairs on all boards, decoded; what could not be, said once for each cause."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from bodyscan.boards.view import BoardView
from bodyscan.calibration.pair import BoardBoundaries, boundaries_near
from bodyscan.captures.folder import Captures, ImageSequence
from bodyscan.errors import BodyscanError, plainly
from bodyscan.progress import Progress, silent, threaded
from bodyscan.registration.rig_solve import PlacedRig
from bodyscan.rig.rig import Rig
from bodyscan.workflows.decoding import decode_sequence

FEW = 2
"""So many shots are told one by one, more with the same fault together."""

Failure = tuple[ImageSequence, BodyscanError]


@dataclass(frozen=True, eq=False)
class DecodedBoards:
    """boundaries: near each board, by (pair, shot, board).  notes: on sequences that are bad.

    failed: pairs of which none could be decoded, all for the same reason.
    """

    boundaries: dict[tuple[str, str, str], BoardBoundaries]
    notes: tuple[str, ...]
    failed: dict[str, str]


def decode_on_boards(
    rig: Rig,
    captures: Captures,
    placed: PlacedRig,
    views: Sequence[BoardView],
    progress: Progress = silent,
) -> DecodedBoards:
    """Stripe boundaries near the boards that took part in placing the rig."""
    kept = {(view.pair, view.shot, view.board) for view in placed.views}
    wanted: dict[tuple[str, str], list[BoardView]] = {}
    for view in views:
        if (view.pair, view.shot, view.board) in kept:
            wanted.setdefault((view.pair, view.shot), []).append(view)
    sequences = [s for s in captures.sequences if s.has_stripes and (s.pair, s.shot) in wanted]

    def decode(sequence: ImageSequence) -> dict[tuple[str, str, str], BoardBoundaries] | Failure:
        try:
            stripes = decode_sequence(sequence, rig.pair(sequence.pair))
        except BodyscanError as error:
            return sequence, error
        return {
            (view.pair, view.shot, view.board): boundaries_near(stripes, view)
            for view in wanted[sequence.pair, sequence.shot]
        }

    results = threaded(decode, sequences, stage="decoding stripes", progress=progress)
    boundaries = {
        key: found
        for result in results
        if isinstance(result, dict)
        for key, found in result.items()
    }
    failures = [result for result in results if not isinstance(result, dict)]
    failed = hopeless(failures, {pair for pair, _, _ in boundaries})
    return DecodedBoards(
        boundaries, tuple(failure_notes([f for f in failures if f[0].pair not in failed])), failed
    )


def hopeless(failures: Sequence[Failure], good: set[str]) -> dict[str, str]:
    """Pairs that failed in every shot and in the same way, with the reason."""
    reasons: dict[str, set[str]] = defaultdict(set)
    for sequence, error in failures:
        reasons[sequence.pair].add(plainly(error))
    return {
        pair: next(iter(said))
        for pair, said in reasons.items()
        if pair not in good and len(said) == 1
    }


def failure_notes(failures: Sequence[Failure]) -> Iterator[str]:
    same: dict[tuple[str, str], list[Failure]] = defaultdict(list)
    for failure in failures:
        same[failure[0].pair, plainly(failure[1])].append(failure)
    for (pair, said), group in same.items():
        if len(group) <= FEW:
            yield from (str(error) for _, error in group)
        else:
            shots = ", ".join(sequence.shot for sequence, _ in group)
            yield f"{pair}: {said}\n  in {len(group)} shots: {shots}"
