"""The projected code and its light."""

from __future__ import annotations

import numpy as np
import pytest

from bodyscan.simulation.patterns import (
    FINE,
    PAD,
    make_light_table,
)

NO_BLUR = np.array([0.0])


def test_blur_spreads_light_and_keeps_its_sum() -> None:
    lit = np.array([True, False, True, True])
    sharp, soft = (make_light_table(lit, np.array([b]))[0] for b in (0.0, 0.25))
    assert soft.sum() == pytest.approx(sharp.sum(), rel=1e-6)
    edge = soft[(PAD + 1) * FINE - 1 : (PAD + 1) * FINE + 1].mean()
    assert edge == pytest.approx(0.5, abs=1e-3)  # half the light at a boundary, 4 sigma off others
    off = round(0.25 * FINE)  # a standard deviation outside of the first edge: 15.87 % (normal)
    assert soft[PAD * FINE - off : PAD * FINE - off + 2].mean() == pytest.approx(0.1587, abs=0.01)


def test_jitter_moves_boundaries() -> None:
    lit = np.array([False, True, True, False])
    stray = np.array([0.0, 0.1, 0.0, -0.2, 0.0])
    table = make_light_table(lit, NO_BLUR, stray)[0]
    on = np.flatnonzero(table > 0.5) / FINE - PAD
    assert on[0] == pytest.approx(1.1, abs=1 / FINE)
    assert on[-1] == pytest.approx(2.8, abs=2 / FINE)
