"""Find plain checkerboards: try several detectors until the corners of one form the board.

Convention: if the numbers of columns and rows differ in parity the print looks different from its
two ends, and its first square (0, 0) is BLACK, as OpenCV prints it; that fixes the numbering.
"""

from __future__ import annotations

from collections.abc import Iterator

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from bodyscan.arrays import WHOLE, Array, Bytes, Crop, Indices
from bodyscan.boards import board_layout
from bodyscan.boards.board_map import BoardMap, fit_board_map
from bodyscan.boards.corners import DetectedCorners, refine_corners
from bodyscan.errors import BadInput
from bodyscan.rig.board import Board

MIN_SQUARES = 4
"""In either direction: OpenCV's quick detectors refuse to look for fewer than three corners."""


def find_checkerboard(image: Bytes, board: Board, *, quick: bool = False) -> DetectedCorners | None:
    """Find the inner corners of a checkerboard that is wholly in view; None if it is not.

    Numbered by the convention in the module's docstring. Raises BadInput, unless `quick` (the two
    quickest detectors only), for a board of fewer than MIN_SQUARES in one direction.
    """
    if not quick and min(board.columns, board.rows) < MIN_SQUARES:
        raise BadInput(
            f"a plain checkerboard of {board.columns} columns and {board.rows} rows cannot be found: "
            f"it takes {MIN_SQUARES} squares in either direction",
            where=f"board {board.name}",
            remedy="use a board with more squares, or a charuco board",
        )
    for candidate in _propose_corners(image, board, quick):
        found = _refine(image, board, candidate)
        if found is None or len(found.ids) < len(candidate):
            curved = _refine(image, board, candidate, curved=True)
            found = max(filter(None, (found, curved)), key=lambda one: len(one.ids), default=None)
        if found is not None:
            return found
    return None


def _refine(
    image: Bytes, board: Board, candidate: Array, *, curved: bool = False
) -> DetectedCorners | None:
    """Refine a detector's corners (N, 2) px; None unless most are found and form this board.

    Detectors err by a pixel or two at times: corners not found there are looked for where the
    others predict them; on a board that is `curved` (`fit_board_map`) all are needed for that.
    """
    printed = board_layout.compute_printed_corners(board)
    row, column = np.divmod(np.arange(len(printed)), board.columns - 1)
    pixels, first_is_black = _number_as_printed(image, board, candidate, printed)
    bright_diagonal = ((row + column) % 2 == 0) != first_is_black
    board_map, start = fit_board_map(printed, pixels, curved=curved), pixels
    good = np.zeros(len(printed), bool)
    for _ in range(3):
        along = board.square_mm * board_map.jacobian(printed)
        refined, found = refine_corners(image, start, along, bright_diagonal)
        pixels, good = np.where(found[:, None] & ~good[:, None], refined, pixels), good | found
        if good.mean() < 0.4:
            return None
        near = good | curved
        board_map = fit_board_map(printed[near], pixels[near], curved=curved)
        error = np.linalg.norm(board_map.apply(printed) - pixels, axis=-1)
        size = np.sqrt(np.abs(np.linalg.det(along)))
        # A bowed board and a lens leave hundredths of a square, mixed-up corners a whole one.
        good &= error < 0.15 * size
        if good.all():
            break
        start = board_map.apply(printed)
    if good.mean() < 0.8 or _is_part_of_larger(image, board, board_map, first_is_black):
        return None
    return DetectedCorners(np.flatnonzero(good).astype(np.int64), pixels[good])


def _is_part_of_larger(
    image: Bytes, board: Board, board_map: BoardMap, first_is_black: bool
) -> bool:
    """Whether squares and corners continue beyond a side, at half the contrast or more."""
    inside = _sample_greys(image, board, board_map, _list_inner_squares(board))
    contrast = abs(inside[0].mean() - inside[1].mean())
    for lines, squares in _extend_beyond(board):
        even, odd = _sample_greys(image, board, board_map, squares)
        dark, light = (even, odd) if first_is_black else (odd, even)
        if light.min() - dark.max() < 0.5 * contrast:
            continue
        printed = board.square_mm * lines.astype(float)
        along = board.square_mm * board_map.jacobian(printed)
        bright_diagonal = (lines.sum(axis=1) % 2 == 0) != first_is_black
        _, found = refine_corners(image, board_map.apply(printed), along, bright_diagonal)
        if found.mean() > 0.5:
            return True
    return False


def _extend_beyond(board: Board) -> Iterator[tuple[Indices, Indices]]:
    """Yield for each side the corners (N, 2) and squares (M, 2) of a larger board beyond it."""
    size = np.array([board.columns, board.rows])
    for along, across in ((0, 1), (1, 0)):
        for line, square in ((0, -1), (size[across], size[across])):
            corners = np.full((size[along] - 1, 2), line)
            corners[:, along] = np.arange(1, size[along])
            squares = np.full((size[along], 2), square)
            squares[:, along] = np.arange(size[along])
            yield corners, squares


def _propose_corners(image: Bytes, board: Board, quick: bool) -> Iterator[Array]:
    """Yield corner sets (N, 2) px from the detectors, in order of speed and success.

    The plain threshold of the whole image finds most boards in hundredths of a second. If it finds
    none and there is no lattice of saddles either, there is no board. Then: adaptive thresholds for
    uneven light or a busy background; enlarged crops for fine and slanted boards; the sector-based
    detector, a fifth of a second per megapixel, for blurred and noisy ones (its
    CALIB_CB_NORMALIZE_IMAGE shifts corners by 0.25 px), and enlarged, in a second, for fine ones.
    Boards of many squares by the latter alone, in the image at half its size first.
    """
    size = (board.columns - 1, board.rows - 1)
    # The quad-based detector sorts quads for 10 to 20 s where one of 500 squares is covered.
    large = size[0] * size[1] > 200
    if large:
        yield from _detect(image, size, scale=0.5, sector_based=True)
    else:
        yield from _detect(image, size)
    adaptive = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE
    if not quick and not shows_lattice(image, size):
        if not large:  # a fisheye bends a board that fills its picture until it is no lattice
            yield from _detect(image, size, scale=min(0.5, 640 / image.shape[1]), flags=adaptive)
        return
    if not large:
        yield from _detect(image, size, flags=adaptive)
    if quick:
        return
    regions = find_board_regions(image, size[0] * size[1])
    for region in regions if not large else ():
        if 2 * image[region].size < image.size:
            yield from _detect(image, size, region, scale=2.0)
    for region in regions if not large else ():
        yield from _detect(image, size, region)
    for region in (*regions, WHOLE):
        yield from _detect(image, size, region, sector_based=True)
    for region in regions[:1]:
        yield from _detect(image, size, region, flags=cv2.CALIB_CB_ACCURACY, sector_based=True)


def _detect(
    image: Bytes,
    size: tuple[int, int],
    region: Crop = WHOLE,
    *,
    scale: float = 1.0,
    flags: int = 0,
    sector_based: bool = False,
) -> Iterator[Array]:
    """Yield the corners that a detector finds in a region of the image, enlarged by `scale`."""
    part, (rows, columns) = image[region], region
    if scale != 1.0:
        part = cv2.resize(part, None, fx=scale, fy=scale, interpolation=cv2.INTER_CUBIC)
    detect = cv2.findChessboardCornersSB if sector_based else cv2.findChessboardCorners
    found, corners = detect(part, size, flags=flags)
    if found and corners is not None:
        pixels = np.asarray(corners, float).reshape(-1, 2)
        yield (pixels + 0.5) / scale - 0.5 + [columns.start or 0, rows.start or 0]


def _number_as_printed(
    image: Bytes, board: Board, corners: Array, printed: Array
) -> tuple[Array, bool]:
    """Put corners (N, 2) in the print's order; also return whether its first square is black.

    Never mirrored; starts at the end whose first square is black if the other end's is white.
    """
    grid = corners.reshape(board.rows - 1, board.columns - 1, 2)
    across = (grid[:, -1] - grid[:, 0]).mean(axis=0)
    down = (grid[-1] - grid[0]).mean(axis=0)
    if across[0] * down[1] - across[1] * down[0] < 0:
        grid = grid[:, ::-1]
    pixels = grid.reshape(-1, 2)
    # By all squares between inner corners: uneven light does not matter.
    even, odd = _sample_greys(
        image, board, fit_board_map(printed, pixels), _list_inner_squares(board)
    )
    first_is_black = bool(even.mean() < odd.mean())
    if (board.columns + board.rows) % 2 and not first_is_black:
        pixels, first_is_black = pixels[::-1], True
    return np.ascontiguousarray(pixels), first_is_black


def _list_inner_squares(board: Board) -> Indices:
    """Column and row (N, 2) of the squares between inner corners."""
    column, row = np.meshgrid(np.arange(1, board.columns - 1), np.arange(1, board.rows - 1))
    return np.stack([column.ravel(), row.ravel()], axis=-1)


def _sample_greys(
    image: Bytes, board: Board, board_map: BoardMap, squares: Indices
) -> tuple[Array, Array]:
    """Sample grey levels in the middles of squares (N, 2), given by column and row: of those with
    an even sum, and of the others."""
    where = board_map.apply(board.square_mm * (squares.astype(float) + 0.5)).astype(np.float32)
    grey = cv2.remap(image, where[:, None], None, cv2.INTER_LINEAR).ravel().astype(float)
    even = squares.sum(axis=1) % 2 == 0
    return grey[even], grey[~even]


def find_board_regions(image: Bytes, corners: int) -> list[Crop]:
    """Find regions of the image (H, W) with enough saddles for a board of that many corners.

    OpenCV's quick detector finds fine, slanted or dim boards more readily in an image of the board
    alone. Saddles are clustered at two distances; the two largest clusters of each count.
    """
    points, _ = _find_strongest_saddles(image, 4 * corners + 100)
    height, width = image.shape
    marks = np.zeros((height, width), np.uint8)
    marks[points[:, 1], points[:, 0]] = 1
    regions: list[Crop] = []
    for reach in (16, 40):  # px
        grown = cv2.dilate(marks, np.ones((2 * reach + 1, 2 * reach + 1), np.uint8))
        label = cv2.connectedComponents(grown)[1][points[:, 1], points[:, 0]]
        sizes = np.bincount(label)
        for largest in np.argsort(-sizes, kind="stable")[:2]:
            if sizes[largest] < 0.7 * corners:
                break
            members = points[label == largest]
            low, high = members.min(axis=0), members.max(axis=0)
            margin = 0.15 * (high - low) + 20
            left, top = np.maximum(low - margin, 0).astype(int).tolist()
            right, bottom = np.minimum(high + margin + 1, [width, height]).astype(int).tolist()
            region = slice(top, bottom), slice(left, right)
            if region not in regions:
                regions.append(region)
    return regions


def shows_lattice(image: Bytes, size: tuple[int, int]) -> bool:
    """Whether the image (H, W) may show size[0] x size[1] corners of a checkerboard.

    It takes a tenth of a second, all detectors take seconds. A corner of a board is a saddle whose
    neighbours lie opposite each other in two directions and fall where it rises. Skin, cloth,
    markers and noise have enough saddles, but few like that.
    """
    interior = (size[0] - 2) * (size[1] - 2)
    if interior < 4:
        return True
    for scale in (1.0, 0.5, 0.25):  # fine boards, blurred ones, large ones out of focus
        reduced = image
        if scale != 1.0:
            reduced = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        saddles = _find_strongest_saddles(reduced, 4 * size[0] * size[1] + 100)
        if _count_lattice_points(*saddles) >= 0.3 * interior:
            return True
    return False


def _count_lattice_points(points: NDArray[np.intp], angles: Array) -> int:
    """Count the saddles whose neighbours lie as those of a board's corner.

    points: (N, 2) px.
    angles: (N,) rad, direction in which each saddle rises.
    """
    neighbours = 8
    if len(points) <= neighbours:
        return 0
    near = np.asarray(cKDTree(points).query(points, neighbours + 1)[1])[:, 1:]
    step = (points[near] - points[:, None]).astype(float)
    length = np.linalg.norm(step, axis=-1)
    opposite = np.cos(2.0 * (angles[near] - angles[:, None])) < -0.7
    asymmetry = np.linalg.norm(step[:, :, None] + step[:, None], axis=-1)
    # A quarter of a step covers the most slanted board and noise.
    pairs = asymmetry < 0.25 * np.minimum(length[:, :, None], length[:, None])
    straight = (pairs & opposite[:, :, None] & opposite[:, None]).any(axis=2)
    unit = step / length[..., None]
    sine = np.abs(
        unit[:, :, None, 0] * unit[:, None, :, 1] - unit[:, :, None, 1] * unit[:, None, :, 0]
    )
    both = straight[:, :, None] & straight[:, None] & (sine > 0.3)
    return int(both.any(axis=(1, 2)).sum())


def _find_strongest_saddles(image: Bytes, count: int) -> tuple[NDArray[np.intp], Array]:
    """Find the `count` strongest saddles (N, 2) px, and the direction (N,) rad in which each rises.

    Strength is the Hessian's negative determinant relative to the local contrast.
    """
    smooth = cv2.GaussianBlur(image.astype(np.float32), (0, 0), 1.5)
    xx = cv2.Sobel(smooth, cv2.CV_32F, 2, 0)
    yy = cv2.Sobel(smooth, cv2.CV_32F, 0, 2)
    xy = cv2.Sobel(smooth, cv2.CV_32F, 1, 1)
    difference = cv2.absdiff(smooth, cv2.GaussianBlur(smooth, (0, 0), 12.0))
    contrast = cv2.GaussianBlur(difference, (0, 0), 12.0) + 3.0
    saddle = (xy * xy - xx * yy) / contrast**2
    peaks = (saddle > 0) & (saddle == cv2.dilate(saddle, np.ones((5, 5), np.uint8)))
    row, column = np.nonzero(peaks)
    strongest = np.argsort(-saddle[row, column], kind="stable")[:count]
    at = row[strongest], column[strongest]
    angles = 0.5 * np.arctan2(2.0 * xy[at], xx[at] - yy[at]).astype(np.float64)
    return np.stack(at[::-1], axis=-1), angles
