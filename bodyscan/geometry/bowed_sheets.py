"""Sheets that vary smoothly with s and may bow across their width; without bow, smooth planes.

In a frame roughly at the projector let y' = Y/Z across the stripes, x' = (X + x0)/Z along them and
w = D/Z - 1. The sheet at s is

    y' = p(s) + q(s) x' + r(s) w + b2(s) x'^2 + b3(s) x'^3 + ...

Without the b terms this can represent any plane; p, q, r, b are Chebyshev polynomials over [0, S].
The projector's centre is not assumed to be known: r(s) moves each sheet independently. Only the
bow, which is small, is extended radially from the frame's origin, shifted along the stripes by x0.

`SheetTable` tabulates the coefficients, their derivatives by s and their covariance, which are
smooth in s: interpolated linearly between nodes an eighth of a stripe apart they are good to less
than a micrometre. Along a ray the equation times Z is linear but for the bow, so Newton's method
needs a step or two.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.polynomial import chebyshev

from bodyscan.arrays import Array
from bodyscan.compiled import compiled
from bodyscan.geometry.lens_sheets import LensSheets
from bodyscan.geometry.smooth_sheets import Offset, SmoothSheets

PLANE_DEGREE, BOW_DEGREE = 7, 3
FALL = 0.3
PLANE_SIGMAS = (1.0, 0.03, 0.03)
BOW_SIGMAS = (0.1, 0.03, 0.03)
"""Standard deviations, before any data, of p, q, r and of b2, b3, ...: coefficient m of a
polynomial is expected to be FALL times as large as coefficient m - 1."""


@dataclass(frozen=True, eq=False)
class SheetsAtStripe:
    """Coefficients (..., K) at s, their derivatives by s, and the Chebyshev polynomials (...,
    M)."""

    value: Array
    slope: Array
    basis: Array


@dataclass(frozen=True, eq=False)
class BowedSheets(SmoothSheets):
    """Smooth planes, or sheets with a bow of `bow_terms` terms.

    parameters: coefficients of p, q, r (PLANE_DEGREE), then of b2, b3, ... (BOW_DEGREE), lowest
        degree first; with a bow, x0 (mm) is the last.
    bow_terms: number of terms b2, b3, ...; 0 for planes.
    """

    bow_terms: int

    @staticmethod
    def from_pinhole(pinhole: LensSheets, bow_terms: int) -> BowedSheets:
        """The planes of a projector without a lens, y' = (s - c) / f: the start of a fit."""
        size = 3 * (PLANE_DEGREE + 1) + bow_terms * (BOW_DEGREE + 1) + (bow_terms > 0)
        parameters, half = np.zeros(size), pinhole.stripes / 2.0
        focal, centre = pinhole.parameters[:2]
        parameters[:2] = (half - centre) / focal, half / focal
        return BowedSheets(
            pinhole.projector_from_camera,
            pinhole.middle,
            pinhole.stripes,
            pinhole.direction,
            parameters,
            np.full((size, size), np.nan),
            bow_terms,
        )

    @property
    def kind(self) -> str:
        return "bowed" if self.bow_terms else "smooth-planes"

    def prior(self) -> tuple[Array, Array]:
        fall = FALL ** np.arange(PLANE_DEGREE + 1)
        # A lens bows the sheets above and below its axis in opposite directions: b2 grows with s.
        late = FALL ** np.maximum(np.arange(BOW_DEGREE + 1) - 1, 0)
        sigmas = [size * fall for size in PLANE_SIGMAS]
        sigmas += [size * late for size in BOW_SIGMAS[: self.bow_terms]]
        deviation = self.parameters
        if self.bow_terms:
            # The boards' middle along the stripes is known to 30 % of its distance.
            sigmas.append(np.array([0.3 * self.distance_mm]))
            middle = self.projector_from_camera.apply(self.middle)[0]
            deviation = np.append(deviation[:-1], middle + deviation[-1])
        size = np.concatenate(sigmas)
        return deviation / size, np.diag(1.0 / size)

    def retract(self, step: Array) -> BowedSheets:
        return replace(self, parameters=self.parameters + step)

    def at(self, s: Array) -> SheetsAtStripe:
        u = 2.0 * np.asarray(s, float) / self.stripes - 1.0
        basis: Array = chebyshev.chebvander(u, PLANE_DEGREE).astype(np.float64)
        polynomials = self._polynomials()
        slopes = chebyshev.chebder(polynomials, axis=1) * (2.0 / self.stripes)
        return SheetsAtStripe(basis @ polynomials.T, basis[..., :-1] @ slopes.T, basis)

    def offset(self, points: Array, sheet: SheetsAtStripe, *, parameters: bool = False) -> Offset:
        in_projector = self.projector_from_camera.apply(points)
        reach = in_projector[..., 2]
        shift = self.parameters[-1] if self.bow_terms else 0.0
        x, y, w = (
            (in_projector[..., 0] + shift) / reach,
            in_projector[..., 1] / reach,
            self.distance_mm / reach,
        )
        powers = [np.ones_like(x), x]
        for _ in range(self.bow_terms):
            powers.append(powers[-1] * x)
        terms = np.stack([powers[0], x, w - 1.0, *powers[2:]], axis=-1)
        by_x = -sheet.value[..., 1]
        for n in range(2, 2 + self.bow_terms):
            by_x = by_x - n * sheet.value[..., 1 + n] * powers[n - 1]
        by_z = -by_x * x - y + sheet.value[..., 2] * w
        by_point = np.stack([by_x, np.ones_like(x), by_z], axis=-1) / reach[..., None]
        return Offset(
            y - np.sum(sheet.value * terms, axis=-1),
            by_point @ self.projector_from_camera.rotation,
            -np.sum(sheet.slope * terms, axis=-1),
            reach,
            self._by_parameter(sheet.basis, terms, by_point) if parameters else None,
        )

    def _by_parameter(self, basis: Array, terms: Array, by_point: Array) -> Array:
        columns = [-terms[..., k, None] * basis for k in range(3)]
        low = basis[..., : BOW_DEGREE + 1]
        columns += [-terms[..., 3 + k, None] * low for k in range(self.bow_terms)]
        columns += [by_point[..., :1]] if self.bow_terms else []
        return np.concatenate(columns, axis=-1)

    def _polynomials(self) -> Array:
        """Coefficients (3 + bow_terms, PLANE_DEGREE + 1), one row per polynomial."""
        planes = 3 * (PLANE_DEGREE + 1)
        rows = np.zeros((3 + self.bow_terms, PLANE_DEGREE + 1))
        rows[:3] = self.parameters[:planes].reshape(3, -1)
        if self.bow_terms:
            rows[3:, : BOW_DEGREE + 1] = self.parameters[planes:-1].reshape(self.bow_terms, -1)
        return rows


NODES_PER_STRIPE = 8
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
        variances = (by_parameter.reshape(-1, len(sheets.covariance)) @ sheets.covariance).reshape(
            by_parameter.shape
        ) @ by_parameter.transpose(0, 2, 1)
        above = np.triu_indices(terms + aside)
        rows = np.concatenate([at.value, at.slope, variances[:, above[0], above[1]]], axis=1)
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
        position = s[n] * NODES_PER_STRIPE
        if not (position >= 0.0 and position <= last):
            continue
        node = min(int(position), last - 1)
        share = position - node
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
        _rotate_direction(frame, 0, x, y),
        _rotate_direction(frame, 1, x, y),
        _rotate_direction(frame, 2, x, y),
    )
    aside, behind = frame[3] + frame[12], frame[11]
    rise = (row[0] - row[2]) * forward + row[1] * along - across
    start = (row[0] - row[2]) * behind + row[1] * aside - frame[7] + row[2] * frame[13]
    depth = -start / rise
    if terms == 3:
        return depth, rise
    step = slope = np.nan
    for _ in range(5):
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
def _rotate_direction(frame: Array, axis: int, x: float, y: float) -> float:
    """One coordinate, in the sheets' frame, of the direction (x, y, 1)."""
    return frame[4 * axis] * x + frame[4 * axis + 1] * y + frame[4 * axis + 2]


@compiled
def _at(frame: Array, axis: int, x: float, y: float, depth: float) -> float:
    """One coordinate, in the sheets' frame, of the ray's point at the depth."""
    return depth * _rotate_direction(frame, axis, x, y) + frame[4 * axis + 3]


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
