"""Who is tied to whom by what they share."""

from __future__ import annotations

import networkx as nx
import numpy as np

from bodyscan.alignment.overlaps import tied_groups


def test_groups_are_what_ties_join_by_way_of_any() -> None:
    rng = np.random.default_rng(3)
    for count in range(1, 60):
        names = [f"p{k}" for k in range(rng.integers(1, 12))]
        ties = [(names[a], names[b]) for a, b in rng.integers(len(names), size=(count // 4, 2))]
        graph = nx.Graph(ties)
        graph.add_nodes_from(names)
        found = tied_groups(names, ties)
        assert sorted(map(sorted, found)) == sorted(map(sorted, nx.connected_components(graph)))
        assert found == sorted(found, key=lambda group: min(map(names.index, group)))
