"""Refine board corners by fitting a model of the image around each.

Four squares meet in a corner; blurred, that is an offset plus the product of two edges, under light
that may fall off to one side:

    I(p) = (a + b E(n1 . (p - c)) E(n2 . (p - c))) (1 + g . (p - c) / a),
    E(d) = erf(d / (sqrt(2) sigma)),

with c the corner, n1 and n2 the normals of the two edge lines. Light multiplies: a slope added to
the squares instead shifts all corners of a tilted board together, by 0.01 px at 70 degrees.

A marker in a white square turns it dark from a gap g_i beyond both edges on: the product of the
edges is reversed there, by the factor 1 - 2 F1 F2 with F_i = (1 + E(|n_i . (p - c)| - g_i)) / 2.
Left out, its blurred rim pulls corners of small boards at 60 degrees away from the camera, by 0.02
px, all of them. All corners of a board are fitted at once.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from bodyscan.arrays import Array, Bytes, Indices, Mask
from bodyscan.boards.view import AS_PRINTED, Appearance
from bodyscan.compiled import compiled
from bodyscan.geometry.least_squares import StackedEquations, minimize_each
from bodyscan.geometry.linear_gaussian import solve_scaled
from bodyscan.geometry.robust import SIGMAS_PER_MEDIAN

WINDOW_SQUARES = 0.42
"""Half the width of the window around a corner, in squares: it stays clear of neighbouring edges."""
MIN_CONTRAST = 4.0
"""Least difference of grey levels between black and white, as a share of which noise is judged."""


@dataclass(frozen=True, eq=False)
class DetectedCorners:
    """Corners of one board face as found in an image."""

    ids: Indices  # (N,) int64
    pixels: Array  # (N, 2) px
    appearance: Appearance = AS_PRINTED


@dataclass(frozen=True, eq=False)
class _Patches:
    """P pixels around each of N corners."""

    pixels: Array  # (N, P, 2) px
    grey: Array  # (N, P)
    weight: Array  # (N, P), 0 or 1
    # (N, 3): how far beyond either edge a marker begins, px, infinite without markers, and the sign
    # of the product of distances from both edges where squares are white.
    rims: Array


def refine_corners(
    image: Bytes,
    start: Array,
    along: Array,
    bright_diagonal: Mask,
    *,
    marker_gap: float | None = None,
) -> tuple[Array, Mask]:
    """Refine corners (N, 2) px from starts about a pixel away; also return which are good (N,).

    along: (N, 2, 2) px, columns: one square along the print's x, one along its y.
    bright_diagonal: (N,) whether the white squares at a corner are the one before it in x and y and
        the one after it in both, or the other two.
    marker_gap: on a ChArUco board the white rim around a marker, in squares.
    """
    if not len(start):
        return start, np.zeros(0, bool)

    def patches(radius_px: float) -> _Patches:
        return _collect_patches(image, start, along, bright_diagonal, marker_gap, radius_px)

    narrow = patches(9.0)
    fit = _fit(narrow, start, along)
    if np.median(fit.sigma) > 0.04:  # in such noise a wider window is worth its time
        fit = _fit(patches(16.0), start, along, _estimate_common_light(fit))
    # b is the brightness of squares where one edge distance is negative: not those on the diagonal.
    pixels = fit.state[:, :2]
    contrast = np.where(bright_diagonal, -fit.state[:, 5], fit.state[:, 5])
    good = narrow.weight.sum(axis=1) >= 16
    good &= np.linalg.norm(pixels - start, axis=1) < 1.5
    good &= contrast > MIN_CONTRAST
    share = fit.residual / np.maximum(contrast, MIN_CONTRAST)
    good &= share < _compute_upper_limit(share[good], 0.25, 0.7)
    good &= fit.sigma < _compute_upper_limit(fit.sigma[good], 0.06, 0.35)
    # At the image's rim a corner visible on one side only is fitted well, but at the wrong position.
    size = np.array(image.shape[::-1])
    good &= np.all((pixels >= 5.0) & (pixels <= size - 6.0), axis=1)
    return pixels, good


def _compute_upper_limit(values: Array, clear: float, noisy: float) -> float:
    """Largest value of a good corner: twice the median (N,), within the limits of a clear image and
    of any image."""
    median = float(np.median(values)) if len(values) else 0.0
    return float(np.clip(2.0 * median, clear, noisy))


def _collect_patches(
    image: Bytes,
    start: Array,
    along: Array,
    bright_diagonal: Mask,
    marker_gap: float | None,
    radius_px: float,
) -> _Patches:
    """Collect the pixels of a square window that belong to the four squares around each corner."""
    radius = int(np.ceil(radius_px))
    across = np.arange(-radius, radius + 1)
    offset = np.stack(np.meshgrid(across, across), axis=-1).reshape(-1, 2)
    pixels = np.rint(start)[:, None] + offset.astype(np.float64)
    height, width = image.shape
    column, row = pixels.astype(np.intp).transpose(2, 0, 1)
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    from_corner = pixels - start[:, None]
    x, y = np.einsum("nij,npj->inp", np.linalg.pinv(along), from_corner)
    weight = inside & (np.maximum(np.abs(x), np.abs(y)) < WINDOW_SQUARES)
    weight &= np.einsum("npi,npi->np", from_corner, from_corner) <= radius_px**2
    # Along the diagonal the product of distances from the edges' normals is negative.
    rims = np.full((len(start), 3), np.inf)
    rims[:, 2] = np.where(bright_diagonal, -1.0, 1.0)
    if marker_gap is not None:
        # Distances in px from the edges along y and x through the corner, and where markers begin.
        lengths = np.abs(np.linalg.det(along))[:, None] / np.linalg.norm(along, axis=1)[:, ::-1]
        rims[:, :2] = marker_gap * lengths[:, ::-1]
        # Clear of a marker's blurred rim, but never narrower than a pixel and a half.
        clear = (np.maximum(marker_gap * lengths - 1.4, 1.5) / lengths).T[:, :, None]
        white = (x * y > 0) == bright_diagonal[:, None]
        weight &= (np.abs(x) < clear[0]) | (np.abs(y) < clear[1]) | ~white
    grey = image[np.clip(row, 0, height - 1), np.clip(column, 0, width - 1)]
    return _Patches(pixels, grey.astype(float), weight.astype(float), rims)


@dataclass(frozen=True, eq=False)
class _Fit:
    """Fitted corners."""

    state: Array  # (N, 9): corner (2), the angles of both edges' normals (2), blur, b, a, g (2)
    residual: Array  # (N,) RMS in grey levels
    variance: Array  # (N,) of a pixel
    covariance: Array  # (N, 9, 9)

    @property
    def sigma(self) -> Array:
        """Sigma (N,) px of each corner's worse coordinate, estimated from the residuals."""
        corner = np.einsum("nii->ni", self.covariance)[:, :2]
        return np.asarray(np.sqrt(np.maximum(corner.max(axis=1), 0.0)))


def _estimate_common_light(fit: _Fit) -> tuple[Array, Array]:
    """Estimate a Gaussian prior of g from all corners of a board: mean (2,), and information (N, 2) in
    squared grey levels.

    In noise one corner hardly determines g, which displaces it; at all of them it is similar. The
    prior's variance is the scatter of g less its noise.
    """
    slope = fit.state[:, 7:]
    mean = np.median(slope, axis=0)
    noise = np.median(np.einsum("nii->ni", fit.covariance)[:, 7:], axis=0)
    scatter = (SIGMAS_PER_MEDIAN * np.median(np.abs(slope - mean), axis=0)) ** 2
    variance = np.maximum(scatter - noise, 0.02 * scatter + 1e-12)
    return mean, fit.variance[:, None] / variance


def _fit(
    patches: _Patches, start: Array, along: Array, light: tuple[Array, Array] | None = None
) -> _Fit:
    """Fit the image model to every corner's patch. light: see `_estimate_common_light`."""
    angles = np.arctan2(along[:, 1], along[:, 0]) + np.pi / 2.0
    state = np.column_stack([start, angles, np.full(len(start), 0.9), np.zeros((len(start), 4))])
    state[:, 5:] = _solve_linear(patches, state)

    def equations(state: Array) -> StackedEquations:
        corners = _form_equations(patches, state)
        if light is None:
            return corners
        mean, information = light
        residual = state[:, 7:] - mean
        corners.normal[:, [7, 8], [7, 8]] += information
        corners.gradient[:, 7:] += information * residual
        return replace(corners, cost=corners.cost + np.sum(information * residual**2, axis=1))

    def within(state: Array) -> Array:
        state[:, 4] = np.clip(state[:, 4], 0.3, 3.0)  # blur, px
        return state

    # Settled within a tenth of a corner's sigma; one more step then makes it far less.
    solution = minimize_each(
        state, equations, within=within, steps=12, tolerance=1e-2, damping=1e-3
    )
    total = np.maximum(patches.weight.sum(axis=1), 1.0)
    return _Fit(
        solution.state,
        np.sqrt(solution.equations.cost / total),
        solution.equations.variance,
        solution.covariance(),
    )


def _solve_linear(patches: _Patches, state: Array) -> Array:
    """Solve for b, a and g (N, 4) with the edges fixed. Around a state without contrast and with even
    light the image is linear in them."""
    even = np.column_stack([state[:, :5], np.tile([0.0, MIN_CONTRAST, 0.0, 0.0], (len(state), 1))])
    at = _form_equations(patches, even)
    # A slight damping leaves unchanged what a window without pixels does not determine.
    step = solve_scaled(at.normal[:, 5:, 5:], at.gradient[:, 5:], np.full(len(state), 1e-9))
    return even[:, 5:] - step


def _form_equations(patches: _Patches, state: Array) -> StackedEquations:
    """Normal equations of every corner's fit at a state (N, 9)."""
    return StackedEquations(
        *sum_equations(patches.pixels, patches.grey, patches.weight, patches.rims, state)
    )


@compiled
def evaluate_edge(distance: float, blur: float) -> tuple[float, float]:
    """Evaluate E(d) of a blurred edge, and its derivative."""
    scaled = distance / (math.sqrt(2.0) * blur)
    return math.erf(scaled), math.sqrt(2.0 / math.pi) / blur * math.exp(-scaled * scaled)


@compiled
def sum_equations(
    pixels: Array, grey: Array, weight: Array, rims: Array, state: Array
) -> tuple[Array, Array, Array, Array]:
    """Sum the fields of `StackedEquations` for pixels, weights and rims of `_Patches` at states (N, 9).

    Compiled, because it takes most of the time of finding boards: pixels without weight cost
    nothing, and no derivative is stored.
    """
    count, size = grey.shape
    normal, gradient = np.zeros((count, 9, 9)), np.zeros((count, 9))
    cost, freedoms = np.zeros(count), np.zeros(count)
    by = np.empty(9)
    for n in range(count):
        blur, b, a = state[n, 4], state[n, 5], max(state[n, 6], MIN_CONTRAST)
        cos1, sin1 = math.cos(state[n, 2]), math.sin(state[n, 2])
        cos2, sin2 = math.cos(state[n, 3]), math.sin(state[n, 3])
        for p in range(size):
            if weight[n, p] == 0.0:
                continue
            x, y = pixels[n, p, 0] - state[n, 0], pixels[n, p, 1] - state[n, 1]
            across1, across2 = x * cos1 + y * sin1, x * cos2 + y * sin2
            edge1, steep1 = evaluate_edge(across1, blur)
            edge2, steep2 = evaluate_edge(across2, blur)
            product, by1, by2 = edge1 * edge2, steep1 * edge2, edge1 * steep2
            by_blur = by1 * across1 + by2 * across2
            into1, into2 = abs(across1) - rims[n, 0], abs(across2) - rims[n, 1]
            # Four blurs before a marker's rim it takes less than 1e-4 of the contrast.
            if across1 * across2 * rims[n, 2] > 0.0 and min(into1, into2) > -4.0 * blur:
                rim1, steep1 = evaluate_edge(into1, blur)
                rim2, steep2 = evaluate_edge(into2, blur)
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
