"""Values on a grid where nobody measured any: harmonic, that is each the mean of its neighbours.

Solved on grids twice, four and eight times as coarse first: sweeps move what is near, levels what is
far. Nodes may have a least value: places that cameras saw through are outside, whatever the
neighbours say.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bodyscan.arrays import Floats, Mask
from bodyscan.compiled import compiled

SWEEPS = 16
COARSEST_SWEEPS = 200
COARSEST = 16  # nodes along the shortest side of the coarsest grid, at most
OVERSHOOT = 1.6  # successive over-relaxation


def fill_harmonically(values: Floats, fixed: Mask, least: Floats, sure: float) -> Floats:
    """Values (a, b, c) with those that are not fixed filled in; the grid's rim has to be fixed.

    least: (a, b, c), of nodes that are not fixed; -inf for no bound.  sure: a node that a coarser
    grid gives a value farther from 0 keeps it: only where zero lies is asked for.
    """
    if min(values.shape) <= COARSEST or any(size % 2 for size in values.shape):
        found, sweeps = np.where(fixed, values, np.maximum(np.float32(0.0), least)), COARSEST_SWEEPS
        unsure = ~fixed
    else:
        coarse = fill_harmonically(*_halved(values, fixed, least), sure)
        found, sweeps = np.where(fixed, values, np.maximum(_doubled(coarse), least)), SWEEPS
        unsure = ~fixed & (np.abs(found) < sure)
    found = np.ascontiguousarray(found, np.float32)
    nodes = np.flatnonzero(unsure).astype(np.int32)
    _relax(found.ravel(), nodes, found.shape[1:], least.ravel(), sweeps)
    return found


def _halved(values: Floats, fixed: Mask, least: Floats) -> tuple[Floats, Mask, Floats]:
    """Each node for eight: fixed at the mean of those that are; the mean of the bounds if all have
    one."""

    def total(part: Floats) -> Floats:
        # An axis at a time: numpy's reduction over three of them takes several times as long.
        part = part[::2] + part[1::2]
        part = part[:, ::2] + part[:, 1::2]
        return part[:, :, ::2] + part[:, :, 1::2]

    count = total(fixed.astype(np.float32))
    known = total(np.where(fixed, values, np.float32(0.0))) / np.maximum(count, np.float32(1.0))
    return np.asarray(known, np.float32), count > 0, total(0.125 * least)


def _doubled(coarse: Floats) -> Floats:
    return coarse.repeat(2, axis=0).repeat(2, axis=1).repeat(2, axis=2)


@compiled
def _relax(
    values: Floats, some: NDArray[np.int32], shape: tuple[int, ...], least: Floats, sweeps: int
) -> None:
    """Gauss and Seidel's sweeps over some nodes, to and fro, with over-relaxation."""
    a, b = shape[0] * shape[1], shape[1]
    keep, share = np.float32(1.0 - OVERSHOOT), np.float32(OVERSHOOT / 6.0)
    for sweep in range(sweeps):
        way = 1 if sweep % 2 == 0 else -1
        for n in range(len(some)):
            at = some[n if way > 0 else len(some) - 1 - n]
            others = values[at - a] + values[at + a] + values[at - b] + values[at + b]
            new = keep * values[at] + share * (others + values[at + way])
            new += share * values[at - way]  # last: it was computed just now, and is waited for
            values[at] = max(new, least[at])
