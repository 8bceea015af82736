"""Stripe boundaries that were seen at different moments, carried to one."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from bodyscan.arrays import Array, Indices, Mask
from bodyscan.compiled import compiled
from bodyscan.errors import DecodingFailed
from bodyscan.geometry.velocity import Velocity
from bodyscan.stripes.boundaries import Boundaries
from bodyscan.stripes.comb import Comb, find_comb

SEEN_MM = 0.25  # of motion while the patterns were taken; with less none can have jumped
LEAPT = 0.25
"""Share, on the average of windows, of the least jump that is reported; below it none is looked
for. A part of the body that jumped alone leaves as much."""
TORN = 4.0
"""Ratio to what steady motion explains: motion back and
forth is not steady either, but gives less."""
SUDDEN, LEAP_MM = 30.0, 2.0
"""A jump that explains this many times as much (at most 12 where people moved) is not a body's,
however fast it moves; from 2 mm on, fine stripes are mistaken for their neighbours; less is not
reported."""


@dataclass(frozen=True, eq=False)
class StripeMotion:
    """How fast s changes at fixed pixels, and the body's motion behind that.

    speed, doubt: (rows, columns) at the middles of cells of `cell_px` x `cell_px` camera pixels,
        linear between: stripes per unit of time, and the standard deviation of what is unknown of
        it.
    velocity: of the body, per the same unit of time.
    speed_mm: how fast it moved in depth, RMS.
    mm_per_stripe: of depth at a fixed pixel, median.
    doubt_mm: the part of that which neither a rigid motion nor the field explains, RMS over the
        cells.
    explained: by how much the rigid motion lowers chi-square.
    is_significant: whether it is more than noise.
    """

    speed: Array
    doubt: Array
    cell_px: int
    velocity: Velocity
    speed_mm: float
    mm_per_stripe: float
    doubt_mm: float
    explained: float
    is_significant: bool


@dataclass(frozen=True, eq=False)
class Moments:
    """When the images of a sequence were taken, and the moment to which boundaries are carried.

    times: of each image (n,) by the name of its kind, in any unit.
    told: finds the body's motion from the comb; returns None where the comb says nothing.
    instead: another order in which images may have been taken, if that is unknown.
    most_mm: no subject moves farther in depth meanwhile; infinite if the duration is unknown.
    """

    times: Mapping[str, Array]
    moment: float
    told: Callable[[Comb], StripeMotion | None]
    instead: Moments | None = None
    most_mm: float = np.inf

    @property
    def of_bits(self) -> Array:
        """When the boundaries of each bit's pattern are seen, (bits,).

        Where pattern and inverse are equally bright, s is as far before the boundary in one as it
        is behind it in the other: that is midway between both moments, however far apart they are.
        """
        patterns = self.times["pattern"]
        return np.asarray((patterns + self.times.get("inverse", patterns)) / 2.0, np.float64)


def carry_to_moment(
    boundaries: Boundaries, bit: Indices, moments: Moments, *, turned: bool
) -> tuple[Boundaries, StripeMotion | None, float]:
    """The boundaries as they would have been seen at the moment, the motion, and the greatest
    shift.

    bit: (N,) in whose images each boundary was seen.

    The shift is in stripes of s. Motion that noise explains leaves boundaries unchanged. Of two
    orders the one that explains more is chosen: in the wrong one teeth may look like stray stripes.
    Raises DecodingFailed for a sequence whose images show the body in two places.
    """

    def told(seen: Moments) -> StripeMotion | None:
        return seen.told(find_comb(boundaries, seen.of_bits[bit], turned=turned))

    motion = told(moments)
    if motion is not None and moments.instead is not None:
        other = told(moments.instead)
        if other is not None and other.explained > motion.explained:
            moments, motion = moments.instead, other
    if motion is None or not motion.is_significant:
        return boundaries, motion, 0.0
    _check_whole(boundaries, bit, (moments, motion), turned=turned)
    late = moments.of_bits[bit] - moments.moment
    place = [boundaries.line_position, boundaries.position]
    column, row = place if turned else place[::-1]
    grid = np.stack([motion.speed, motion.doubt])
    speed, doubt = _at_places(grid, motion.cell_px, column, row)
    widths = _stripe_widths(boundaries.position, boundaries.index, boundaries.joined)
    position = boundaries.position + speed * late * widths
    doubt_px = doubt * late * widths
    pixels = int(np.max(boundaries.before, initial=0)) + 2
    before = np.clip(np.floor(position).astype(np.int64), 0, pixels - 2)
    before = np.maximum.accumulate(boundaries.line * pixels + before) - boundaries.line * pixels
    carried = replace(
        boundaries,
        position=position,
        before=before,
        sigma_px=np.hypot(boundaries.sigma_px, doubt_px),
    )
    return carried, motion, float(np.abs(speed * late).max(initial=0.0))


def _check_whole(
    boundaries: Boundaries, bit: Indices, moved: tuple[Moments, StripeMotion], *, turned: bool
) -> None:
    """Raises DecodingFailed if one jump explains the teeth far better than the steady motion that
    was found."""
    moments, motion = moved
    times = moments.of_bits
    lasted, order = float(np.ptp(times)), np.argsort(times, kind="stable")
    moved_mm = np.hypot(motion.speed_mm, motion.doubt_mm) * lasted
    if not np.isfinite(moments.most_mm) or moved_mm < SEEN_MM:
        return
    leaps: list[tuple[float, float, int]] = []
    for first in range(1, len(order)):
        after = np.zeros(len(times))
        after[order[first:]] = lasted
        comb = find_comb(boundaries, after[bit], turned=turned)
        usual_mm = _mean_size(comb.speed) * lasted * motion.mm_per_stripe
        leap = moments.told(comb) if usual_mm > LEAPT * moments.most_mm else None
        if leap is not None:
            leaps.append((leap.explained, leap.speed_mm * lasted, first))
    explained, apart_mm, first = max(leaps, default=(0.0, 0.0, 0))
    most_mm = moments.most_mm if explained < SUDDEN * motion.explained else LEAP_MM
    if explained > TORN * motion.explained and apart_mm > most_mm:
        raise DecodingFailed(
            f"from about bit {order[first]} on, patterns show the subject some {apart_mm:.1f} mm"
            " in depth from where those before show it",
            remedy="see whether images of another moment or subject stand among them; scan again",
        )


def _mean_size(values: Array) -> float:
    return float(np.mean(np.abs(values))) if len(values) else 0.0


@compiled
def _at_places(grid: Array, cell_px: int, column: Array, row: Array) -> Array:
    """A grid (2, rows, columns) at places (N,), px, as (2, N); constant beyond the outermost
    middles."""
    found = np.empty((2, column.size))
    rows, columns = grid.shape[1:]
    for n in range(column.size):
        x = min(max((column[n] + 0.5) / cell_px - 0.5, 0.0), columns - 1.0)
        y = min(max((row[n] + 0.5) / cell_px - 0.5, 0.0), rows - 1.0)
        left, top = min(int(x), max(columns - 2, 0)), min(int(y), max(rows - 2, 0))
        right, below = min(left + 1, columns - 1), min(top + 1, rows - 1)
        x, y = x - left, y - top
        for k in range(2):
            upper = grid[k, top, left] + x * (grid[k, top, right] - grid[k, top, left])
            lower = grid[k, below, left] + x * (grid[k, below, right] - grid[k, below, left])
            found[k, n] = upper + y * (lower - upper)
    return found


@compiled
def _stripe_widths(position: Array, index: Indices, joined: Mask) -> Array:
    """Width of a stripe (N,) px along the scan line, negative where s falls, from the neighbours
    that are joined; 0 if none is."""
    widths = np.zeros(position.size)
    for k in range(position.size):
        first = k - 1 if k > 0 and joined[k - 1] else k
        last = k + 1 if k < joined.size and joined[k] else k
        if index[last] != index[first]:
            widths[k] = (position[last] - position[first]) / (index[last] - index[first])
    return widths
