"""A board as made: its print, square by square, and the sheet to which it is glued."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from bodyscan.arrays import Array, Floats, Mask
from bodyscan.errors import BadInput
from bodyscan.rig.board import Board
from bodyscan.simulation.scene import Surface, build_grid_surface, list_grid_triangles
from bodyscan.simulation.settings import BoardMaking


@dataclass(frozen=True, eq=False)
class BoardPrint:
    """Squares (and markers in them) evaluated where a ray hits, so that edges are exact.

    cells: (rows + 2, columns + 2, k, k) albedo, with a rim of blank squares all around. The middle
        of a square, `inner_mm` wide, is divided into (k - 2)^2 modules; entries 0 and k - 1
        surround them.
    """

    square_mm: float
    inner_mm: float
    cells: Floats

    def albedo(self, positions: Floats) -> Floats:
        """Look up albedo (N,) at positions (N, 2) mm, from the first square's outer corner."""
        rows, columns, modules, _ = self.cells.shape
        column, i = self._cell(positions[:, 0], columns, modules)
        row, j = self._cell(positions[:, 1], rows, modules)
        return self.cells[row, column, j, i]

    def _cell(
        self, position: Floats, squares: int, modules: int
    ) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Compute the number of the square along one side, and of the module inside it."""
        number = np.floor(position / np.float32(self.square_mm))
        inside = position - number * np.float32(self.square_mm)
        start = (self.square_mm - self.inner_mm) / 2.0
        module = np.floor((inside - np.float32(start)) * np.float32((modules - 2) / self.inner_mm))
        return (
            np.clip(number + 1, 0, squares - 1).astype(np.intp),
            np.clip(module + 1, 0, modules - 1).astype(np.intp),
        )


def make_print(board: Board, face: int, making: BoardMaking) -> BoardPrint:
    """Draw the print of face 0 (front) or 1 (back); the back's markers follow the front's."""
    if board.kind == "aprilgrid":
        raise BadInput("boards of kind aprilgrid are not simulated", where=f"board {board.name}")
    row, column = np.indices((board.rows, board.columns))
    swapped = board.kind == "charuco" and board.legacy_layout and board.rows % 2 == 0
    dark = (row + column) % 2 == (1 if swapped else 0)
    markers = _find_markers(board, face, int((~dark).sum())) if board.kind == "charuco" else None
    modules = 3 if markers is None else markers.shape[1] + 2
    cells = np.zeros((board.rows + 2, board.columns + 2, modules, modules), bool)
    cells[1:-1, 1:-1] = dark[:, :, None, None]
    if markers is not None:
        row, column = np.nonzero(~dark)
        cells[row + 1, column + 1, 1:-1, 1:-1] = markers
    albedo = np.where(cells, making.black, making.white).astype(np.float32)
    return BoardPrint(board.square_mm, board.marker_mm or 0.5 * board.square_mm, albedo)


def _find_markers(board: Board, face: int, count: int) -> Mask:
    """Look up dark modules (count, m, m) of the markers on one face, borders included."""
    if not hasattr(cv2.aruco, board.dictionary):
        raise BadInput(f"OpenCV has no marker dictionary {board.dictionary}", where=board.name)
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, board.dictionary))
    first = board.first_marker + face * count
    if first + count > len(dictionary.bytesList):
        raise BadInput(
            f"{board.dictionary} has {len(dictionary.bytesList)} markers, "
            f"face {face} needs up to {first + count}",
            where=board.name,
        )
    size = dictionary.markerSize + 2
    ids = range(first, first + count)
    return np.stack([dictionary.generateImageMarker(i, size) < 128 for i in ids])


@dataclass(frozen=True, eq=False)
class MadeBoard:
    """A board with its errors."""

    surfaces: tuple[Surface, ...]  # in the board frame
    # (faces * N, 3), the true positions of the printed inner corners, board frame, numbered as in
    # the rig file's board (front, then back).
    corners: Array


def make_board(board: Board, making: BoardMaking, rng: np.random.Generator) -> MadeBoard:
    """Make the board of the rig file with errors of manufacture."""
    width, height = board.size_mm
    surfaces, corners = [], []
    sheet = _draw_sheet(making, rng)
    for face in range(board.faces):
        error = _print_error(board, making, rng)
        positions = _space_mesh_positions(
            board, flat=not sheet.any() and making.print_error_mm == 0
        )
        vertices = _map_to_sheet(positions.reshape(-1, 2), board, face, error, sheet)
        triangles = list_grid_triangles(positions.shape[1] - 1, positions.shape[0] - 1)
        printed = make_print(board, face, making)
        on_print = positions.reshape(-1, 2)
        surfaces.append(
            Surface(
                vertices, triangles, printed=printed.albedo, print_xy=on_print, open_to_light=True
            )
        )
        c, r = np.meshgrid(np.arange(1, board.columns), np.arange(1, board.rows))
        inner = np.stack([c.ravel(), r.ravel()], axis=1).astype(float) * board.square_mm
        corners.append(_map_to_sheet(inner, board, face, error, sheet))
    surfaces += _build_sides(board, width, height, making)
    return MadeBoard(tuple(surfaces), np.concatenate(corners))


def _space_mesh_positions(board: Board, flat: bool) -> Array:
    """Space mesh vertices on the print, (rows, columns, 2) mm, margin included; 4 cells a square."""

    def line(squares: int) -> Array:
        size = squares * board.square_mm
        inner = np.linspace(0.0, size, squares * 4 + 1)[1:-1]
        edges = [-board.margin_mm, 0.0] if board.margin_mm > 0 else [0.0]
        ends = [size, size + board.margin_mm] if board.margin_mm > 0 else [size]
        whole = np.concatenate([edges, inner, ends])
        return whole[[0, -1]] if flat else whole

    return np.stack(np.meshgrid(line(board.columns), line(board.rows)), axis=-1)


def _draw_sheet(making: BoardMaking, rng: np.random.Generator) -> Array:
    """Draw the shape (4,), mm, of the sheet to which a print is glued: a bowl, a bend along each
    side, and a twist; the range of height of the last three log-uniform in `warp_mm`."""
    sheet = np.array([making.bow_mm, 0.0, 0.0, 0.0])
    low, high = making.warp_mm
    if high > 0:
        size = float(np.exp(rng.uniform(*np.log([max(low, 1e-3), high]))))
        shape = np.append(0.0, rng.standard_normal(3))
        heights = _compute_height(
            shape, *np.meshgrid(np.linspace(-0.5, 0.5, 21), np.linspace(-0.5, 0.5, 21))
        )
        sheet += size / float(np.ptp(heights)) * shape
    return sheet


def _compute_height(sheet: Array, across: Array, down: Array) -> Array:
    """Compute the height towards the front, at positions from -1/2 to 1/2 along each side."""
    bowl = sheet[0] * (1.0 - 2.0 * (across**2 + down**2))
    return bowl + sheet[1] * across**2 + sheet[2] * down**2 + sheet[3] * across * down


def _map_to_sheet(positions: Array, board: Board, face: int, error: Array, sheet: Array) -> Array:
    """Map positions on the print (N, 2) to the board frame (N, 3): print error, flip, bow."""
    square = board.square_mm
    grid = np.clip(positions / square, 0.0, [board.columns, board.rows])[:, ::-1].T
    printed = positions + np.stack([map_coordinates(e, grid, order=1) for e in error], axis=1)
    x, y = printed[:, 0], printed[:, 1]
    if face == 1:
        x = board.columns * square - x
    across, down = x / (board.columns * square) - 0.5, y / (board.rows * square) - 0.5
    height = _compute_height(sheet, across, down)
    return np.stack([x, y, face * board.thickness_mm - height], axis=1)


def _print_error(board: Board, making: BoardMaking, rng: np.random.Generator) -> Array:
    """Draw the printing error (2, rows + 1, columns + 1), mm, of each corner of a square."""
    shape = (2, board.rows + 1, board.columns + 1)
    if making.print_error_mm == 0:
        return np.zeros(shape)
    row, column = np.indices(shape[1:]) / max(shape[1:])
    waves = np.zeros(shape)
    for _ in range(6):
        turn = rng.uniform(0.0, 2.0 * np.pi, 2)
        fx, fy = rng.normal(0.0, 3.0, 2)
        waves += np.cos(fx * column + fy * row + turn[:, None, None])
    return waves * making.print_error_mm / np.sqrt(3.0)


def _build_sides(board: Board, width: float, height: float, making: BoardMaking) -> list[Surface]:
    """Build the sheet's edges, and its blank back if only one face is printed."""
    m, depth = board.margin_mm, np.array([0.0, 0.0, board.thickness_mm])
    x, y = np.array([width + 2 * m, 0.0, 0.0]), np.array([0.0, height + 2 * m, 0.0])
    start = np.array([-m, -m, 0.0])
    patches = []
    if board.thickness_mm > 0:
        patches = [(start, x, depth), (start, y, depth)]
        patches += [(start + y, x, depth), (start + x, y, depth)]
    if board.faces == 1:
        patches.append((start + depth + np.array([0.0, 0.0, 0.05]), x, y))
    return [build_grid_surface(*patch, albedo=making.side) for patch in patches]
