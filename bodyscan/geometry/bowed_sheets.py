"""Sheets that vary smoothly with s and bow across their width.

In a frame roughly at the projector let y' = Y/Z across the stripes, x' = (X + x0)/Z along them and
w = D/Z - 1. The sheet at s is

    y' = p(s) + q(s) x' + r(s) w + b2(s) x'^2 + b3(s) x'^3 + ...

Without the b terms this can represent any plane; p, q, r, b are Chebyshev polynomials over [0, S].
The projector's centre is not assumed to be known: r(s) moves each sheet independently. Only the
bow, which is small, is extended radially from the frame's origin, shifted along the stripes by x0.

To measure, the coefficients, their derivatives by s and their covariance, which are smooth in s, are
tabulated: interpolated linearly between nodes an eighth of a stripe apart they are good to less than
a micrometre. Along a ray the equation times Z is linear but for the bow: Newton needs a step or two.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar, NamedTuple

import numpy as np
from numpy.polynomial import chebyshev

from bodyscan.arrays import Array
from bodyscan.compiled import compiled
from bodyscan.geometry.lens_sheets import CONVERGED, EXACT, LensSheets, variance_along
from bodyscan.geometry.light_planes import Offset, SmoothSheets

PLANE_DEGREE, BOW_DEGREE = 7, 3
FALL = 0.3
PLANE_SIGMAS = (1.0, 0.03, 0.03)
BOW_SIGMAS = (0.1, 0.03, 0.03)
"""Standard deviations, before any data, of p, q, r and of b2, b3, ...: coefficient m of a
polynomial is expected to be FALL times as large as coefficient m - 1."""


class SheetsAtStripe(NamedTuple):
    """Coefficients (..., K) at s, their derivatives by s, and Chebyshev polynomials (..., M)."""

    value: Array
    slope: Array
    basis: Array


@dataclass(frozen=True, eq=False)
class BowedSheets(SmoothSheets):
    """Smooth planes with a bow.

    parameters: coefficients of p, q, r (PLANE_DEGREE), then of b2, b3, ... (BOW_DEGREE), lowest
        degree first, and x0 (mm).
    """

    kind: ClassVar[str] = "bowed"

    @staticmethod
    def from_pinhole(pinhole: LensSheets, bow_terms: int) -> BowedSheets:
        """The planes of a projector without a lens, y' = (s - c) / f: the start of a fit."""
        size = 3 * (PLANE_DEGREE + 1) + bow_terms * (BOW_DEGREE + 1) + 1
        parameters, half = np.zeros(size), pinhole.stripes / 2.0
        focal, centre = pinhole.parameters[:2]
        parameters[:2] = (half - centre) / focal, half / focal
        frame, unknown = pinhole.projector_from_camera, np.full((size, size), np.nan)
        where = frame, pinhole.middle, pinhole.stripes, pinhole.direction
        return BowedSheets(*where, parameters, unknown)

    @property
    def bow_terms(self) -> int:
        """Number of terms b2, b3, ..."""
        return (len(self.parameters) - 3 * (PLANE_DEGREE + 1) - 1) // (BOW_DEGREE + 1)

    def linearize_prior(self) -> tuple[Array, Array]:
        fall = FALL ** np.arange(PLANE_DEGREE + 1)
        # A lens bows the sheets above and below its axis in opposite directions: b2 grows with s.
        late = FALL ** np.maximum(np.arange(BOW_DEGREE + 1) - 1, 0)
        sigmas = [size * fall for size in PLANE_SIGMAS]
        sigmas += [size * late for size in BOW_SIGMAS[: self.bow_terms]]
        # The boards' middle along the stripes is known to 30 % of its distance.
        size = np.append(np.concatenate(sigmas), 0.3 * self.distance_mm)
        deviation = self.parameters.copy()
        deviation[-1] += self.projector_from_camera.apply(self.middle)[0]
        return deviation / size, np.diag(1.0 / size)

    def retract(self, step: Array) -> BowedSheets:
        return replace(self, parameters=self.parameters + step)

    def evaluate(self, s: Array) -> SheetsAtStripe:
        u = 2.0 * np.asarray(s, float) / self.stripes - 1.0
        basis: Array = chebyshev.chebvander(u, PLANE_DEGREE).astype(np.float64)
        polynomials = self._polynomials()
        slopes = chebyshev.chebder(polynomials, axis=1) * (2.0 / self.stripes)
        return SheetsAtStripe(basis @ polynomials.T, basis[..., :-1] @ slopes.T, basis)

    def offset(self, points: Array, sheet: SheetsAtStripe, *, parameters: bool = False) -> Offset:
        in_projector = self.projector_from_camera.apply(points)
        reach = in_projector[..., 2]
        x, y = (in_projector[..., 0] + self.parameters[-1]) / reach, in_projector[..., 1] / reach
        w = self.distance_mm / reach
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
            reach,
            self._by_parameter(sheet.basis, terms, by_point) if parameters else None,
        )

    def _by_parameter(self, basis: Array, terms: Array, by_point: Array) -> Array:
        """Derivatives (..., P) of the offset by the parameters: coefficients in order, then x0."""
        sizes = self._sizes[:-1]
        columns = [-terms[..., k, None] * basis[..., :size] for k, size in enumerate(sizes)]
        return np.concatenate([*columns, by_point[..., :1]], axis=-1)

    @property
    def _sizes(self) -> list[int]:
        """Number of parameters of p, q, r, b2, ..., and of x0."""
        return [PLANE_DEGREE + 1] * 3 + [BOW_DEGREE + 1] * self.bow_terms + [1]

    def _polynomials(self) -> Array:
        """Coefficients (3 + bow_terms, PLANE_DEGREE + 1), one row per polynomial."""
        rows = np.zeros((3 + self.bow_terms, PLANE_DEGREE + 1))
        parts = np.split(self.parameters, np.cumsum(self._sizes))[:-2]
        for row, part in zip(rows, parts, strict=True):
            row[: len(part)] = part
        return rows

    @cached_property
    def _table(self) -> Array:
        """Rows (K, 2 T + U) at s = 0, 1/8, 2/8, ...: the T coefficients p, q, r, b2, ..., their
        derivatives by s, and row by row the upper triangle of the covariance of them and x0."""
        at = self.evaluate(np.arange(NODES_PER_STRIPE * self.stripes + 1.0) / NODES_PER_STRIPE)
        sizes = self._sizes
        parts = [slice(end - size, end) for size, end in zip(sizes, np.cumsum(sizes), strict=True)]
        # Chebyshev polynomials begin with 1, which is also what x0 is multiplied by.
        covariances = [
            np.sum(
                (at.basis[:, : sizes[k]] @ self.covariance[parts[k], parts[m]])
                * at.basis[:, : sizes[m]],
                axis=1,
            )
            for k, m in zip(*np.triu_indices(len(sizes)), strict=True)
        ]
        return np.column_stack([at.value, at.slope, *covariances])

    def _intersect(self, rays: Array, s: Array, found: Array) -> None:
        frame = self.projector_from_camera.matrix[:3].ravel()
        frame = np.append(frame, [self.parameters[-1], self.distance_mm])
        _intersect(frame, self._table, 3 + self.bow_terms, rays, s, found)


NODES_PER_STRIPE = 8


@compiled
def _intersect(frame: Array, rows: Array, terms: int, rays: Array, s: Array, found: Array) -> None:
    """Fill `found` (3, N) with depth, dz/ds and variance of rays (N, 3) at s (N,).

    frame: (14,) the three rows of projector_from_camera, then x0 and D. rows: see `BowedSheets._table`.
    terms: T.
    """
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
        found[2, n] = variance_along(row[2 * terms :], by) * scale * scale


@compiled
def _depth(frame: Array, row: Array, terms: int, x: float, y: float) -> tuple[float, float]:
    """z where the ray (x, y, 1) meets the sheet whose coefficients begin the row, and dG/dz there;
    NaN where Newton's method does not settle."""
    along, across = _rotate_direction(frame, 0, x, y), _rotate_direction(frame, 1, x, y)
    forward = _rotate_direction(frame, 2, x, y)
    aside, behind = frame[3] + frame[12], frame[11]
    rise = (row[0] - row[2]) * forward + row[1] * along - across
    start = (row[0] - row[2]) * behind + row[1] * aside - frame[7] + row[2] * frame[13]
    depth = -start / rise
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
