"""Sizes that a body scanner is unlikely to have: metres or centimetres instead of millimetres."""

from __future__ import annotations

import math
from collections.abc import Iterator

from bodyscan.rig.rig import Rig

# From a hand-held scanner's board to one as large as a wall; from a hand to a car.
SQUARE_MM, VOLUME_MM, AWAY_MM = (2.0, 500.0), (50.0, 5000.0), (50.0, 20_000.0)


def odd_sizes(rig: Rig) -> Iterator[str]:
    """A question about each unusual size in a rig file."""
    for board in rig.boards:
        yield from _odd(f"board {board.name}: square_mm", board.square_mm, SQUARE_MM)
    volume = rig.volume
    yield from _odd("volume: radius_mm", volume.radius_mm, VOLUME_MM)
    yield from _odd("volume: its height", volume.top_mm - volume.bottom_mm, VOLUME_MM)
    for pair in rig.pairs:
        if pair.nominal is not None:
            away = math.dist(pair.nominal.position_mm, pair.nominal.look_at_mm)
            yield from _odd(f"pair {pair.name}: nominal, from what it looks at", away, AWAY_MM)


def _odd(what: str, value: float, usual: tuple[float, float]) -> Iterator[str]:
    low, high = usual
    if not low <= value <= high:
        yield (
            f"{what} is {value:g} mm, usual are {low:g} to {high:g}: is it in mm, as all lengths of a "
            "rig file are?"
        )
