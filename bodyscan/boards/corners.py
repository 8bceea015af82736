"""Board corners to a small fraction of a pixel: a model of the image is fitted around each.

Four squares meet in a corner; blurred, that is an offset plus the product of two edges, under light
that may fall off to one side:

    I(p) = (a + b E(n1 . (p - c)) E(n2 . (p - c))) (1 + g . (p - c) / a),
    E(d) = erf(d / (sqrt(2) sigma)),

with c the corner, n1 and n2 the normals of the two edge lines. Light multiplies: a slope added to
the squares instead shifts all corners of a tilted board alike, by 0.01 px at 70 degrees.

A marker in a white square turns it dark from a gap g_i beyond both edges on: the product of the
edges is reversed there, by the factor 1 - 2 F1 F2 with F_i = (1 + E(|n_i . (p - c)| - g_i)) / 2.
Left out, its blurred rim pulls corners of small boards at 60 degrees away from the camera, by 0.02
px all alike. All corners of a board are fitted at once.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from bodyscan.arrays import Array, Bytes, Indices, Mask
from bodyscan.boards.appearance import AS_PRINTED, Appearance
from bodyscan.compiled import compiled
from bodyscan.geometry.least_squares import StackedEquations, minimize_each
from bodyscan.geometry.robust import SIGMAS_PER_MEDIAN
from bodyscan.geometry.scaled_systems import solve_scaled

MAX_MOVE_PX = 1.5
RADIUS_PX = 9.0
NOISY_PX, NOISY_RADIUS_PX = 0.04, 16.0
"""If corners of an image are less accurate than this, wider windows are worth their time."""
WINDOW_SQUARES = 0.42
BLUR_PX = 0.9
CLEAR_OF_MARKER_PX = 1.4
MIN_BORDER_PX = 5.0
MIN_ARM_PX = 1.5
BLUR_RANGE_PX = (0.3, 3.0)
MIN_PIXELS = 16
MIN_CONTRAST = 4.0
USUAL_RESIDUAL, MAX_RESIDUAL = 0.25, 0.7
USUAL_SIGMA_PX, MAX_SIGMA_PX = 0.06, 0.35
TIMES_MEDIAN = 2.0
"""Residuals (shares of the contrast) and sigmas of good corners in a clear image, and in any. If
all are worse, in noise or blur, a corner may be twice as bad as the median of its board."""
LEAST_OF_SEEN = 0.02
"""Share of the seen variance of light between corners that is real, at least."""
NO_RIM = 4.0
"""Blurs before a marker's rim at which it takes less than 1e-4 of the contrast."""
STEPS = 12
UNSEEN = 1e-9  # share of a diagonal: what a window without pixels leaves open stays as it is
SETTLED = 1e-2  # a tenth of a corner's own sigma; one more step then makes it far less


@dataclass(frozen=True, eq=False)
class SightedCorners:
    """Corners of one board face found in an image.

    ids: (N,) int64.
    pixels: (N, 2) px.
    printed_count: how many corners the face has.
    """

    ids: Indices
    pixels: Array
    printed_count: int
    appearance: Appearance = AS_PRINTED


@dataclass(frozen=True, eq=False)
class _Patches:
    """P pixels around each of N corners.

    place: (N, P, 2) px. grey: (N, P). weight: (N, P), 0 or 1.
    rims: (N, 3): how far beyond either edge a marker begins, px, infinite without markers, and the
        sign of the product of distances from both edges where squares are white.
    """

    place: Array
    grey: Array
    weight: Array
    rims: Array


def refine_corners(
    image: Bytes,
    start: Array,
    along: Array,
    bright_diagonal: Mask,
    *,
    marker_gap: float | None = None,
) -> tuple[Array, Mask]:
    """Refine corners (N, 2) px from starts about a pixel off; returns them and which to trust (N,).

    along: (N, 2, 2) px, columns: one square along the print's x, one along its y; keeps
        neighbouring edges out of the windows.
    bright_diagonal: (N,) whether the white squares at a corner are the one before it in x and y and
        the one after it in both, or the other two.
    marker_gap: on a ChArUco board the white rim around a marker, in squares.
    """
    if not len(start):
        return start, np.zeros(0, bool)

    def patches(radius_px: float) -> _Patches:
        return _patches(image, start, along, bright_diagonal, marker_gap, radius_px)

    usual = patches(RADIUS_PX)
    fit = _fit(usual, start, along)
    if np.median(fit.sigma) > NOISY_PX:
        fit = _fit(patches(NOISY_RADIUS_PX), start, along, _common_light(fit))
    fitted, sigma = fit.state, fit.sigma
    # b is the brightness of squares where one edge distance is negative: not those on the diagonal.
    pixels, contrast = fitted[:, :2], np.where(bright_diagonal, -fitted[:, 5], fitted[:, 5])
    good = usual.weight.sum(axis=1) >= MIN_PIXELS
    good &= np.linalg.norm(pixels - start, axis=1) < MAX_MOVE_PX
    good &= contrast > MIN_CONTRAST
    share = fit.residual / np.maximum(contrast, MIN_CONTRAST)
    good &= share < _limit(share[good], USUAL_RESIDUAL, MAX_RESIDUAL)
    good &= sigma < _limit(sigma[good], USUAL_SIGMA_PX, MAX_SIGMA_PX)
    # At the image's rim a corner seen on one side only is fitted well, but in the wrong place.
    size = np.array(image.shape[::-1])
    good &= np.all((pixels >= MIN_BORDER_PX) & (pixels <= size - 1 - MIN_BORDER_PX), axis=1)
    return pixels, good


def _limit(values: Array, usual: float, most: float) -> float:
    """Upper limit for a corner, given the values (N,) of those that are good otherwise."""
    median = float(np.median(values)) if len(values) else 0.0
    return float(np.clip(TIMES_MEDIAN * median, usual, most))


def _patches(
    image: Bytes,
    start: Array,
    along: Array,
    bright_diagonal: Mask,
    marker_gap: float | None,
    radius_px: float,
) -> _Patches:
    """The pixels of a square window that belong to the four squares around each corner."""
    radius = int(np.ceil(radius_px))
    across = np.arange(-radius, radius + 1)
    offset = np.stack(np.meshgrid(across, across), axis=-1).reshape(-1, 2)
    place = np.rint(start)[:, None] + offset.astype(np.float64)
    height, width = image.shape
    inside = np.all((place >= 0) & (place <= [width - 1, height - 1]), axis=-1)
    column, row = np.clip(place, 0, [width - 1, height - 1]).astype(np.intp).transpose(2, 0, 1)
    from_corner = place - start[:, None]
    squares = np.einsum("nij,npj->npi", np.linalg.pinv(along), from_corner)
    weight = inside & np.all(np.abs(squares) < WINDOW_SQUARES, axis=-1)
    weight &= np.sum(from_corner**2, axis=-1) <= radius_px**2
    # Along the diagonal the product of distances from the edges' normals is negative.
    rims = np.full((len(start), 3), np.inf)
    rims[:, 2] = np.where(bright_diagonal, -1.0, 1.0)
    if marker_gap is not None:
        # Distances in px from the edges along y and x through the corner, and where markers begin.
        lengths = np.abs(np.linalg.det(along))[:, None] / np.linalg.norm(along, axis=1)[:, ::-1]
        rims[:, :2] = marker_gap * lengths[:, ::-1]
        from_edge = np.abs(squares) * lengths[:, None]
        clear = np.maximum(marker_gap * lengths - CLEAR_OF_MARKER_PX, MIN_ARM_PX)
        white = (squares.prod(axis=-1) > 0) == bright_diagonal[:, None]
        weight &= np.any(from_edge < clear[:, None], axis=-1) | ~white
    return _Patches(place, image[row, column].astype(float), weight.astype(float), rims)


@dataclass(frozen=True, eq=False)
class _Fit:
    """Fitted corners.

    state: (N, 9): corner (2), the angles of both edges' normals (2), blur, b, a, g (2).
    residual: (N,) RMS in grey levels.
    variance: (N,) of a pixel.
    covariance: (N, 9, 9).
    """

    state: Array
    residual: Array
    variance: Array
    covariance: Array

    @property
    def sigma(self) -> Array:
        """Sigma (N,) px of each corner's worse coordinate, estimated from the residuals."""
        corner = np.einsum("nii->ni", self.covariance)[:, :2]
        return np.asarray(np.sqrt(np.maximum(corner.max(axis=1), 0.0)))


@dataclass(frozen=True, eq=False)
class _Light:
    """Prior knowledge of g: mean (2,), and information (N, 2) in squared grey levels."""

    mean: Array
    information: Array

    def added(self, equations: StackedEquations, state: Array) -> StackedEquations:
        off = state[:, 7:] - self.mean
        normal, gradient = equations.normal.copy(), equations.gradient.copy()
        normal[:, [7, 8], [7, 8]] += self.information
        gradient[:, 7:] += self.information * off
        cost = equations.cost + np.sum(self.information * off**2, axis=1)
        return StackedEquations(normal, gradient, cost, equations.freedoms)


def _common_light(fit: _Fit) -> _Light:
    """A prior for g from all corners: light varies over a board much alike at all of them, while in
    noise each alone says little of it, and a wrong g moves the corner. Its variation between
    corners sets the prior's width."""
    slope = fit.state[:, 7:]
    mean = np.median(slope, axis=0)
    told = np.median(np.einsum("nii->ni", fit.covariance)[:, 7:], axis=0)
    seen = (SIGMAS_PER_MEDIAN * np.median(np.abs(slope - mean), axis=0)) ** 2
    differs = np.maximum(seen - told, LEAST_OF_SEEN * seen + 1e-12)
    return _Light(mean, fit.variance[:, None] / differs)


def _fit(patches: _Patches, start: Array, along: Array, light: _Light | None = None) -> _Fit:
    """Fit the image model to every corner's patch."""
    angles = np.arctan2(along[:, 1], along[:, 0]) + np.pi / 2.0
    state = np.column_stack(
        [start, angles, np.full(len(start), BLUR_PX), np.zeros((len(start), 4))]
    )
    state[:, 5:] = _linear(patches, state)

    def equations(state: Array) -> StackedEquations:
        own = _equations(patches, state)
        return light.added(own, state) if light else own

    def within(state: Array) -> Array:
        state[:, 4] = np.clip(state[:, 4], *BLUR_RANGE_PX)
        return state

    solution = minimize_each(
        state, equations, within=within, steps=STEPS, settled=SETTLED, damping=1e-3
    )
    total = np.maximum(patches.weight.sum(axis=1), 1.0)
    return _Fit(
        solution.state,
        np.sqrt(solution.equations.cost / total),
        solution.equations.variance,
        solution.covariance(),
    )


def _linear(patches: _Patches, state: Array) -> Array:
    """b, a and g (N, 4) by least squares for given edges: in a state without contrast and without
    falling light, the image is linear in them."""
    even = np.column_stack([state[:, :5], np.tile([0.0, MIN_CONTRAST, 0.0, 0.0], (len(state), 1))])
    at = _equations(patches, even)
    step = solve_scaled(at.normal[:, 5:, 5:], at.gradient[:, 5:], np.full(len(state), UNSEEN))
    return even[:, 5:] - step


def _equations(patches: _Patches, state: Array) -> StackedEquations:
    """Normal equations of every corner's fit at a state (N, 9)."""
    return StackedEquations(
        *sum_equations(patches.place, patches.grey, patches.weight, patches.rims, state)
    )


@compiled
def edge_and_slope(distance: float, blur: float) -> tuple[float, float]:
    """E(d) of a blurred edge, and its derivative."""
    scaled = distance / (math.sqrt(2.0) * blur)
    return math.erf(scaled), math.sqrt(2.0 / math.pi) / blur * math.exp(-scaled * scaled)


@compiled
def sum_equations(
    place: Array, grey: Array, weight: Array, rims: Array, state: Array
) -> tuple[Array, Array, Array, Array]:
    """The fields of `StackedEquations` for pixels, weights and rims of `_Patches` at states (N, 9).

    Compiled, because it takes most of the time of finding boards: pixels without weight cost
    nothing, and no derivative is stored.
    """
    count, pixels = grey.shape
    normal, gradient = np.zeros((count, 9, 9)), np.zeros((count, 9))
    cost, freedoms = np.zeros(count), np.zeros(count)
    by = np.empty(9)
    for n in range(count):
        blur, b, a = state[n, 4], state[n, 5], max(state[n, 6], MIN_CONTRAST)
        cos1, sin1 = math.cos(state[n, 2]), math.sin(state[n, 2])
        cos2, sin2 = math.cos(state[n, 3]), math.sin(state[n, 3])
        for p in range(pixels):
            if weight[n, p] == 0.0:
                continue
            x, y = place[n, p, 0] - state[n, 0], place[n, p, 1] - state[n, 1]
            across1, across2 = x * cos1 + y * sin1, x * cos2 + y * sin2
            edge1, steep1 = edge_and_slope(across1, blur)
            edge2, steep2 = edge_and_slope(across2, blur)
            product, by1, by2 = edge1 * edge2, steep1 * edge2, edge1 * steep2
            by_blur = by1 * across1 + by2 * across2
            into1, into2 = abs(across1) - rims[n, 0], abs(across2) - rims[n, 1]
            if across1 * across2 * rims[n, 2] > 0.0 and min(into1, into2) > -NO_RIM * blur:
                rim1, steep1 = edge_and_slope(into1, blur)
                rim2, steep2 = edge_and_slope(into2, blur)
                kept = 1.0 - 0.5 * (1.0 + rim1) * (1.0 + rim2)
                lost1, lost2 = (1.0 + rim2) * steep1, (1.0 + rim1) * steep2
                by_blur = kept * by_blur - 0.5 * product * (lost1 * into1 + lost2 * into2)
                by1 = kept * by1 - 0.5 * product * math.copysign(lost1, across1)
                by2 = kept * by2 - 0.5 * product * math.copysign(lost2, across2)
                product *= kept
            squares = a + b * product
            light = 1.0 + (x * state[n, 7] + y * state[n, 8]) / a
            residual = squares * light - grey[n, p]
            worth1, worth2 = b * light * by1, b * light * by2
            by[0] = -squares / a * state[n, 7] - worth1 * cos1 - worth2 * cos2
            by[1] = -squares / a * state[n, 8] - worth1 * sin1 - worth2 * sin2
            by[2], by[3] = worth1 * (y * cos1 - x * sin1), worth2 * (y * cos2 - x * sin2)
            by[4] = -b * light * by_blur / blur
            by[5], by[6] = product * light, light - squares * (light - 1.0) / a
            by[7], by[8] = squares / a * x, squares / a * y
            for i in range(9):
                weighted = weight[n, p] * by[i]
                gradient[n, i] += weighted * residual
                for j in range(i + 1):
                    normal[n, i, j] += weighted * by[j]
            cost[n] += weight[n, p] * residual**2
            freedoms[n] += weight[n, p]
        for i in range(9):
            for j in range(i):
                normal[n, j, i] = normal[n, i, j]
    return normal, gradient, cost, np.maximum(freedoms - 9.0, 1.0)
