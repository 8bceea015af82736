"""Numbers as decimal text, many at a time."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from bodyscan.arrays import Bytes, Indices


def format_decimals(values: NDArray[np.floating], decimals: int) -> Bytes:
    """Numbers (N,) as rows of text (N, width), padded in front with zero bytes.

    Rounded to `decimals` places; no number is written as -0.
    """
    scaled = np.rint(values * 10.0**decimals).astype(np.int64)
    digits = _digits(np.abs(scaled), decimals + 1)
    point = digits.shape[1] - decimals
    text = [digits[:, :point], np.full((len(digits), 1), ord("."), np.uint8), digits[:, point:]]
    sign = np.where(scaled < 0, ord("-"), 0).astype(np.uint8)[:, None]
    return np.concatenate([sign, *(text if decimals else text[:1])], axis=1)


def format_integers(values: NDArray[np.integer]) -> Bytes:
    """Non-negative integers (N,) as rows of text (N, width)."""
    return _digits(values.astype(np.int64), 1)


def join_columns(columns: Sequence[Bytes | str]) -> bytes:
    """Rows of text from columns; a string is repeated in every row, zero bytes are left out."""
    count = next(len(column) for column in columns if not isinstance(column, str))
    parts = []
    for column in columns:
        if isinstance(column, str):
            letters = np.frombuffer(column.encode("ascii"), np.uint8)
            column = np.broadcast_to(letters, (count, letters.size))
        parts.append(column)
    text = np.concatenate(parts, axis=1).ravel()
    return text[text != 0].tobytes()


def _digits(values: Indices, fewest: int) -> Bytes:
    """Digits (N, width); zero bytes instead of leading zeros, but at least `fewest` digits."""
    width = max(fewest, len(str(int(values.max(initial=0)))))
    digits = np.empty((len(values), width), np.uint8)
    rest = values
    for place in range(width - 1, -1, -1):
        shown = (rest > 0) | (width - place <= fewest)
        rest, digit = np.divmod(rest, 10)
        digits[:, place] = np.where(shown, digit + ord("0"), 0)
    return digits
