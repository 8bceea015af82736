"""Surface nets (Gibson 1998): the zero set of values on a sparse grid as a closed triangle mesh.

A vertex lies in every cell that the surface crosses, at the mean of the zero crossings on the
cell's edges; a quadrilateral joins the vertices of the four cells around each edge with a crossing.
If several sheets cross a cell each gets its own vertex, so that surfaces that come close do not
touch. Where two diagonally opposite corners of a cell's face are inside, which sheets meet is
ambiguous: of the two, the corner nearer to the surface is first put outside.
"""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass
from functools import cache
from itertools import product

import numpy as np
from numpy.typing import NDArray

from bodyscan.arrays import Array, Floats, Indices, Mask
from bodyscan.compiled import compiled

Numbers = NDArray[np.int32]

SIDE = 8  # nodes per side of a brick


@dataclass(frozen=True, eq=False)
class Bricks:
    """A sparse grid: B bricks of SIDE^3 nodes, kept only where they are needed.

    Values at the nodes are arrays (B, SIDE, SIDE, SIDE).
    """

    table: Numbers  # (a, b, c) int32, the number of each brick, -1 where there is none
    indices: Numbers  # (B, 3) int32, index of each brick in the table
    origin: Array  # (3,) mm, the grid's first node
    cell_mm: float  # distance from node to node

    @staticmethod
    def from_mask(wanted: Mask, origin: Array, cell_mm: float) -> Bricks:
        """Make a grid of the wanted bricks (a, b, c)."""
        indices = np.argwhere(wanted).astype(np.int32)
        table = np.full(wanted.shape, -1, np.int32)
        table[wanted] = np.arange(len(indices))
        return Bricks(table, indices, origin, cell_mm)

    @property
    def shape(self) -> tuple[int, int, int, int]:
        """Shape of an array of values."""
        return len(self.indices), SIDE, SIDE, SIDE


def split_into_bricks(dense: Floats) -> Floats:
    """Split a dense grid (SIDE a, SIDE b, SIDE c) into bricks (a b c, SIDE, SIDE, SIDE)."""
    a, b, c = (size // SIDE for size in dense.shape)
    split = dense.reshape(a, SIDE, b, SIDE, c, SIDE).transpose(0, 2, 4, 1, 3, 5)
    return np.ascontiguousarray(split).reshape(-1, SIDE, SIDE, SIDE)


def join_bricks(values: Floats, shape: tuple[int, ...]) -> Floats:
    """Invert `split_into_bricks`: dense values of all a x b x c bricks, shape (a, b, c)."""
    split = values.reshape(*shape, SIDE, SIDE, SIDE).transpose(0, 3, 1, 4, 2, 5)
    return np.ascontiguousarray(split).reshape([SIDE * size for size in shape])


def extract_surface(bricks: Bricks, values: Floats) -> tuple[Array, Indices]:
    """Extract vertices (V, 3) mm and outward faces (F, 3) of the zero set of values, negative inside.

    values: (B, SIDE, SIDE, SIDE) at the nodes. The surface is closed and manifold wherever all
        surrounding nodes are in bricks.
    """
    values = values.copy()
    while _resolve_ambiguous_faces(bricks.table, bricks.indices, values):
        pass  # terminates: nodes only ever leave the inside
    sheets, counts = tabulate_sheets()
    cases = _classify_cells(bricks.table, bricks.indices, values)
    ends = np.cumsum(counts[cases], dtype=np.int32).reshape(cases.shape)
    first, total = ends - counts[cases], int(ends.max(initial=0))
    vertices = _compute_vertices(bricks.table, bricks.indices, values, cases, first, sheets, total)
    faces = _make_faces(bricks.table, bricks.indices, cases, first, sheets, vertices)
    return bricks.origin + bricks.cell_mm * vertices, faces


@cache
def tabulate_sheets() -> tuple[NDArray[np.int8], NDArray[np.int8]]:
    """Tabulate, for each of the 256 sets of a cell's corners inside, the sheet (256, 12) that crosses
    each edge, -1 for none, and the number of sheets (256,).

    Corner x + 2 y + 4 z; edge 4 a + p + 2 q runs along axis a, at p and q on the two axes after it.
    """
    sheets, counts = np.full((256, 12), -1, np.int8), np.zeros(256, np.int8)
    for case in range(256):
        neighbours = defaultdict[int, list[int]](list)
        for axis, side in product(range(3), range(2)):
            for one, other in _find_links(case, axis, side):
                neighbours[one].append(other)
                neighbours[other].append(one)
        for first in sorted(neighbours):
            if sheets[case, first] >= 0:
                continue
            around = [first]
            while around:
                edge = around.pop()
                sheets[case, edge] = counts[case]
                around += [other for other in neighbours[edge] if sheets[case, other] < 0]
            counts[case] += 1
    return sheets, counts


def _find_links(case: int, axis: int, side: int) -> list[tuple[int, int]]:
    """Find pairs of edges that the surface joins across one face of a cell."""
    b, c = (axis + 1) % 3, (axis + 2) % 3
    around = [(0, 0), (1, 0), (1, 1), (0, 1)]
    inside = [case >> ((side << axis) + (p << b) + (q << c)) & 1 for p, q in around]
    # The edge between corners k and k + 1 of the face. Edges along b lie at (c, axis).
    edges = [4 * b + 0 + 2 * side, 4 * c + side + 2, 4 * b + 1 + 2 * side, 4 * c + side]
    crossing = [k for k in range(4) if inside[k] != inside[(k + 1) % 4]]
    return [(edges[crossing[0]], edges[crossing[1]])] if len(crossing) == 2 else []


@compiled
def _gather(table: Numbers, index: Numbers, values: Floats, block: NDArray[np.float32]) -> None:
    """Copy the values at a brick's nodes and the next ones (SIDE + 1 per side), NaN where none."""
    for i in range(SIDE + 1):
        for j in range(SIDE + 1):
            for k in range(SIDE + 1):
                a, b, c = index[0] + i // SIDE, index[1] + j // SIDE, index[2] + k // SIDE
                block[i, j, k] = np.nan
                if a < table.shape[0] and b < table.shape[1] and c < table.shape[2]:
                    number = table[a, b, c]
                    if number >= 0:
                        block[i, j, k] = values[number, i % SIDE, j % SIDE, k % SIDE]


@compiled
def _resolve_ambiguous_faces(table: Numbers, indices: Numbers, values: Floats) -> int:
    """Put one node just outside on each cell face whose corners alternate; returns how many."""
    block = np.empty((SIDE + 1, SIDE + 1, SIDE + 1), np.float32)
    steps = np.eye(3, dtype=np.int64)
    found = 0
    for brick in range(len(values)):
        if values[brick].min() >= 0.0 or values[brick].max() < 0.0:
            continue
        _gather(table, indices[brick], values, block)
        for number in range(SIDE**3):
            i, j, k = number // SIDE**2, number // SIDE % SIDE, number % SIDE
            for axis in range(3):
                b, c = steps[(axis + 1) % 3], steps[(axis + 2) % 3]
                one, two = block[i, j, k], block[i + b[0], j + b[1], k + b[2]]
                if (one < 0.0) == (two < 0.0):
                    continue
                three = block[i + c[0], j + c[1], k + c[2]]
                four = block[i + b[0] + c[0], j + b[1] + c[1], k + b[2] + c[2]]
                if (one < 0.0) != (four < 0.0) or (two < 0.0) != (three < 0.0):
                    continue
                if one < 0.0:
                    p, q, value = (0, 0, one) if one > four else (1, 1, four)
                else:
                    p, q, value = (1, 0, two) if two > three else (0, 1, three)
                x, y, z = i + p * b[0] + q * c[0], j + p * b[1] + q * c[1], k + p * b[2] + q * c[2]
                block[x, y, z] = -1e-3 * value  # outside, as a share of how far it was inside
                at = indices[brick]
                owner = table[at[0] + x // SIDE, at[1] + y // SIDE, at[2] + z // SIDE]
                values[owner, x % SIDE, y % SIDE, z % SIDE] = -1e-3 * value
                found += 1
    return found


@compiled
def _classify_cells(table: Numbers, indices: Numbers, values: Floats) -> NDArray[np.uint8]:
    """Compute the case of each cell, 0 where the surface does not cross it or a corner is unknown."""
    cases = np.zeros(values.shape, np.uint8)
    block = np.empty((SIDE + 1, SIDE + 1, SIDE + 1), np.float32)
    for brick in range(len(values)):
        _gather(table, indices[brick], values, block)
        for number in range(SIDE**3):
            i, j, k = number // SIDE**2, number // SIDE % SIDE, number % SIDE
            case, known = 0, True
            for corner in range(8):
                value = block[i + (corner & 1), j + (corner >> 1 & 1), k + (corner >> 2)]
                known &= value == value
                case |= int(value < 0.0) << corner
            if known and case < 255:
                cases[brick, i, j, k] = case
    return cases


@compiled
def _compute_vertices(
    table: Numbers,
    indices: Numbers,
    values: Floats,
    cases: NDArray[np.uint8],
    first: Numbers,
    sheets: NDArray[np.int8],
    total: int,
) -> Array:
    """Compute vertices (total, 3), in cells from the grid's first node: means of edge crossings."""
    sums, crossings = np.zeros((total, 3)), np.zeros(total)
    block = np.empty((SIDE + 1, SIDE + 1, SIDE + 1), np.float32)
    low, high = np.empty(3, np.int64), np.empty(3, np.int64)
    for brick in range(len(values)):
        if not cases[brick].any():
            continue
        _gather(table, indices[brick], values, block)
        for number in range(SIDE**3):
            i, j, k = number // SIDE**2, number // SIDE % SIDE, number % SIDE
            for edge in range(12):
                sheet = sheets[cases[brick, i, j, k], edge]
                if sheet < 0:
                    continue
                axis = edge // 4
                low[0], low[1], low[2] = i, j, k
                low[(axis + 1) % 3] += edge & 1
                low[(axis + 2) % 3] += edge >> 1 & 1
                high[0], high[1], high[2] = low[0], low[1], low[2]
                high[axis] += 1
                a, b = block[low[0], low[1], low[2]], block[high[0], high[1], high[2]]
                vertex = first[brick, i, j, k] + sheet
                for c in range(3):
                    sums[vertex, c] += SIDE * indices[brick, c] + low[c]
                sums[vertex, axis] += a / (a - b)
                crossings[vertex] += 1.0
    return sums / crossings.reshape(-1, 1)


@compiled
def _make_faces(
    table: Numbers,
    indices: Numbers,
    cases: NDArray[np.uint8],
    first: Numbers,
    sheets: NDArray[np.int8],
    vertices: Array,
) -> Indices:
    """Make faces (F, 3), two for each edge that crosses zero, split along the shorter diagonal."""
    faces, count = np.empty((6 * len(vertices) + 64, 3), np.int64), 0
    corners, cell = np.empty(4, np.int64), np.empty(3, np.int64)
    for brick in range(len(indices)):
        for number in range(SIDE**3):
            i, j, k = number // SIDE**2, number // SIDE % SIDE, number % SIDE
            case = cases[brick, i, j, k]
            for axis in range(3):
                # The edges at the cell's own first corner: every edge belongs to some cell.
                if case == 0 or (case & 1) == (case >> (1 << axis) & 1):
                    continue
                whole = True
                for turn in range(4):  # counter-clockwise about the axis
                    p, q = int(turn == 0 or turn == 3), int(turn < 2)
                    cell[0], cell[1], cell[2] = i, j, k
                    cell[(axis + 1) % 3] -= p
                    cell[(axis + 2) % 3] -= q
                    corners[turn] = _find_vertex(
                        table, indices[brick], cell, cases, first, sheets, 4 * axis + p + 2 * q
                    )
                    whole &= corners[turn] >= 0
                if not whole or count + 2 > len(faces):
                    continue
                if not case & 1:
                    corners[1], corners[3] = corners[3], corners[1]
                one, other = 0.0, 0.0
                for c in range(3):
                    one += (vertices[corners[0], c] - vertices[corners[2], c]) ** 2
                    other += (vertices[corners[1], c] - vertices[corners[3], c]) ** 2
                start = 0 if one <= other else 1
                for half in range(2):
                    faces[count, 0] = corners[start]
                    faces[count, 1] = corners[(start + 1 + half) % 4]
                    faces[count, 2] = corners[(start + 2 + half) % 4]
                    count += 1
    return faces[:count].copy()


@compiled
def _find_vertex(
    table: Numbers,
    index: Numbers,
    cell: Indices,
    cases: NDArray[np.uint8],
    first: Numbers,
    sheets: NDArray[np.int8],
    edge: int,
) -> int:
    """Find the vertex of the sheet that crosses an edge of a cell, -1 if there is none."""
    a, b, c = index[0] + cell[0] // SIDE, index[1] + cell[1] // SIDE, index[2] + cell[2] // SIDE
    if a < 0 or b < 0 or c < 0 or table[a, b, c] < 0:
        return -1
    brick, i, j, k = table[a, b, c], cell[0] % SIDE, cell[1] % SIDE, cell[2] % SIDE
    sheet = sheets[cases[brick, i, j, k], edge]
    return first[brick, i, j, k] + sheet if sheet >= 0 else -1
