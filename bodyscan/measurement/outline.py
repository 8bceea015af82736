"""A slice's outline where nothing was measured: cut where filled surface joins limbs, with a range.

A web between arm and trunk is filled in front and behind. Cut there, with the trunk closed along
itself, the outline is that of the trunk; as meshed it is that of trunk and arms together. Which is
nearer to the body was not observed, so both are given.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from bodyscan.arrays import Array
from bodyscan.mesh.slices import Loop, Run, join_runs, split_runs

Range = tuple[float, float]


@dataclass(frozen=True, eq=False)
class Outline:
    """An outline, and how long it may be.

    loop: cut where filled surface joins limbs.
    girth_range_mm, tape_range_mm: from closed straight across everything unmeasured, to as meshed.
    """

    loop: Loop
    girth_range_mm: Range
    tape_range_mm: Range


def find_outline(loop: Loop) -> Outline:
    """Cut limbs that filled surface joins to the trunk from a slice's loop, body frame."""
    runs = split_runs(loop)
    kept = _trunk_alone(loop, runs) if holds_middle(loop.segments[..., 1]) else runs
    cut = join_runs(loop, kept) if len(kept) < len(runs) else loop
    known = join_runs(loop, [run for run in kept if run.measured] or kept)
    girths = cut.girth_mm, known.girth_mm, loop.girth_mm
    tapes = cut.tape_mm, known.tape_mm, loop.tape_mm
    return Outline(cut, (min(girths), max(girths)), (min(tapes), max(tapes)))


def holds_middle(y: Array) -> bool:
    """Whether points (y to the left) lie on both sides of y = 0, by 0.15 of their width or more."""
    low, high = float(y.min()), float(y.max())
    return min(high, -low) > 0.15 * (high - low)


def _trunk_alone(loop: Loop, runs: Sequence[Run]) -> Sequence[Run]:
    """The runs of an outline without the limbs that two filled runs join to it."""
    for trunk, limb in _in_two(runs):
        if _on_both_sides(loop, trunk) and _is_limb(loop, limb):
            return _trunk_alone(loop, trunk)
    return runs


def _in_two(runs: Sequence[Run]) -> Iterator[tuple[Sequence[Run], Sequence[Run]]]:
    """Every cut from one filled run to another, both ways round, without these two runs."""
    gaps = [k for k, run in enumerate(runs) if not run.measured]
    for one, other in combinations(gaps, 2):
        inner, outer = runs[one + 1 : other], [*runs[other + 1 :], *runs[:one]]
        if inner and outer:
            yield inner, outer
            yield outer, inner


def _is_limb(loop: Loop, runs: Sequence[Run]) -> bool:
    """Whether the runs lie on one side of the middle and go round more than half way."""
    arc = sum(loop.lengths[run.segments].sum() for run in runs)
    chord = np.linalg.norm(loop.segments[runs[0].first, 0] - loop.segments[runs[-1].last, 1])
    # Half a circle has a chord of 2 / pi of its arc.
    return bool(chord < 2.0 / np.pi * arc) and not _on_both_sides(loop, runs)


def _on_both_sides(loop: Loop, runs: Sequence[Run]) -> bool:
    return holds_middle(loop.segments[np.concatenate([run.segments for run in runs]), :, 1])
