"""The size of a rig by references: certified lengths, measured by the cameras as boards place them.

All lengths of a rig come from the `square_mm` of prints, which paper and printers change by parts
in a thousand. Boards of references take no part in the solve; their corners are triangulated,
and the ratio of their measured to their certified length shows how far off all prints are.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from bodyscan.arrays import Array, Indices
from bodyscan.boards.board_layout import compute_corner_grid, compute_corner_points
from bodyscan.boards.view import BoardView
from bodyscan.errors import FailedWork
from bodyscan.geometry.robust import compute_rms_length
from bodyscan.geometry.transforms import fit_rigid_transform
from bodyscan.outcome import Outcome
from bodyscan.registration.rig_calibration import MAX_SIZE_ERROR, REFUSED_SIZE_ERROR
from bodyscan.registration.rig_solve import RigSolution
from bodyscan.rig.board import Board
from bodyscan.rig.gauge import Reference
from bodyscan.rig.rig import Rig

MIN_CORNERS = 6
"""Corners of a board that two cameras must see: fewer give its middle poorly, and hide errors."""


@dataclass(frozen=True)
class Size:
    """True size over that by `square_mm`, and its relative sigma, 0 if nothing fixes it."""

    factor: float = 1.0
    sigma: float = 0.0

    @property
    def words(self) -> str:
        return f"by its references the rig is {self.factor:.3f} times as large as square_mm says"


Reading = tuple[float, float]
"""Length of a reference as measured in one shot, and its sigma, mm."""


def select_solving_views(rig: Rig, views: Sequence[BoardView]) -> list[BoardView]:
    """Views that place the rig: those of boards that are not references, if there are any."""
    certified = {name for reference in rig.references for name in reference.boards}
    if certified.issuperset(board.name for board in rig.boards):
        return list(views)
    return [view for view in views if view.board not in certified]


def find_rig_size(rig: Rig, solution: RigSolution, views: Sequence[BoardView]) -> Outcome[Size]:
    """The rig's size by all references together, with a note on each.

    Raises FailedWork for a size that no printer's error explains, or contradictory references.
    """
    found: dict[str, Size] = {}
    notes: list[str] = []
    if not rig.references:
        squares = ", ".join(f"{board.name}: {board.square_mm:g}" for board in rig.boards)
        notes.append(
            f"all lengths rest on square_mm ({squares}), and no residual shows an error of it: half "
            "a percent is 5 mm of a girth of 1 m. Measure ten squares of the print, or name a "
            "certified length under `references`"
        )
    for reference in rig.references:
        readings = list(_list_readings(rig, reference, solution, views))
        if not readings:
            notes.append(
                f"reference {reference.name} was measured in no shot, so that the size is what "
                f"square_mm says: two cameras have to see {MIN_CORNERS} corners of its boards at once"
            )
            continue
        length, sigma = _average(readings)
        size = Size(
            reference.length_mm / length,
            float(np.hypot(sigma / length, reference.sigma_mm / reference.length_mm)),
        )
        found[reference.name] = size
        notes.append(
            f"reference {reference.name}: {length:.3f} mm by square_mm (sigma {sigma:.3f}, "
            f"{len(readings)} shots) for {reference.length_mm:g} mm: {_format_size(size)}"
        )
    if not found:
        return Outcome(Size(), tuple(notes))
    weights = np.array([1.0 / size.sigma**2 for size in found.values()])
    factors = np.array([size.factor for size in found.values()])
    size = Size(float(weights @ factors / weights.sum()), float(weights.sum() ** -0.5))
    _refuse_contradictions(rig, found, size)
    if abs(size.factor - 1.0) > MAX_SIZE_ERROR:
        notes.append(f"{size.words}, more than prints are off: is square_mm right, and length_mm?")
    shared = "the same relative uncertainty applies to every length"
    notes.append(f"scale from references: {_format_size(size)}; {shared}")
    return Outcome(size, tuple(notes))


def rescale_boards(rig: Rig, factor: float) -> Rig:
    """The rig with its boards' true square sizes; certified boards stay, unless all are certified."""
    certified = {name for reference in rig.references for name in reference.boards}
    alone = certified.issuperset(board.name for board in rig.boards)

    def rescale(board: Board) -> Board:
        if board.name in certified and not alone:
            return board
        marker_mm = board.marker_mm and board.marker_mm * factor
        size = {"square_mm": board.square_mm * factor, "marker_mm": marker_mm}
        return board.model_copy(update=size)

    return rig.model_copy(update={"boards": tuple(map(rescale, rig.boards))})


def _format_size(size: Size) -> str:
    return f"{100.0 * (size.factor - 1.0):+z.3f} % (sigma {100.0 * size.sigma:.3f} %)"


def _refuse_contradictions(rig: Rig, found: dict[str, Size], size: Size) -> None:
    if abs(size.factor - 1.0) > REFUSED_SIZE_ERROR:
        raise FailedWork(
            size.words,
            where=f"rig {rig.name}",
            remedy="correct square_mm of the boards, or length_mm of the references",
        )
    for name, one in found.items():
        # References that differ by more contradict each other: once in 10,000 by chance.
        if abs(one.factor - size.factor) > 4.0 * one.sigma:
            figures = "; ".join(
                f"{other}: {_format_size(other_size)}" for other, other_size in found.items()
            )
            raise FailedWork(
                f"the references disagree: {figures}",
                where=f"rig {rig.name}",
                remedy=f"measure {name} anew, or leave out the one that is wrong",
            )


def _average(readings: Sequence[Reading]) -> tuple[float, float]:
    """Mean over all shots and its sigma, larger if shots scatter more than their sigmas say."""
    lengths, sigmas = np.array(readings).T
    weights = sigmas**-2
    mean = float(weights @ lengths / weights.sum())
    scatter = float(weights @ (lengths - mean) ** 2) / max(len(readings) - 1, 1)
    return mean, float(np.sqrt(max(scatter, 1.0) / weights.sum()))


def _list_readings(
    rig: Rig, reference: Reference, solution: RigSolution, views: Sequence[BoardView]
) -> Iterator[Reading]:
    """One reading for each shot in which two cameras saw enough of all its boards."""
    for shot in sorted({view.shot for view in views if view.board in reference.boards}):
        boards = []
        for name in reference.boards:
            of_board = [view for view in views if (view.shot, view.board) == (shot, name)]
            ids, points = triangulate_corners(solution, of_board)
            if len(ids) >= MIN_CORNERS:
                boards.append((rig.board(name), ids, points))
        if len(boards) < len(reference.boards):
            continue
        if len(boards) == 1:
            yield _measure_board(*boards[0], solution.variance_inflation)
        else:
            yield _measure_separation(boards, solution.variance_inflation)


def triangulate_corners(solution: RigSolution, views: Sequence[BoardView]) -> tuple[Indices, Array]:
    """Triangulate the corners of one board that several solved cameras saw.

    Returns their numbers (N,) and positions (N, 3) mm, rig frame, nearest to all rays.
    """
    views = [view for view in views if view.pair in solution.rig_from_camera]
    if len({view.pair for view in views}) < 2:
        return np.zeros(0, np.int64), np.zeros((0, 3))
    ids = np.concatenate([view.corner_ids for view in views])
    across, centres = [], []
    for view in views:
        at = solution.rig_from_camera[view.pair]
        rays = at.rotate(solution.cameras[view.pair].rays(view.pixels))
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        across.append(np.eye(3) - rays[:, :, None] * rays[:, None, :])
        centres.append(np.broadcast_to(at.translation, rays.shape))
    square, centre = np.concatenate(across), np.concatenate(centres)
    known, number, count = np.unique(ids, return_inverse=True, return_counts=True)
    normal, right = np.zeros((len(known), 3, 3)), np.zeros((len(known), 3))
    np.add.at(normal, number, square)
    np.add.at(right, number, np.einsum("nij,nj->ni", square, centre))
    twice = count >= 2
    found = np.asarray(np.linalg.solve(normal[twice], right[twice][..., None])[..., 0], np.float64)
    return known[twice].astype(np.int64), found


def _measure_board(board: Board, ids: Indices, points: Array, variance_inflation: float) -> Reading:
    """The length of one board, from the scale of a similarity onto its layout."""
    layout = compute_corner_points(board)
    length = compute_board_length(board)
    described, found = layout[ids], fit_rigid_transform(layout[ids], points).inverse().apply(points)
    arms = described - described.mean(axis=0)
    scale = float(np.sum(arms * found) / np.sum(arms**2))
    residuals = found - found.mean(axis=0) - scale * arms
    # Corners err less along the board than towards the cameras.
    sigma = np.sqrt(variance_inflation * np.sum(np.sum(arms * residuals, axis=1) ** 2)) / np.sum(
        arms**2
    )
    return scale * length, float(sigma) * length


def compute_board_length(board: Board) -> float:
    """Distance between the first and the last corner of a row of corners, mm."""
    layout = compute_corner_points(board)
    return float(np.linalg.norm(layout[compute_corner_grid(board)[0] - 1] - layout[0]))


def _measure_separation(
    boards: Sequence[tuple[Board, Indices, Array]], variance_inflation: float
) -> Reading:
    """The distance between the middles of two boards; boards: each with corner ids (N,) and their
    positions (N, 3) mm."""
    middles, residuals, levers = [], [], []
    for board, ids, points in boards:
        described = compute_corner_points(board)[ids]
        rig_from_board = fit_rigid_transform(described, points)
        middle, centroid = np.array([*board.size_mm, 0.0]) / 2.0, described.mean(axis=0)
        middles.append(rig_from_board.apply(middle))
        residuals.append(rig_from_board.apply(described) - points)
        # Corners that err turn a board about their centroid: distance of the middle from it, in
        # units of the corners' RMS radius.
        levers.append(np.linalg.norm(middle - centroid) / compute_rms_length(described - centroid))
    length = float(np.linalg.norm(middles[0] - middles[1]))
    along = (middles[0] - middles[1]) / length
    variance = sum(
        np.mean((each @ along) ** 2) * (1.0 + lever**2) / len(each)
        for each, lever in zip(residuals, levers, strict=True)
    )
    return length, float(np.sqrt(variance_inflation * variance))
