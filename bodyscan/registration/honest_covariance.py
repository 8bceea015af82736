"""How well the joint solve knows its unknowns, judged by its own boards.

Corners do not err independently: what lens, light and detector do to one they do to its neighbours,
and to the same board in the same place again. So each place of a board is one piece of evidence;
how much larger its pull on the unknowns is than that of independent corners is measured and goes
into the covariance (a sandwich with places as clusters; Liang and Zeger, Biometrika 73, 1986).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from bodyscan.arrays import Array, Indices
from bodyscan.calibration.board_views import LocatedView, max_displacement_mm
from bodyscan.geometry.linear_gaussian import invert_scaled
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.geometry.uncertainty import PoseCovariance
from bodyscan.registration.normal_equations import NormalEquations
from bodyscan.registration.view_graph import Target

NEAR = 0.05
"""Boards share a place if no corner is farther off than this share of their size."""
KNOWN_FROM = 10.0
"""Degrees of freedom at which a place's own excess counts for half; the rest is what all places
show together."""


@dataclass(frozen=True, eq=False)
class HonestCovariance:
    """Covariance of the joint solve's unknowns.

    poses: of the pairs.
    cameras: (P, P) of each camera's parameters, where they were free.
    excess: factor on the variances that independent corners predict, over all places.
    """

    poses: PoseCovariance
    cameras: dict[str, Array]
    excess: float


def honest_covariance(
    equations: NormalEquations, places: Sequence[Sequence[Target]]
) -> HonestCovariance:
    """The sandwich covariance; places: the targets of each, every target in one."""
    rest = np.setdiff1d(
        np.arange(len(equations.matrix)),
        np.append(equations.held, np.arange(equations.first_board, equations.first_camera)),
    )
    information = np.zeros((len(places), len(rest), len(rest)))
    pulls = np.zeros((len(places), len(rest)))
    number = {target: k for k, place in enumerate(places) for target in place}
    for target, part in zip(equations.targets, equations.parts, strict=True):
        own, matrix, pull = _without_board(part.columns, part.matrix, part.gradient, equations.held)
        where = np.searchsorted(rest, own)
        information[number[target]][np.ix_(where, where)] += matrix
        pulls[number[target]][where] += pull
    inverse = invert_scaled(_all_but_boards(equations, rest))
    variance = equations.variance_px2
    excess = _excess(information, pulls, inverse, variance)
    pooled = excess.pooled
    middle = np.tensordot(excess.of_place, information, axes=1)
    known = _all_but_boards(equations, rest) - information.sum(axis=0)  # priors, exact
    covariance = variance * inverse @ (middle + known) @ inverse
    return _named(equations, rest, 0.5 * (covariance + covariance.T), pooled)


def board_places(
    views: Sequence[LocatedView], rig_from_board: Mapping[Target, RigidTransform]
) -> list[list[Target]]:
    """Group targets by where their board stood, each with the first one near it."""
    sizes = {
        name: float(np.linalg.norm(np.ptp(points, axis=0)))
        for name in {view.board for view in views}
        for points in [np.concatenate([view.points for view in views if view.board == name])]
    }
    found: list[list[Target]] = []
    for target in sorted({view.target for view in views}):
        size = sizes[target[1]]
        for place in found:
            first = rig_from_board[place[0]]
            if place[0][1] == target[1] and (
                max_displacement_mm(first, rig_from_board[target], size) < NEAR * size
            ):
                place.append(target)
                break
        else:
            found.append([target])
    return found


@dataclass(frozen=True, eq=False)
class _Excess:
    of_place: Array
    pooled: float


def _excess(information: Array, pulls: Array, inverse: Array, variance: float) -> _Excess:
    """How many times larger the square of each place's pull is than for independent corners.

    A pull is measured in the unknowns' own standard deviations. The expected square is tr(S - S S),
    where S is the place's share of all information; it is less than S because the solve followed
    the place.
    """
    # Place by place: with the corners of boards as unknowns all at once would take gigabytes.
    traces = []
    for own in information:
        share = own @ inverse
        kept = share - share @ share
        traces.append((np.trace(kept), np.sum(kept * kept.T)))
    expected, squared = np.array(traces).T
    freedoms = expected**2 / np.maximum(squared, 1e-300)
    found = np.einsum("ki,ij,kj->k", pulls, inverse, pulls) / variance
    if not expected.sum() > 1.0:  # a single place: its errors cannot be judged
        return _Excess(np.ones(len(pulls)), 1.0)
    pooled = max(float(found.sum() / expected.sum()), 1.0)
    own = found / np.maximum(expected, 1e-12)
    weight = freedoms / (freedoms + KNOWN_FROM)
    return _Excess(
        np.where(expected > 1e-6, weight * own + (1.0 - weight) * pooled, pooled), pooled
    )


def _without_board(
    columns: Indices, matrix: Array, gradient: Array, held: Indices
) -> tuple[Indices, Array, Array]:
    """A target's part with its board's motion eliminated, or fixed if the board holds the frame."""
    a, b = slice(0, len(columns) - 6), slice(len(columns) - 6, len(columns))
    reduced, pull = matrix[a, a], gradient[a]
    if columns[-1] not in held:
        carried = matrix[a, b] @ invert_scaled(matrix[b, b])
        reduced = reduced - carried @ matrix[b, a]
        pull = pull - carried @ gradient[b]
    free = ~np.isin(columns[a], held)
    return columns[a][free], reduced[np.ix_(free, free)], pull[free]


def _all_but_boards(equations: NormalEquations, rest: Indices) -> Array:
    """All information on the unknowns `rest`, priors included, boards eliminated."""
    boards = np.arange(equations.first_board, equations.first_camera)
    every = np.setdiff1d(np.arange(len(equations.matrix)), boards)
    where = np.searchsorted(every, rest)
    return equations.without_boards()[np.ix_(where, where)]


def _named(
    equations: NormalEquations, rest: Indices, covariance: Array, excess: float
) -> HonestCovariance:
    full = np.zeros(equations.matrix.shape)
    full[np.ix_(rest, rest)] = covariance
    pairs = slice(0, equations.first_board)
    cameras = {
        name: full[np.ix_(own, own)]
        for name, own in zip(equations.names, equations.camera_columns, strict=True)
        if len(own)
    }
    return HonestCovariance(PoseCovariance(equations.names, full[pairs, pairs]), cameras, excess)
