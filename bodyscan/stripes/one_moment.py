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

SEEN_MM = 0.25  # of motion while the patterns were taken: with less none can have leapt
LEAPT = 0.25
"""Of the least leap that is named, on the average of windows: with less it is not looked for. A part of
the body that leapt alone leaves as much."""
TORN = 4.0
"""Times what steady motion explains: motion back and forth is not steady either, and shorter."""
SUDDEN, LEAP_MM = 30.0, 2.0
"""A leap that explains so many times as much, 12 at most where people moved, is none of a body, however
fast those are; from 2 mm on fine stripes are taken for their neighbours, and less is not named."""


@dataclass(frozen=True, eq=False)
class StripeMotion:
    """How fast s changes at pixels that stay where they are, and the body's motion behind that.

    speed, doubt: (rows, columns) at the middles of cells of `cell_px` x `cell_px` camera pixels, linear
    between: stripes per unit of time, and the standard deviation of what is not known of it.
    velocity: of the body, per the same unit of time.  speed_mm: how fast it moved in depth, RMS.
    mm_per_stripe: of depth, at a pixel that stays where it is, in the median.
    doubt_mm: of that, what neither a rigid motion nor the field explains, RMS over the cells.
    explained: by how much the rigid motion lowers chi-square.
    is_significant: whether noise does not explain it.
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
    """When the images of a sequence were taken, the moment at which the body is wanted, and who tells
    its motion from the comb.

    times: of each image (n,) by the name of its kind, any unit.  told: None where the comb tells
    nothing.  instead: another order in which they may have come, where nobody says.  most_mm: no
    subject moves farther in depth meanwhile; infinite where nobody says how long it took.
    """

    times: Mapping[str, Array]
    moment: float
    told: Callable[[Comb], StripeMotion | None]
    instead: Moments | None = None
    most_mm: float = np.inf

    @property
    def of_bits(self) -> Array:
        """(bits,) when the boundaries of each bit's pattern are seen.

        Where pattern and inverse are equally bright s has passed as far before the boundary in one as
        behind it in the other: that is the middle of both moments, however far apart they are.
        """
        patterns = self.times["pattern"]
        return np.asarray((patterns + self.times.get("inverse", patterns)) / 2.0, np.float64)


def carry_to_moment(
    boundaries: Boundaries, bit: Indices, moments: Moments, *, turned: bool
) -> tuple[Boundaries, StripeMotion | None, float]:
    """The boundaries as they would have been seen at the moment, what moved them, and the farthest
    that s had to be carried, stripes.  bit: (N,) in whose images each boundary was seen.

    What noise explains leaves them untouched. Of two orders the one that explains more is believed: in
    the wrong one teeth may look like stripes that stray.
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
    """Raises DecodingFailed where one leap explains the teeth far better than the steady motion that
    was told."""
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
    """(2, N): a grid (2, rows, columns) at places (N,), px; beyond its outermost middles as there."""
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
    """(N,) px a stripe along the scan line, below 0 where s falls; from the neighbours that are
    joined, 0 where none is."""
    widths = np.zeros(position.size)
    for k in range(position.size):
        first = k - 1 if k > 0 and joined[k - 1] else k
        last = k + 1 if k < joined.size and joined[k] else k
        if index[last] != index[first]:
            widths[k] = (position[last] - position[first]) / (index[last] - index[first])
    return widths
