"""Wavefront OBJ with vertex colours ("v x y z r g b", which most programs understand)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bodyscan.arrays import Bytes, Indices
from bodyscan.export.formats import BodyFormat
from bodyscan.files.atomic import atomic_replacement
from bodyscan.mesh.body import BodyMesh


def write_obj(path: Path, mesh: BodyMesh) -> None:
    """Write a mesh in mm, rig frame: positions to 0.1 um, normals and colours to four places."""
    with atomic_replacement(Path(path)) as temporary, temporary.open("wb") as stream:
        stream.write(b"# bodyscan: mm, x the way the subject faces, z up, floor at z = 0\n")
        stream.write(b"o body\n")
        for rows in _blocks(len(mesh.vertices)):
            columns = [*mesh.vertices[rows].T, *(mesh.colours[rows].T / 255.0)]
            numbers = [part for column in columns for part in (" ", format_decimals(column, 4))]
            stream.write(join_columns(["v", *numbers, "\n"]))
        for rows in _blocks(len(mesh.normals)):
            normals = mesh.normals[rows].T
            numbers = [part for column in normals for part in (" ", format_decimals(column, 4))]
            stream.write(join_columns(["vn", *numbers, "\n"]))
        for rows in _blocks(len(mesh.faces)):
            corners = [format_integers(corner) for corner in mesh.faces[rows].T + 1]
            numbers = [part for corner in corners for part in (" ", corner, "//", corner)]
            stream.write(join_columns(["f", *numbers, "\n"]))


def _blocks(count: int, rows: int = 200_000) -> Iterator[slice]:
    return (slice(start, start + rows) for start in range(0, count, rows))


def format_decimals(values: NDArray[np.floating], decimals: int) -> Bytes:
    """Format numbers (N,) as rows of text (N, width), padded in front with zero bytes.

    Rounded to `decimals` decimals; no number is written as -0.
    """
    scaled = np.rint(values * 10.0**decimals).astype(np.int64)
    digits = _digits(np.abs(scaled), decimals + 1)
    point = digits.shape[1] - decimals
    text = [digits[:, :point], np.full((len(digits), 1), ord("."), np.uint8), digits[:, point:]]
    sign = np.where(scaled < 0, ord("-"), 0).astype(np.uint8)[:, None]
    return np.concatenate([sign, *(text if decimals else text[:1])], axis=1)


def format_integers(values: NDArray[np.integer]) -> Bytes:
    """Format non-negative integers (N,) as rows of text (N, width)."""
    return _digits(values.astype(np.int64), 1)


def join_columns(columns: Sequence[Bytes | str]) -> bytes:
    """Join columns to rows of text; a string is repeated in every row, zero bytes are left out."""
    count = next(len(column) for column in columns if not isinstance(column, str))
    parts = []
    for column in columns:
        if isinstance(column, str):
            letters = np.frombuffer(column.encode("ascii"), np.uint8)
            column = np.broadcast_to(letters, (count, letters.size))
        parts.append(column)
    text = np.concatenate(parts, axis=1).ravel()
    return text[text != 0].tobytes()


def _digits(values: Indices, min_digits: int) -> Bytes:
    """Split into digits (N, width), zero bytes for leading zeros beyond the last `min_digits`."""
    width = max(min_digits, len(str(int(values.max(initial=0)))))
    digits = np.empty((len(values), width), np.uint8)
    rest = values
    for k in range(width - 1, -1, -1):
        shown = (rest > 0) | (width - k <= min_digits)
        rest, digit = np.divmod(rest, 10)
        digits[:, k] = np.where(shown, digit + ord("0"), 0)
    return digits


FORMAT = BodyFormat(write_obj, holds=frozenset({"mesh", "colours", "normals"}))
