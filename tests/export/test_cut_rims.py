"""A head cut off along a rim that nowhere touches itself."""

from __future__ import annotations

import numpy as np

from bodyscan.export.defacing import _free_edges, _with_simple_rim


def grid(size: int) -> np.ndarray:
    """Two faces for each square of a flat grid."""
    row, column = np.divmod(np.arange(size * size), size)
    at = row * (size + 1) + column
    below, beside = at + size + 1, at + 1
    return np.concatenate(
        [np.stack([at, beside, below], 1), np.stack([beside, below + 1, below], 1)]
    )


def test_a_rim_that_touches_itself_loses_the_faces_there() -> None:
    faces = grid(6)
    square = np.tile(np.arange(36), 2)
    head = np.isin(square, [0, 1, 6, 7]) | np.isin(square, [14, 15, 20, 21])  # at one corner
    cut = _with_simple_rim(faces, head)
    assert cut.any()
    assert not (cut & ~head).any()
    corner = 2 * 7 + 2
    assert not (faces[cut] == corner).any(axis=1).any()
    starts = _free_edges(faces[cut])[:, 0]
    assert len(np.unique(starts)) == len(starts)
    # Faces that do not touch that corner stay.
    assert cut.sum() == head.sum() - np.count_nonzero((faces[head] == corner).any(axis=1))


def test_a_simple_rim_stays_as_it_is() -> None:
    faces = grid(6)
    head = np.isin(np.tile(np.arange(36), 2), [7, 8, 13, 14])
    assert np.array_equal(_with_simple_rim(faces, head), head)
    assert len(_free_edges(faces[head])) == 8
