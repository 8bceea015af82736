"""Who is tied to whom by what they share."""

from __future__ import annotations

from typing import Any

import networkx as nx
import numpy as np
import pytest

from bodyscan.alignment import overlaps
from bodyscan.alignment.matching import Matches
from bodyscan.alignment.overlaps import (
    OverlapPoints,
    find_connected_groups,
    map_overlaps,
    match_overlap,
)


def test_groups_are_what_ties_join_by_way_of_any() -> None:
    rng = np.random.default_rng(3)
    for count in range(1, 60):
        names = [f"p{k}" for k in range(rng.integers(1, 12))]
        ties = [(names[a], names[b]) for a, b in rng.integers(len(names), size=(count // 4, 2))]
        graph = nx.Graph(ties)
        graph.add_nodes_from(names)
        found = find_connected_groups(names, ties)
        assert sorted(map(sorted, found)) == sorted(map(sorted, nx.connected_components(graph)))
        assert found == sorted(found, key=lambda group: min(map(names.index, group)))


def matches(count: int) -> Matches:
    ones = np.ones(count)
    return Matches(np.zeros((count, 3)), np.zeros((count, 3)), ones, 0.4 * ones, np.arange(count))


@pytest.mark.parametrize(
    ("inner", "whole", "found"),
    [(10, 50, 10), (9, 50, 50), (9, 10, 10), (9, 9, None), (0, 0, None)],
)
def test_rims_are_asked_where_the_inner_parts_share_too_little(
    inner: int, whole: int, found: int | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What rims say is believed less: 0.3 mm more."""
    both: Any = OverlapPoints("inner", "whole")  # type: ignore[arg-type]
    counts = {"inner": inner, "whole": whole}

    def match(source: str, target: str, here: int, there: int, reach_mm: float) -> Matches:
        assert (source, here, there, reach_mm) == (target, 1, 2, 5.0)
        return matches(counts[source])

    monkeypatch.setattr(overlaps, "match_projected", match)
    here: Any = 1
    there: Any = 2
    told = match_overlap(both, both, here, there, 5.0, 10)
    assert (None if told is None else len(told.distances)) == found
    if told is not None:
        sigma = 0.4 if inner >= 10 else 0.5
        np.testing.assert_allclose(told.sigma_mm, sigma)


def test_every_two_images_are_asked_both_ways() -> None:
    found = map_overlaps(3, lambda i, j: None if (i, j) == (1, 2) else 10 * i + j)
    assert found == {(0, 1): 1, (0, 2): 2, (1, 0): 10, (2, 0): 20, (2, 1): 21}
