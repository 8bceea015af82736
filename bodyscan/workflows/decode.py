"""Decode stripe sequences: image files to stripe maps, and boards to stripe boundaries."""

from __future__ import annotations

import re
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import islice
from threading import Lock
from types import MappingProxyType

from bodyscan.boards.view import BoardView, ViewKey
from bodyscan.calibration.striped_view import (
    BIN_PX,
    BoardBoundaries,
    Box,
    boundaries_near,
    box_around,
    crop_around,
    most_apart,
)
from bodyscan.captures.folder import Captures, ImageSequence
from bodyscan.captures.images import read_sequence
from bodyscan.errors import BodyscanError, DecodingFailed, ImageError, format_error
from bodyscan.geometry.crop import WHOLE, Crop
from bodyscan.outcome import Outcome
from bodyscan.progress import Progress, attempt_each, silent
from bodyscan.rig.pair import Pair
from bodyscan.rig.rig import Rig
from bodyscan.rig.templates import fill
from bodyscan.stripes.decoding import decode_stripes
from bodyscan.stripes.line_bands import LineBands
from bodyscan.stripes.stripe_code import StripeCode
from bodyscan.stripes.stripe_limits import StripeLimits
from bodyscan.stripes.stripe_map import ResponseShare, StripeMap

NUMBER = re.compile(r"\d[\d.]*%?(, \d[\d.]*%?)*")
MOST_REASONS = 3
FEW = 2
"""Up to this many shots are reported one by one; more that share a fault, together."""

Failure = tuple[ImageSequence, BodyscanError]
Keep = Callable[[BoardView, BoardBoundaries], BoardBoundaries]
Through = Callable[[str, Mapping[ViewKey, BoardBoundaries]], None]
"""Called with a pair's name and the boundaries from all of its shots."""


def decode_sequence(
    sequence: ImageSequence,
    pair: Pair,
    *,
    limits: StripeLimits | None = None,
    crop: Crop = WHOLE,
    bands: LineBands | None = None,
    workers: int = 1,
) -> StripeMap:
    """Read and decode what `pair` took in one shot.

    limits, bands: see `decode_stripes`.
    crop: rows and columns of the images to decode; the map covers these alone.

    Raises ImageError for bad files; DecodingFailed (naming pair and shot) for frames that do not
    form a code, or a pair without a projector. If only images of the crossing stripes are missing,
    bad or out of order, the map is that of the other direction and says why.
    """
    where = f"pair {sequence.pair}, shot {sequence.shot}"
    if pair.projector is None:
        raise DecodingFailed("this pair has no projector", where=where)

    def decode(sequence: ImageSequence, projector: StripeCode) -> StripeMap:
        images = read_sequence(sequence, pair.camera, crop=crop, workers=workers)
        return decode_stripes(
            projector,
            images.lit,
            images.dark,
            images.coded,
            limits=limits,
            bands=bands,
            where=where,
        )

    one_way = sequence.without_crossing, pair.projector.model_copy(update={"crossing": None})
    if sequence.lacks_crossing:
        fault = f"images are missing, such as {sequence.missing[0]}"
        return replace(decode(*one_way), crossing_fault=fault)
    try:
        return decode(sequence, pair.projector)
    except ImageError as error:
        if pair.projector.crossing is None or sequence.missing:
            raise
        return replace(decode(*one_way), crossing_fault=str(error))


def _all(view: BoardView, boundaries: BoardBoundaries) -> BoardBoundaries:
    return boundaries


def _no_use(_pair: str, _found: Mapping[ViewKey, BoardBoundaries]) -> None:
    """A `Through` that does nothing."""


@dataclass(frozen=True, eq=False)
class _OnBoards:
    """What one sequence gave: boundaries near each view, what the projector's response moved, and why
    stripes that cross are not used."""

    near: Mapping[ViewKey, BoardBoundaries] = field(default_factory=dict)
    responses: tuple[ResponseShare, ...] = ()
    crossing_fault: str = ""


def decode_on_boards(
    rig: Rig,
    captures: Captures,
    views: Iterable[BoardView],
    progress: Progress = silent,
    *,
    box: Callable[[BoardView], Box] = box_around,
    keep: Keep = _all,
    every: Mapping[str, int] = MappingProxyType({}),
    through: Through = _no_use,
) -> Outcome[dict[ViewKey, BoardBoundaries]]:
    """Decode stripe boundaries near each of these views; bad sequences become notes.

    box: the part of a view's image in which stripes are wanted.
    keep: selects the boundaries of a view to keep; a rig has tens of millions.
    every: by pair, keep one in this many bands of BIN_PX along the stripes; shots take turns.
    through: called with each pair as soon as its last sequence is done, from any thread.

    A pair none of whose sequences can be decoded is a failure.
    """
    wanted: dict[tuple[str, str], list[BoardView]] = defaultdict(list)
    for view in views:
        wanted[view.pair, view.shot].append(view)
    sequences = [s for s in captures.sequences if s.has_stripes and (s.pair, s.shot) in wanted]

    turn = {s: captures.of_pair(s.pair).index(s) for s in sequences}

    def decode(sequence: ImageSequence) -> _OnBoards:
        own = wanted[sequence.pair, sequence.shot]
        boxes = [box(view) for view in own]
        crop = crop_around(boxes)
        pair = rig.pair(sequence.pair)
        apart = min(every.get(pair.name, 1), most_apart(boxes, pair.camera))
        corner = crop[0].start, crop[1].start
        bands = LineBands(BIN_PX, apart, turn[sequence], corner)
        stripes = decode_sequence(sequence, pair, crop=crop, bands=bands)
        near = {
            view.key: keep(view, boundaries_near(stripes, around, crop))
            for view, around in zip(own, boxes, strict=True)
        }
        return _OnBoards(near, tuple(responses_in(stripes)), stripes.crossing_fault)

    decoded, errors = attempt_each(
        _telling(decode, sequences, through),
        sorted(sequences, key=lambda sequence: sequence.pair),
        BodyscanError,
        stage="decoding stripes",
        progress=progress,
    )
    responses: dict[str, list[ResponseShare]] = defaultdict(list)
    for sequence, found in decoded.items():
        responses[sequence.pair] += found.responses
    boundaries = {
        key: near for s in sequences if s in decoded for key, near in decoded[s].near.items()
    }
    failures = [(sequence, errors[sequence]) for sequence in sequences if sequence in errors]
    failed = failed_pairs(failures, {pair for pair, _, _ in boundaries})
    failed |= _without_stripes(rig, wanted, {sequence.pair for sequence in sequences})
    kept = [failure for failure in failures if failure[0].pair not in failed]
    notes = (
        *failure_notes(kept),
        *one_way_notes({s: found.crossing_fault for s, found in decoded.items()}),
        *response_notes(responses),
    )
    return Outcome(boundaries, notes, failed)


def _telling(
    decode: Callable[[ImageSequence], _OnBoards],
    sequences: Iterable[ImageSequence],
    through: Through,
) -> Callable[[ImageSequence], _OnBoards]:
    """`decode`, which tells of a pair what its sequences gave as soon as the last of them is done."""
    by_pair: dict[str, dict[ViewKey, BoardBoundaries]] = defaultdict(dict)
    left, counting = Counter(sequence.pair for sequence in sequences), Lock()

    def telling(sequence: ImageSequence) -> _OnBoards:
        found = _OnBoards()
        try:
            found = decode(sequence)
        finally:
            with counting:
                by_pair[sequence.pair] |= found.near
                left[sequence.pair] -= 1
                last = not left[sequence.pair]
            if last:
                through(sequence.pair, by_pair.pop(sequence.pair))
        return found

    return telling


def _without_stripes(
    rig: Rig, wanted: Iterable[tuple[str, str]], striped: set[str]
) -> dict[str, str]:
    """Pairs with a projector that saw the board but have no stripe sequence, with the reason."""
    shots = dict(wanted)
    return {
        pair.name: "no stripe sequence was found in any shot of the board: there is no image such as "
        + fill(rig.files, shot=shots[pair.name], pair=pair.name, frame=rig.frames.of_code(code)[0])
        for pair in rig.pairs
        for code in [pair.projector]
        if code is not None and pair.name in shots and pair.name not in striped
    }


def one_way_notes(faults: Mapping[ImageSequence, str]) -> Iterator[str]:
    """One line for each pair and each reason why its crossing stripes are not used."""
    shots: dict[tuple[str, str], list[tuple[str, str]]] = defaultdict(list)
    for sequence, fault in faults.items():
        if fault:
            # Details that differ between shots, shares and file names, are quoted from the first.
            alike = NUMBER.sub("", fault.partition("such as")[0])
            shots[sequence.pair, alike].append((sequence.shot, fault))
    for (pair, _), own in sorted(shots.items()):
        named, fault = ", ".join(shot for shot, _ in own), own[0][1]
        yield (
            f"{pair}: stripes of the first direction alone are used in "
            f"shot{'s' if len(own) > 1 else ''} {named}, not those of `crossing`: {fault}"
        )


def responses_in(stripes: StripeMap) -> list[ResponseShare]:
    """Response corrections in a stripe map and its crossing map."""
    maps = (stripes, stripes.crossing)
    return [one.response for one in maps if one is not None and one.response is not None]


def response_notes(responses: Mapping[str, Sequence[ResponseShare]]) -> Iterator[str]:
    """One line for each pair with a corrected projector response, quoting its strongest shot."""
    for pair, shares in sorted(responses.items()):
        if shares:
            yield f"{pair}: {max(shares, key=lambda share: share.response_rms)}"


def failed_pairs(failures: Sequence[Failure], good: set[str]) -> dict[str, str]:
    """Pairs that failed in every shot, with the reason, or the first few of several reasons."""
    reasons: dict[str, dict[str, str]] = defaultdict(dict)
    for sequence, error in failures:
        said = format_error(error)
        # One fault gives a different share of pixels in each shot.
        reasons[sequence.pair].setdefault(NUMBER.sub("", said), said)
    return {
        pair: next(iter(said.values()))
        if len(said) == 1
        else "no stripe sequence can be decoded: "
        + "\n  or: ".join(islice(said.values(), MOST_REASONS))
        for pair, said in reasons.items()
        if pair not in good
    }


def failure_notes(failures: Sequence[Failure]) -> Iterator[str]:
    """One line a shot, or one for all shots of a pair that failed alike."""
    same: dict[tuple[str, str], list[Failure]] = defaultdict(list)
    for failure in failures:
        same[failure[0].pair, format_error(failure[1])].append(failure)
    for (pair, said), group in same.items():
        if len(group) <= FEW:
            yield from (str(error) for _, error in group)
        else:
            shots = ", ".join(sequence.shot for sequence, _ in group)
            yield f"{pair}: {said}\n  in {len(group)} shots: {shots}"
