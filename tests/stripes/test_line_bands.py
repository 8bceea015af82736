"""Boundaries wanted on some scan lines alone are those that all lines together give there."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import cKDTree
from stripe_rendering import Sequence, checkered, render_sequence

from bodyscan.arrays import Array, Bytes, Indices
from bodyscan.geometry.light_planes import Axis
from bodyscan.stripes.codes.gray import Gray
from bodyscan.stripes.decoding import decode_stripes
from bodyscan.stripes.scan_lines import LineBands
from bodyscan.stripes.stripe_map import StripeMap

STRIPES, WIDTH = 100, 16
LEFT, TOP = 37, 21
APART = 1000.0


def slanted(u: Array | Indices, v: Array | Indices) -> Array:
    return 3.3 + (v + 0.1 * u + 2.5 * np.sin(u / 23)) / 2.6


@pytest.fixture(scope="module")
def sequence() -> Sequence:
    """On a print, whose edges pull boundaries across the lines."""
    return render_sequence(slanted, stripes=STRIPES, albedo=checkered(19.0))


def read(sequence: Sequence, direction: Axis, bands: LineBands | None) -> StripeMap:
    def seen(images: Bytes) -> Bytes:
        images = images if direction == "horizontal" else np.swapaxes(images, -1, -2)
        return np.ascontiguousarray(images[..., TOP:, LEFT:])

    code = Gray.model_validate({"stripes": STRIPES, "direction": direction})
    coded = np.concatenate([sequence.patterns, sequence.inverses])
    return decode_stripes(
        code, seen(sequence.lit), seen(sequence.dark), seen(coded), bands=bands
    )  # fmt: skip


@pytest.mark.parametrize("direction", ["horizontal", "vertical"])
@pytest.mark.parametrize("turn", [0, 5])
def test_boundaries_in_bands_are_those_of_the_whole_picture(
    sequence: Sequence, direction: Axis, turn: int
) -> None:
    bands = LineBands(WIDTH, 3, turn, (TOP, LEFT))
    some, every = read(sequence, direction, bands), read(sequence, direction, None)
    along, start = (0, LEFT) if direction == "horizontal" else (1, TOP)
    band = np.floor((every.boundary_pixels[:, along] + start) / WIDTH)
    # One at a band's very end may fall in or out.
    assert abs(len(some.boundary_index) - np.count_nonzero(band % 3 == turn % 3)) <= 3
    places = [np.column_stack([APART * m.boundary_index, m.boundary_pixels]) for m in (every, some)]
    off, nearest = map(np.asarray, cKDTree(places[0]).query(places[1]))
    # Blur is told from fewer edges: where brightness changes it moves boundaries, by far less than they
    # may be off.
    assert off.max() < 0.03
    assert np.sqrt(np.mean(off**2)) < 0.1 * np.median(every.boundary_sigma_px)
    own = (places[1][:, 1 + along] + start) // WIDTH
    assert set((own % 3).tolist()) == {turn % 3}
    assert len(np.unique(nearest)) == len(nearest)
    assert not some.s.size
