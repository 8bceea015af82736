"""What the overlap of two pairs says of a cell, and how much of it is believed."""

from __future__ import annotations

import numpy as np

from bodyscan.alignment.cell_evidence import CellEvidence


def test_no_number_of_matches_makes_calibrations_straight() -> None:
    """Few matches count as they are; of very many a cell's shift is known to what it is doubted by, and
    where it lies is the same."""
    along = np.zeros((2, 12, 12))
    along[:, 0, 0] = 1.0, 1e6  # to 1 mm, and to a thousandth
    seen = CellEvidence(np.array([3, 7]), along, along[:, 0] * 0.5)
    doubted = seen.doubted(0.07)
    np.testing.assert_allclose(doubted.information[:, 0, 0] ** -0.5, np.hypot([1.0, 1e-3], 0.07))
    np.testing.assert_allclose(doubted.gradient[:, 0], 0.5 * doubted.information[:, 0, 0])
