"""Surface nets (Gibson 1998): the zero set of values on a sparse grid as a closed triangle mesh.

A vertex lies in every cell that the surface passes through, at the mean of the places where the
cell's edges cross zero; a quadrilateral joins the vertices of the four cells around each edge that
crosses. If several sheets pass through a cell each gets its own vertex, so that surfaces that come
close do not touch. A cell's face whose two corners inside are diagonally opposite would leave open
which sheets meet there: of the two, the one nearer to the surface is first put outside.
"""

from __future__ import annotations

from collections import defaultdict
from functools import cache
from itertools import product

import numpy as np
from numpy.typing import NDArray

from bodyscan.arrays import Array, Floats, Indices
from bodyscan.compiled import compiled
from bodyscan.mesh.bricks import SIDE, Bricks

Numbers = NDArray[np.int32]

BARELY = 1e-3  # outside, as a share of how far the node was inside


def surface_nets(bricks: Bricks, values: Floats) -> tuple[Array, Indices]:
    """Vertices (V, 3) mm and outward faces (F, 3) of the surface where values cross zero, negative
    inside.

    values: (bricks, SIDE, SIDE, SIDE) at the nodes. The surface is closed and manifold wherever all
        surrounding nodes are in bricks.
    """
    values = values.copy()
    while _part_sheets(bricks.table, bricks.places, values):
        pass  # terminates: nodes only ever leave the inside
    parts, counts = sheets_of_cases()
    cases, first, total = _number_vertices(bricks.table, bricks.places, values, counts)
    vertices = _place_vertices(bricks.table, bricks.places, values, cases, first, parts, total)
    faces = _join(bricks.table, bricks.places, cases, first, parts, vertices)
    return bricks.origin + bricks.cell_mm * vertices, faces


@cache
def sheets_of_cases() -> tuple[NDArray[np.int8], NDArray[np.int8]]:
    """For each of the 256 combinations of a cell's corners inside: the sheet (256, 12) that crosses
    each edge, -1 for none; and the number of sheets (256,).

    Corner x + 2 y + 4 z; edge 4 a + p + 2 q runs along axis a, at p and q on the two axes after it.
    """
    parts, counts = np.full((256, 12), -1, np.int8), np.zeros(256, np.int8)
    for case in range(256):
        beside = defaultdict[int, list[int]](list)
        for axis, side in product(range(3), range(2)):
            for one, other in _links(case, axis, side):
                beside[one].append(other)
                beside[other].append(one)
        for first in sorted(beside):
            if parts[case, first] >= 0:
                continue
            around = [first]
            while around:
                edge = around.pop()
                parts[case, edge] = counts[case]
                around += [other for other in beside[edge] if parts[case, other] < 0]
            counts[case] += 1
    return parts, counts


def _links(case: int, axis: int, side: int) -> list[tuple[int, int]]:
    """Pairs of edges that the surface joins across one face of a cell."""
    b, c = (axis + 1) % 3, (axis + 2) % 3
    around = [(0, 0), (1, 0), (1, 1), (0, 1)]
    inside = [case >> ((side << axis) + (p << b) + (q << c)) & 1 for p, q in around]
    # The edge between corners k and k + 1 of the face. Edges along b lie at (c, axis).
    edges = [4 * b + 0 + 2 * side, 4 * c + side + 2, 4 * b + 1 + 2 * side, 4 * c + side]
    crossing = [k for k in range(4) if inside[k] != inside[(k + 1) % 4]]
    return [(edges[crossing[0]], edges[crossing[1]])] if len(crossing) == 2 else []


@compiled
def _gather(table: Numbers, place: Numbers, values: Floats, block: NDArray[np.float32]) -> None:
    """Values at a brick's nodes and the next ones (SIDE + 1
    per side), NaN where there is no brick."""
    for i in range(SIDE + 1):
        for j in range(SIDE + 1):
            for k in range(SIDE + 1):
                a, b, c = place[0] + i // SIDE, place[1] + j // SIDE, place[2] + k // SIDE
                block[i, j, k] = np.nan
                if a < table.shape[0] and b < table.shape[1] and c < table.shape[2]:
                    number = table[a, b, c]
                    if number >= 0:
                        block[i, j, k] = values[number, i % SIDE, j % SIDE, k % SIDE]


@compiled
def _part_sheets(table: Numbers, places: Numbers, values: Floats) -> int:
    """Put one node just outside on each face whose corners alternate; returns how many."""
    block = np.empty((SIDE + 1, SIDE + 1, SIDE + 1), np.float32)
    steps = np.eye(3, dtype=np.int64)
    found = 0
    for brick in range(len(values)):
        if values[brick].min() >= 0.0 or values[brick].max() < 0.0:
            continue
        _gather(table, places[brick], values, block)
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
                block[x, y, z] = BARELY * -value
                at = places[brick]
                owner = table[at[0] + x // SIDE, at[1] + y // SIDE, at[2] + z // SIDE]
                values[owner, x % SIDE, y % SIDE, z % SIDE] = BARELY * -value
                found += 1
    return found


@compiled
def _number_vertices(
    table: Numbers, places: Numbers, values: Floats, counts: NDArray[np.int8]
) -> tuple[NDArray[np.uint8], Numbers, int]:
    """Case and number of the first vertex of each cell, and the number of vertices."""
    cases, first = np.zeros(values.shape, np.uint8), np.zeros(values.shape, np.int32)
    block = np.empty((SIDE + 1, SIDE + 1, SIDE + 1), np.float32)
    total = 0
    for brick in range(len(values)):
        _gather(table, places[brick], values, block)
        for i in range(SIDE):
            for j in range(SIDE):
                for k in range(SIDE):
                    case, known = 0, True
                    for corner in range(8):
                        value = block[i + (corner & 1), j + (corner >> 1 & 1), k + (corner >> 2)]
                        known &= value == value
                        case |= int(value < 0.0) << corner
                    if known and 0 < case < 255:
                        cases[brick, i, j, k], first[brick, i, j, k] = case, total
                        total += counts[case]
    return cases, first, total


@compiled
def _place_vertices(
    table: Numbers,
    places: Numbers,
    values: Floats,
    cases: NDArray[np.uint8],
    first: Numbers,
    parts: NDArray[np.int8],
    total: int,
) -> Array:
    """Vertices (total, 3), in cells from the grid's first node."""
    sums, crossings = np.zeros((total, 3)), np.zeros(total)
    block = np.empty((SIDE + 1, SIDE + 1, SIDE + 1), np.float32)
    low, high = np.empty(3, np.int64), np.empty(3, np.int64)
    for brick in range(len(values)):
        if not cases[brick].any():
            continue
        _gather(table, places[brick], values, block)
        for i in range(SIDE):
            for j in range(SIDE):
                for k in range(SIDE):
                    case = cases[brick, i, j, k]
                    if case == 0:
                        continue
                    for edge in range(12):
                        part = parts[case, edge]
                        if part < 0:
                            continue
                        axis = edge // 4
                        low[0], low[1], low[2] = i, j, k
                        low[(axis + 1) % 3] += edge & 1
                        low[(axis + 2) % 3] += edge >> 1 & 1
                        high[0], high[1], high[2] = low[0], low[1], low[2]
                        high[axis] += 1
                        a, b = block[low[0], low[1], low[2]], block[high[0], high[1], high[2]]
                        vertex = first[brick, i, j, k] + part
                        for c in range(3):
                            sums[vertex, c] += SIDE * places[brick, c] + low[c]
                        sums[vertex, axis] += a / (a - b)
                        crossings[vertex] += 1.0
    return sums / crossings.reshape(-1, 1)


@compiled
def _join(
    table: Numbers,
    places: Numbers,
    cases: NDArray[np.uint8],
    first: Numbers,
    parts: NDArray[np.int8],
    vertices: Array,
) -> Indices:
    """Faces (F, 3): two for each edge that crosses zero, split along the shorter diagonal."""
    faces, count = np.empty((6 * len(vertices) + 64, 3), np.int64), 0
    corners, cell = np.empty(4, np.int64), np.empty(3, np.int64)
    for brick in range(len(places)):
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
                    corners[turn] = _vertex(
                        table, places[brick], cell, cases, first, parts, 4 * axis + p + 2 * q
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
def _vertex(
    table: Numbers,
    place: Numbers,
    cell: Indices,
    cases: NDArray[np.uint8],
    first: Numbers,
    parts: NDArray[np.int8],
    edge: int,
) -> int:
    """The vertex of the sheet that crosses an edge of a cell, counted from a brick's first one; -1
    if there is none."""
    a, b, c = place[0] + cell[0] // SIDE, place[1] + cell[1] // SIDE, place[2] + cell[2] // SIDE
    if a < 0 or b < 0 or c < 0 or table[a, b, c] < 0:
        return -1
    brick, i, j, k = table[a, b, c], cell[0] % SIDE, cell[1] % SIDE, cell[2] % SIDE
    part = parts[cases[brick, i, j, k], edge]
    return first[brick, i, j, k] + part if part >= 0 else -1
