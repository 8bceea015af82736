"""Which places of a standing body are its head."""

from __future__ import annotations

import numpy as np

from bodyscan.fusion.regions import find_head
from bodyscan.motion.body_parts import NECK


def test_a_head_is_above_the_neck_and_near_the_middle_of_the_upper_body() -> None:
    z = np.linspace(0.0, 1700.0, 1701)
    points = np.column_stack([np.where(z < 840.0, 600.0, 50.0), np.full(1701, -30.0), z])
    # Most of what is seen are legs far ahead, which say nothing of where the upper body is.
    points = np.vstack([points, points[:840], points[:840]])
    wide, neck = 0.12 * 1700.0, NECK * 1700.0
    places = np.array(
        [
            [50.0, -30.0, neck + 1.0], [50.0, -30.0, neck - 1.0], [50.0 + wide - 1.0, -30.0, 1600.0],
            [50.0 + wide + 1.0, -30.0, 1600.0], [50.0, -31.0 - wide, 1600.0], [50.0, -30.0, 1700.0],
        ]
    )  # fmt: skip
    assert find_head(points, places).tolist() == [True, False, True, False, False, True]
