"""Harmonic values on a grid where nothing was measured: each is the mean of its neighbours.

Solved first on grids two, four and eight times as coarse: sweeps settle what is near, levels what
is far. Nodes may have a lower bound: places that cameras saw through are outside, whatever their
neighbours say.
"""

from __future__ import annotations

from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from bodyscan.arrays import Floats, Mask
from bodyscan.compiled import compiled

SWEEPS = 16
COARSEST_SWEEPS = 200
COARSEST = 16  # nodes along the shortest side of the coarsest grid, at most
OVERSHOOT = 1.6  # successive over-relaxation
NEAR = 2  # nodes of a coarser grid, which is off by less than one where it puts the zero set
PUSHED = SWEEPS // 2  # nodes of a coarser grid: as far as sweeps carry a bound that it lacks

Values = TypeVar("Values", Floats, Mask)


def fill_harmonically(values: Floats, fixed: Mask, least: Floats, sure: float) -> Floats:
    """Fill in the values (a, b, c) that are not fixed; the grid's rim must be fixed.

    least: lower bounds (a, b, c) of nodes that are not fixed; -inf for none.
    sure: nodes that a coarser grid puts farther from 0 keep its value, and so do those far from any
        change of sign and from any bound that pushes, since only the zero set matters.
    """
    if min(values.shape) <= COARSEST or any(size % 2 for size in values.shape):
        found, sweeps = np.where(fixed, values, np.maximum(np.float32(0.0), least)), COARSEST_SWEEPS
        unsure = ~fixed
    else:
        coarse = fill_harmonically(*_halved(values, fixed, least), sure)
        guess, near = _doubled(coarse), _near_zero(coarse)
        found, sweeps = np.where(fixed, values, np.maximum(guess, least)), SWEEPS
        pushed = ~fixed & (least > guess)
        if pushed.any():  # a gap is narrow: of the eight nodes of a coarser one not all have bounds
            near |= _widened(_any_of_eight(pushed), PUSHED)
        unsure = ~fixed & _doubled(near) & (np.abs(found) < sure)
    found = np.ascontiguousarray(found, np.float32)
    nodes = np.flatnonzero(unsure).astype(np.int32)
    _relax(found.ravel(), nodes, found.shape[1:], least.ravel(), sweeps)
    return found


def _halved(values: Floats, fixed: Mask, least: Floats) -> tuple[Floats, Mask, Floats]:
    """One node for eight: the mean of the fixed ones, and of the bounds if all have one."""

    def total(part: Floats) -> Floats:
        # One axis at a time: numpy's reduction over three axes takes several times as long.
        part = part[::2] + part[1::2]
        part = part[:, ::2] + part[:, 1::2]
        return part[:, :, ::2] + part[:, :, 1::2]

    count = total(fixed.astype(np.float32))
    known = total(np.where(fixed, values, np.float32(0.0))) / np.maximum(count, np.float32(1.0))
    return np.asarray(known, np.float32), count > 0, total(0.125 * least)


def _any_of_eight(where: Mask) -> Mask:
    where = where[::2] | where[1::2]
    where = where[:, ::2] | where[:, 1::2]
    return where[:, :, ::2] | where[:, :, 1::2]


def _near_zero(values: Floats) -> Mask:
    """Nodes (a, b, c) within NEAR nodes of both signs."""
    negative = values < 0.0
    return _widened(negative, NEAR) & _widened(~negative, NEAR)


def _widened(where: Mask, nodes: int) -> Mask:
    """`where`, and the nodes at most so many away along each axis."""
    wide = where.copy()
    for axis in range(3):
        along = np.moveaxis(wide, axis, 0)  # a view: the next axis starts from this one's outcome
        for _ in range(nodes):
            was = along.copy()
            along[1:] |= was[:-1]
            along[:-1] |= was[1:]
    return wide


def _doubled(coarse: Values) -> Values:
    return coarse.repeat(2, axis=0).repeat(2, axis=1).repeat(2, axis=2)


@compiled
def _relax(
    values: Floats, some: NDArray[np.int32], shape: tuple[int, ...], least: Floats, sweeps: int
) -> None:
    """Gauss-Seidel sweeps over some nodes, in alternating order, with over-relaxation."""
    a, b = shape[0] * shape[1], shape[1]
    keep, share = np.float32(1.0 - OVERSHOOT), np.float32(OVERSHOOT / 6.0)
    for sweep in range(sweeps):
        way = 1 if sweep % 2 == 0 else -1
        for n in range(len(some)):
            at = some[n if way > 0 else len(some) - 1 - n]
            others = values[at - a] + values[at + a] + values[at - b] + values[at + b]
            new = keep * values[at] + share * (others + values[at + way])
            new += share * values[at - way]  # last: it was computed just now and is still in flight
            values[at] = max(new, least[at])
