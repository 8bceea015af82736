"""Bowed sheets and smooth planes, tabulated over s to triangulate millions of pixels at once.

With X = X_p + x0, Y, Z of a point in the sheets' frame, x = X/Z and w = D/Z, the sheet at s is

    G = (p(s) + q(s) x + r(s) (w - 1) + b2(s) x^2 + ...) Z - Y = 0.

s enters only through the coefficients, their derivatives and their covariance, which are smooth in
s: interpolated linearly between nodes an eighth of a stripe apart they are good to less than a
micrometre. Along a ray G is linear but for the small bow, so Newton's method needs a step or two.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from bodyscan.arrays import Array
from bodyscan.compiled import compiled
from bodyscan.geometry.bowed_sheets import BOW_DEGREE, PLANE_DEGREE, BowedSheets, SheetsAtStripe

NODES_PER_STRIPE = 8
NEWTON_STEPS = 5
EXACT, CONVERGED = 1e-7, 1e-6  # relative: the next step would be about the square of the last


@dataclass(frozen=True, eq=False)
class SheetTable:
    """The tabulated sheets.

    rows: (K, 2 T + U) at s = 0, 1/8, 2/8, ...: the T coefficients p, q, r, b2, ..., their
        derivatives by s, and row by row the upper triangle of the covariance of the coefficients
        and, with a bow, x0.
    terms: T.
    frame: (14,) the three rows of projector_from_camera, then x0 and D.
    """

    rows: Array
    terms: int
    frame: Array

    @staticmethod
    @lru_cache(maxsize=64)
    def from_sheets(sheets: BowedSheets) -> SheetTable:
        at = sheets.at(np.arange(NODES_PER_STRIPE * sheets.stripes + 1.0) / NODES_PER_STRIPE)
        terms, aside = 3 + sheets.bow_terms, sheets.bow_terms > 0
        by_parameter = _by_parameter(at, terms, len(sheets.parameters))
        # A small matrix per node: two large products do all nodes.
        spread = (by_parameter.reshape(-1, len(sheets.covariance)) @ sheets.covariance).reshape(
            by_parameter.shape
        ) @ by_parameter.transpose(0, 2, 1)
        above = np.triu_indices(terms + aside)
        rows = np.concatenate([at.value, at.slope, spread[:, above[0], above[1]]], axis=1)
        shift = float(sheets.parameters[-1]) if aside else 0.0
        frame = sheets.projector_from_camera.matrix[:3].ravel()
        return SheetTable(rows, terms, np.append(frame, [shift, sheets.distance_mm]))

    def measure(self, rays: Array, s: Array) -> tuple[Array, Array, Array]:
        """Depth z (N,) mm, dz/ds and the variance of z, for rays (N, 3) at s (N,); NaN where
        none."""
        found = np.empty((3, len(s)))
        _measure(self.frame, self.rows, self.terms, np.ascontiguousarray(rays), s, found)
        return found[0], found[1], found[2]


def _by_parameter(at: SheetsAtStripe, terms: int, parameters: int) -> Array:
    """Derivatives (K, T, P) of the coefficients by the parameters at the nodes; with a bow, x0 is
    one more coefficient."""
    aside = terms > 3
    found = np.zeros((len(at.basis), terms + aside, parameters))
    first = 0
    for k in range(terms):
        size = (PLANE_DEGREE if k < 3 else BOW_DEGREE) + 1
        found[:, k, first : first + size] = at.basis[:, :size]
        first += size
    if aside:
        found[:, -1, -1] = 1.0
    return found


@compiled
def _measure(frame: Array, rows: Array, terms: int, rays: Array, s: Array, found: Array) -> None:
    """Fill `found` (3, N) with depth, dz/ds and variance of rays (N, 3) at s (N,)."""
    last, row, by = len(rows) - 1, np.empty(rows.shape[1]), np.empty(terms + 1)
    for n in range(len(s)):
        found[0, n] = found[1, n] = found[2, n] = np.nan
        place = s[n] * NODES_PER_STRIPE
        if not (place >= 0.0 and place <= last):
            continue
        node = min(int(place), last - 1)
        share = place - node
        for k in range(len(row)):
            row[k] = rows[node, k] + share * (rows[node + 1, k] - rows[node, k])
        depth, rise = _depth(frame, row, terms, rays[n, 0], rays[n, 1])
        reach = _at(frame, 2, rays[n, 0], rays[n, 1], depth)
        if not (depth > 0.0 and reach > 0.0):
            continue
        x = (_at(frame, 0, rays[n, 0], rays[n, 1], depth) + frame[12]) / reach
        by[0], by[1], by[2], power = 1.0, x, frame[13] / reach - 1.0, x
        sideways, fall = row[1], row[terms] + row[terms + 1] * x + row[terms + 2] * by[2]
        for k in range(3, terms):
            sideways += (k - 1) * row[k] * power
            power *= x
            by[k] = power
            fall += row[terms + k] * power
        by[terms] = sideways / reach
        scale = reach / rise
        found[0, n], found[1, n] = depth, -fall * scale
        found[2, n] = _variance(row[2 * terms :], by) * scale * scale


@compiled
def _depth(frame: Array, row: Array, terms: int, x: float, y: float) -> tuple[float, float]:
    """z where the ray (x, y, 1) meets the sheet whose coefficients begin the row, and dG/dz there;
    NaN where Newton's method does not settle."""
    along, across, forward = (
        _turned(frame, 0, x, y),
        _turned(frame, 1, x, y),
        _turned(frame, 2, x, y),
    )
    aside, behind = frame[3] + frame[12], frame[11]
    rise = (row[0] - row[2]) * forward + row[1] * along - across
    start = (row[0] - row[2]) * behind + row[1] * aside - frame[7] + row[2] * frame[13]
    depth = -start / rise
    if terms == 3:
        return depth, rise
    step = slope = np.nan
    for _ in range(NEWTON_STEPS):
        shift = depth * along + aside
        ratio = shift / (depth * forward + behind)
        value, slope, power = depth * rise + start, rise, ratio
        for k in range(3, terms):
            value += row[k] * shift * power
            slope += row[k] * power * ((k - 1) * along - (k - 2) * ratio * forward)
            power *= ratio
        step = value / slope
        depth -= step
        if not abs(step) > EXACT * abs(depth):
            break
    return (depth if abs(step) < CONVERGED * depth else np.nan), slope


@compiled
def _turned(frame: Array, axis: int, x: float, y: float) -> float:
    """One coordinate, in the sheets' frame, of the direction (x, y, 1)."""
    return frame[4 * axis] * x + frame[4 * axis + 1] * y + frame[4 * axis + 2]


@compiled
def _at(frame: Array, axis: int, x: float, y: float, depth: float) -> float:
    """One coordinate, in the sheets' frame, of the ray's point at the depth."""
    return depth * _turned(frame, axis, x, y) + frame[4 * axis + 3]


@compiled
def _variance(upper: Array, by: Array) -> float:
    """by^T C by, given the upper triangle of C row by row, as far as `by` reaches."""
    total, first, size = 0.0, 0, len(by)
    if len(upper) < size * (size + 1) // 2:
        size -= 1
    for i in range(size):
        row = 0.5 * upper[first] * by[i]
        for j in range(i + 1, size):
            row += upper[first + j - i] * by[j]
        total += 2.0 * row * by[i]
        first += size - i
    return total
