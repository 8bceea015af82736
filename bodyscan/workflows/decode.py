"""Decode stripe sequences: image files to stripe maps, and boards to stripe boundaries."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

from bodyscan.arrays import WHOLE, Crop
from bodyscan.boards.view import BoardView, ViewKey
from bodyscan.calibration.board_views import LocatedView
from bodyscan.calibration.boundary_points import (
    BoardBoundaries,
    Box,
    StripedView,
    compute_box,
    compute_print_box,
    crop_around,
    on_print,
    select_boundaries_near,
    thin_bands,
)
from bodyscan.calibration.camera import CameraCalibration
from bodyscan.captures.folder import Captures, ImageSequence
from bodyscan.captures.images import read_sequence
from bodyscan.errors import BodyscanError, DecodingFailed, ImageError, format_error, group_reasons
from bodyscan.outcome import Outcome
from bodyscan.progress import Progress, attempt_each, silent
from bodyscan.rig.pair import Pair
from bodyscan.rig.rig import Rig
from bodyscan.rig.templates import fill
from bodyscan.stripes.decoding import decode_stripes
from bodyscan.stripes.stripe_code import StripeCode
from bodyscan.stripes.stripe_limits import StripeLimits
from bodyscan.stripes.stripe_map import StripeMap


def decode_sequence(
    sequence: ImageSequence, pair: Pair, *, limits: StripeLimits | None = None, crop: Crop = WHOLE
) -> StripeMap:
    """Read and decode what `pair` took in one shot.

    limits: see `decode_stripes`.
    crop: rows and columns of the images to decode; the map covers these alone.

    Raises ImageError for bad files; DecodingFailed (naming pair and shot) for frames that do not
    form a code, or a pair without a projector. If only images of the crossing stripes are missing,
    bad or out of order, the map is that of the other direction and says why.
    """
    where = f"pair {sequence.pair}, shot {sequence.shot}"
    if pair.projector is None:
        raise DecodingFailed("this pair has no projector", where=where)

    def decode(sequence: ImageSequence, projector: StripeCode) -> StripeMap:
        images = read_sequence(sequence, pair.camera, crop=crop, workers=1)
        return decode_stripes(
            projector, images.lit, images.dark, images.coded, limits=limits, where=where
        )

    single_direction = pair.projector.model_copy(update={"crossing": None})
    first_direction = (sequence.without_crossing, single_direction)
    if sequence.missing and set(sequence.crossing).issuperset(sequence.missing):
        fault = f"images are missing, such as {sequence.missing[0]}"
        return replace(decode(*first_direction), crossing_fault=fault)
    try:
        return decode(sequence, pair.projector)
    except ImageError as error:
        if pair.projector.crossing is None or sequence.missing:
            raise
        return replace(decode(*first_direction), crossing_fault=str(error))


@dataclass(frozen=True, eq=False)
class BoardStripes:
    """What one sequence shows on boards."""

    boundaries: Mapping[ViewKey, BoardBoundaries]  # near each view
    faults: tuple[str, ...] = ()  # see `StripeMap.faults`


@dataclass(frozen=True, eq=False)
class PrintAreas:
    """Where the prints of boards lie in the images, by the pose that each camera finds by itself.

    A rig has tens of millions of boundaries: only means on the prints are kept, as many as light
    sheets are fitted to. A pair by itself, whose stripes also place the boards, keeps all of them.
    """

    rig: Rig
    cameras: Mapping[str, CameraCalibration]
    located: Mapping[ViewKey, LocatedView]

    def box(self, view: BoardView) -> Box:
        """The box, px, around the print of a view's board."""
        camera, board = self.cameras[view.pair].camera, self.rig.board(view.board)
        return compute_print_box(camera, board, self.located[view.key])

    def select(
        self, view: BoardView, boundaries: BoardBoundaries, views: int, turn: int
    ) -> BoardBoundaries:
        """Mean boundaries on the print of a view's board, thinned to one of `views` views of its pair:
        see `thin_bands`."""
        code = self.rig.pair(view.pair).projector
        assert code is not None
        shot = StripedView(self.located[view.key], self.rig.board(view.board), boundaries)
        camera = self.cameras[view.pair].camera
        means = on_print(camera, code, shot.board, shot.camera_from_face, boundaries)
        return means if len(self.cameras) < 2 else thin_bands(means, code.direction, views, turn)


def decode_on_boards(
    rig: Rig,
    captures: Captures,
    views: Sequence[BoardView],
    progress: Progress = silent,
    *,
    prints: PrintAreas | None = None,
) -> Outcome[dict[ViewKey, BoardBoundaries]]:
    """Decode stripe boundaries near each of these views.

    prints: select the boundaries on the boards' prints; all within half a board's size if None.

    Bad sequences become notes, and a pair none of whose sequences can be decoded is a failure.
    """
    wanted: dict[tuple[str, str], list[BoardView]] = defaultdict(list)
    for view in views:
        wanted[view.pair, view.shot].append(view)
    sequences = [s for s in captures.sequences if s.has_stripes and (s.pair, s.shot) in wanted]
    box: Callable[[BoardView], Box] = prints.box if prints else compute_box
    count = Counter(view.pair for view in views)
    # Shots take turns in bands.
    turn = {s: captures.pair_sequences(s.pair).index(s) for s in sequences}

    def decode(sequence: ImageSequence) -> BoardStripes:
        pair, group = rig.pair(sequence.pair), wanted[sequence.pair, sequence.shot]
        boxes = [box(view) for view in group]
        crop = crop_around(boxes)
        stripes = decode_sequence(sequence, pair, crop=crop)
        near = {
            view.key: select_boundaries_near(stripes, around, crop)
            for view, around in zip(group, boxes, strict=True)
        }
        if prints:
            share = count[pair.name], turn[sequence]
            near = {view.key: prints.select(view, near[view.key], *share) for view in group}
        return BoardStripes(near, stripes.faults)

    found, errors = attempt_each(
        decode, sequences, BodyscanError, stage="decoding stripes", progress=progress
    )
    boundaries = {key: near for one in found.values() for key, near in one.boundaries.items()}
    failed, failure_notes = describe_failures(errors, {pair for pair, _, _ in boundaries})
    failed |= _list_without_stripes(rig, views, {sequence.pair for sequence in sequences})
    faults = {sequence: one.faults for sequence, one in found.items()}
    return Outcome(boundaries, (*failure_notes, *list_fault_notes(faults)), failed)


def _list_without_stripes(
    rig: Rig, views: Iterable[BoardView], decoded: set[str]
) -> dict[str, str]:
    """Pairs with a projector that saw the board but have no stripe sequence, with the reason."""
    shots = {view.pair: view.shot for view in views}
    return {
        pair.name: "no stripe sequence was found in any shot of the board: there is no image such as "
        + fill(
            rig.files, shot=shots[pair.name], pair=pair.name, frame=rig.frames.code_names(code)[0]
        )
        for pair in rig.pairs
        for code in [pair.projector]
        if code is not None and pair.name in shots and pair.name not in decoded
    }


def list_fault_notes(faults: Mapping[ImageSequence, Sequence[str]]) -> Iterator[str]:
    """One line for each pair and each fault of its images, see `StripeMap.faults`."""
    found = ((sequence, fault) for sequence, several in faults.items() for fault in several)
    for pair, fault, group in sorted(_group_faults(found), key=lambda one: one[:2]):
        names = ", ".join(sequence.shot for sequence in group)
        yield f"{pair}, shot{'s' if len(group) > 1 else ''} {names}: {fault}"


def _group_faults(
    faults: Iterable[tuple[ImageSequence, str]],
) -> list[tuple[str, str, list[ImageSequence]]]:
    """Pair, reason and sequences, see `group_reasons`."""
    by_pair: dict[str, list[tuple[ImageSequence, str]]] = defaultdict(list)
    for sequence, fault in faults:
        by_pair[sequence.pair].append((sequence, fault))
    groups = ((pair, group) for pair, some in by_pair.items() for group in group_reasons(some))
    return [(pair, fault, sequences) for pair, (sequences, fault) in groups]


def describe_failures(
    failures: Mapping[ImageSequence, BodyscanError], good: Collection[str]
) -> tuple[dict[str, str], list[str]]:
    """Pairs that failed in every shot, with the first few reasons that differ outside of brackets;
    and, of pairs that are good in some shot, one line for each reason."""
    reasons: dict[str, dict[str, str]] = defaultdict(dict)
    notes = []
    groups = _group_faults((sequence, format_error(error)) for sequence, error in failures.items())
    for pair, reason, group in groups:
        if pair not in good:
            reasons[pair].setdefault(reason.partition(" (")[0], reason)
        elif len(group) == 1:
            notes.append(str(failures[group[0]]))
        else:
            shots = ", ".join(sequence.shot for sequence in group)
            notes.append(f"{pair}: {reason}\n  in {len(group)} shots: {shots}")
    return {pair: _join([*found.values()][:3]) for pair, found in reasons.items()}, notes


def _join(reasons: Sequence[str]) -> str:
    whats, _, remedies = zip(*(reason.partition("\n") for reason in reasons), strict=True)
    several = "no stripe sequence can be decoded: " if len(reasons) > 1 else ""
    return "\n".join((several + "; or: ".join(whats), *dict.fromkeys(filter(None, remedies))))
