"""How long a slice's outline may be: what was not measured, and what noise leaves open."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from bodyscan.arrays import Array, Floats, Indices, Mask
from bodyscan.mesh.slices import Loop, compute_hull_perimeter, keep_segments, split_runs

CREASE_MM = 15.0
"""Deep in a crease between two parts no camera sees the skin, and the surface bridges it."""
Range = tuple[float, float]


def bound_girths(loop: Loop) -> tuple[tuple[float, float], tuple[float, float]]:
    """Least, and most, that a loop's girth and its tape girth may be, mm.

    A body is convex where nothing was seen of it: at least straight from rim to rim, and at most
    along the tangents of both rims to where they meet.
    """
    measured, runs = split_runs(replace(loop, measured=loop.measured & ~_mark_near_creases(loop)))
    if measured.all():
        values = loop.girth_mm, loop.tape_mm
        return values, values
    if not measured.any():
        return (0.0, 0.0), (2.0 * loop.girth_mm, 2.0 * loop.girth_mm)
    kept = np.zeros(len(loop.segments), bool)
    kept[np.concatenate([run for run, known in zip(runs, measured, strict=True) if known])] = True
    closed = keep_segments(loop, kept)
    bulges = [
        _bulge(loop, runs[k - 1], runs[k], runs[(k + 1) % len(runs)])
        for k in np.flatnonzero(~measured)
    ]
    points = np.concatenate([closed.segments[:, 0], *bulges])
    longer = 0.0
    for bulge in bulges:
        length = float(np.linalg.norm(np.diff(bulge, axis=0), axis=1).sum())
        longer += length - float(np.linalg.norm(bulge[-1] - bulge[0]))
    lows = closed.girth_mm, closed.tape_mm
    return lows, (closed.girth_mm + longer, compute_hull_perimeter(points))


def _mark_near_creases(loop: Loop) -> Mask:
    """Segments (N,) within CREASE_MM of where a loop was cut from another part."""
    along = np.cumsum(loop.lengths) - 0.5 * loop.lengths
    away = np.abs(along[:, None] - along[loop.faces < 0])
    away = np.minimum(away, loop.girth_mm - away) - 0.5 * loop.lengths[loop.faces < 0]
    return np.asarray((away < CREASE_MM).any(axis=1))


def _bulge(loop: Loop, before: Indices, gap: Indices, after: Indices) -> Array:
    """The most convex curve (K, 2) across a gap between two measured runs."""
    first, last = loop.segments[gap[0], 0], loop.segments[gap[-1], 1]
    chord = last - first
    length = float(np.linalg.norm(chord))
    if length < 1e-6:
        return np.stack([first, last])
    along = chord / length
    outward = np.array([along[1], -along[0]])  # the body is on the left
    rims = (
        loop.segments[_cut_rim(loop, before[::-1])[-1], 0],
        loop.segments[_cut_rim(loop, after)[-1], 1],
    )
    leaving, arriving = first - rims[0], rims[1] - last
    rise = np.arctan2(leaving @ outward, leaving @ along)
    fall = np.arctan2(-(arriving @ outward), arriving @ along)
    angle = np.linspace(0.0, np.pi, 19)
    # A bulge of 0.75 of the gap's width: half a circle has 0.5, and the end of a flat trunk more.
    x, y = 0.5 * length * (1.0 - np.cos(angle)), 0.75 * length * np.sin(angle)
    if rise <= 0.0 and fall <= 0.0:
        y = np.zeros_like(y)
    for slope, away in ((rise, x), (fall, length - x)):
        if 0.0 < slope < 0.5 * np.pi:
            y = np.minimum(y, away * np.tan(slope))
    return first + x[:, None] * along + y[:, None] * outward


def _cut_rim(loop: Loop, run: Indices) -> Indices:
    """The first 20 mm of a run: a rim's direction is known to some degrees from that."""
    return run[: max(1, int(np.searchsorted(np.cumsum(loop.lengths[run]), 20.0)))]


def compute_girth_sigma(loop: Loop, sigma_mm: Array | Floats, *, sectors: int) -> float:
    """Standard deviation, mm, of a loop's tape girth due to its points' sigma_mm (N,) outwards.

    A tape that turns by an angle at a point grows by that angle times the point's displacement.
    Within each of so many equal sectors, displacements are common to all points: a pair sees about a
    quarter of the way round. NaN counts as the median of the others.
    """
    points = loop.segments[:, 0]
    try:
        corners = ConvexHull(points).vertices
    except QhullError:  # a speck
        return 0.0
    known = np.isfinite(sigma_mm)
    median = float(np.median(sigma_mm[known])) if known.any() else 0.0
    sigma = np.where(known, sigma_mm, median)[corners]
    edge = np.roll(points[corners], -1, axis=0) - points[corners]
    heading = np.arctan2(edge[:, 1], edge[:, 0])
    turn = np.mod(heading - np.roll(heading, 1), 2.0 * np.pi)
    sector = np.mod(heading, 2.0 * np.pi) * sectors / (2.0 * np.pi)
    sums = np.bincount(np.minimum(sector.astype(np.int64), sectors - 1), turn * sigma, sectors)
    return float(np.linalg.norm(sums))
