"""In which order a rig's pairs take their frames."""

from __future__ import annotations

from itertools import zip_longest

from bodyscan.rig.devices import Order
from bodyscan.rig.pair import Pair
from bodyscan.rig.rig import Rig

Step = tuple[tuple[str, str], ...]
"""Pairs, each with the frame that it takes; all of a step at the same time."""
Turn = tuple[Step, ...]
"""Steps that belong together: images of a turn are written when all of it is taken."""


def list_frames(rig: Rig, pair: Pair) -> tuple[str, ...]:
    """Names of a pair's frames in the order in which they are shown."""
    code, names = pair.projector, rig.frames
    if code is None:
        return names.sequence_names(None)
    dark = names.dark if any(one.uses_dark for one in code.directions) else None
    return (*filter(None, (names.board, names.lit, dark)), *names.shown_names(code))


def plan_turns(rig: Rig, order: Order) -> tuple[Turn, ...]:
    """The turns of a shot, by `CapturePlan.order`.

    poles: the k-th pairs of all poles project at the same time; a pair without a pole is treated as
    a pole with one pair. interleaved: one turn; frame k of every pair in succession.
    """
    frames = {pair.name: list_frames(rig, pair) for pair in rig.pairs}
    if order == "one-after-another":
        groups = [[name] for name in frames]
    elif order == "interleaved":
        groups = [list(frames)]
    else:
        poles: dict[str, list[str]] = {}
        for pair in rig.pairs:
            poles.setdefault(pair.pole or f"/{pair.name}", []).append(pair.name)
        groups = [list(filter(None, group)) for group in zip_longest(*poles.values())]
    turns = []
    for group in groups:
        rounds = zip_longest(*([(name, frame) for frame in frames[name]] for name in group))
        steps = [tuple(filter(None, one)) for one in rounds]
        if order == "interleaved":
            steps = [(each,) for step in steps for each in step]
        turns.append(tuple(steps))
    return tuple(turns)
