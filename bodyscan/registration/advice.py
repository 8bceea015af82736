"""What holds a rig together, where it is weak, and which further shots would help most."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import networkx as nx
import numpy as np

from bodyscan.geometry.uncertainty import point_covariance, position_sigma
from bodyscan.registration.more_shots import (
    MAX_SHOTS,
    BoardCandidate,
    RigInformation,
    propose_board_poses,
)
from bodyscan.registration.normal_equations import normal_equations
from bodyscan.registration.rig_frame import frame_target
from bodyscan.registration.rig_solve import RigSolution
from bodyscan.registration.view_graph import Target, view_graph
from bodyscan.rig.rig import Rig


@dataclass(frozen=True)
class Link:
    """Two pairs that saw boards at the same moments, in so many shots.

    sigma_mm: of the second pair's position relative to the first, by all boards of the rig.
    """

    first: str
    second: str
    shots: int
    sigma_mm: float


@dataclass(frozen=True, eq=False)
class ShotSuggestion:
    """How far `shots` more of the board at `candidate` reduce the sigma of `pair`.

    between: the two pairs whose common view of it matters most.
    before_mm, after_mm: the sigma without and with them.
    halves: whether they halve it.
    """

    pair: str
    shots: int
    between: tuple[str, str]
    candidate: BoardCandidate
    before_mm: float
    after_mm: float
    halves: bool


@dataclass(frozen=True, eq=False)
class Advice:
    """What ties a rig together, and what would improve it.

    bridges: links without which the rig is disconnected.
    weak: links far less known than usual, where no other link ties their sides better.
    crucial: shots (with board) without which the rig is disconnected.
    worst, worst_sigma_mm: the pair least known in the rig frame, and its sigma over all axes.
    more: the most useful further shots; None if none would help.
    """

    bridges: tuple[Link, ...]
    weak: tuple[Link, ...]
    crucial: tuple[Target, ...]
    worst: str
    worst_sigma_mm: float
    more: ShotSuggestion | None

    @property
    def lines(self) -> list[str]:
        """The advice, for the builder of the rig."""
        lines = [
            f"{link.first} and {link.second}, with {_shots(link.shots)} in common, are the only link "
            "between two parts of the rig"
            for link in self.bridges
        ]
        if self.crucial:
            names = ", ".join(f"{shot} ({board})" for shot, board in self.crucial)
            lines.append(f"without any one of these shots the rig is disconnected: {names}")
        lines += [
            f"weak link: sigma of {link.second} relative to {link.first} is {link.sigma_mm:.3f} mm "
            f"({_shots(link.shots)} in common), and no other link between their parts is better"
            for link in self.weak
        ]
        lines.append(
            f"{self.worst} has the largest sigma in the rig frame: {self.worst_sigma_mm:.3f} mm"
        )
        return lines + ([_sentence(self.more)] if self.more else [])


def advise(rig: Rig, solution: RigSolution) -> Advice:
    """Links, weak spots and the most useful further shots of a solved rig."""
    links = find_links(solution)
    graph = view_graph(solution.views, sorted(solution.rig_from_camera))
    bridging = {frozenset(edge) for edge in nx.bridges(graph)}
    chain = minimum_spanning_links(links)
    median = float(np.median([link.sigma_mm for link in chain])) if chain else 0.0
    sigmas = {
        name: float(np.linalg.norm(position_sigma(solution.covariance, name, t.translation)))
        for name, t in solution.rig_from_camera.items()
    }
    worst = max(sorted(sigmas), key=lambda name: sigmas[name])
    # A link is weak at twice the median sigma of the chain.
    return Advice(
        tuple(link for link in links if {link.first, link.second} in bridging),
        tuple(link for link in chain if link.sigma_mm > 2.0 * median),
        find_articulation_shots(solution),
        worst,
        sigmas[worst],
        more_shots(rig, solution, worst),
    )


def find_links(solution: RigSolution) -> tuple[Link, ...]:
    """Every two pairs that share a shot, least known first."""
    found = []
    graph = view_graph(solution.views, sorted(solution.rig_from_camera))
    for first, second, targets in graph.edges(data="targets"):
        motion = solution.covariance.relative(first, second)
        covariance = point_covariance(motion, solution.rig_from_camera[second].translation)
        found.append(Link(first, second, len(targets), float(np.sqrt(np.trace(covariance)))))
    return tuple(sorted(found, key=lambda link: (-link.sigma_mm, link.first, link.second)))


def minimum_spanning_links(links: Sequence[Link]) -> tuple[Link, ...]:
    """The links that tie all pairs together best, a minimum spanning tree by sigma; least known
    first."""
    graph = nx.Graph()
    graph.add_edges_from((link.first, link.second, {"link": link, **vars(link)}) for link in links)
    tree = nx.minimum_spanning_edges(graph, weight="sigma_mm", data=True)
    return tuple(sorted((data["link"] for _, _, data in tree), key=lambda link: -link.sigma_mm))


def find_articulation_shots(solution: RigSolution) -> tuple[Target, ...]:
    """Shots without which some pairs would share no view with the others."""
    graph = nx.Graph()
    graph.add_nodes_from(("pair", name) for name in solution.rig_from_camera)
    graph.add_edges_from((("pair", view.pair), ("shot", view.target)) for view in solution.views)
    return tuple(sorted(what for kind, what in nx.articulation_points(graph) if kind == "shot"))


def more_shots(rig: Rig, solution: RigSolution, pair: str) -> ShotSuggestion | None:
    """Find the board candidate at which the fewest further shots halve the sigma of `pair`'s position.

    None if no candidate in the scan volume is seen by two pairs, or no shot would add information.
    """
    board, _ = Counter(view.board for view in solution.views).most_common(1)[0]
    candidates = propose_board_poses(
        rig.board(board), rig.volume, solution.cameras, solution.rig_from_camera
    )
    if not candidates:
        return None
    equations = normal_equations(
        solution.views,
        solution.cameras,
        solution.rig_from_camera,
        solution.rig_from_board,
        fixed_pair=rig.frame_pair.name if rig.frame_pair else None,
        fixed_target=frame_target(rig),
        cameras_free=True,
    )
    knowledge = RigInformation(equations, solution.cameras, solution.rig_from_camera)
    tried = [
        (candidate, knowledge.after(knowledge.information(candidate), pair))
        for candidate in candidates
    ]
    # Fewest shots to halve; if equal or out of reach, the largest gain.
    candidate, best = min(
        tried,
        key=lambda item: (
            item[1].shots_to_halve or MAX_SHOTS + 1,
            item[1].after_mm2[(item[1].shots_to_halve or MAX_SHOTS) - 1],
        ),
    )
    if best.after_mm2[-1] > 0.98 * best.before_mm2:
        return None
    shots = best.shots_to_halve or MAX_SHOTS
    # The sigma as boards have shown it; the gain as if corners erred independently.
    here = solution.rig_from_camera[pair].translation
    before = float(np.linalg.norm(position_sigma(solution.covariance, pair, here)))
    gained = float(np.sqrt(best.after_mm2[shots - 1] / best.before_mm2))
    return ShotSuggestion(
        pair,
        shots,
        _best_two_views(knowledge, candidate, pair, shots),
        candidate,
        before,
        gained * before,
        best.shots_to_halve is not None,
    )


def _best_two_views(
    knowledge: RigInformation, candidate: BoardCandidate, pair: str, shots: int
) -> tuple[str, str]:
    """The two pairs whose views of that board alone would add most."""

    def remaining_variance(two: tuple[str, str]) -> float:
        information = knowledge.information(candidate.restrict_to(two))
        return float(knowledge.after(information, pair, shots).after_mm2[-1])

    return min(combinations(candidate.visible_to, 2), key=remaining_variance)


def _shots(count: int) -> str:
    return "1 shot" if count == 1 else f"{count} shots"


def _sentence(more: ShotSuggestion) -> str:
    # Not worth taking: they leave more than 80 % of the sigma.
    if more.after_mm > 0.8 * more.before_mm:
        return (
            f"further shots of this board would improve {more.pair} little: {more.shots} more reduce "
            f"its sigma from {more.before_mm:.3f} to {more.after_mm:.3f} mm"
        )
    a, b = more.between
    candidate = more.candidate
    x, y, z = candidate.centre_mm
    others = [name for name in candidate.visible_to if name not in more.between]
    also = f" (also by {', '.join(others)})" if others else ""
    # x is the direction that the subject faces, y the subject's left.
    left, right = ("front", "front left", "left", "back left"), ("back", "back right", "right")
    facing = (*left, *right, "front right")[round(candidate.facing_deg / 45.0) % 8]
    effect = (
        f"would halve the sigma of {more.pair}"
        if more.halves
        else f"would improve {more.pair}, though not by half"
    )
    return (
        f"{more.shots} more {'shot' if more.shots == 1 else 'shots'} seen by both {a} and {b}{also}, "
        f"board at {candidate.height} height (middle at {x:.0f}, {y:.0f}, {z:.0f} mm, facing the "
        f"subject's {facing}, tilted in turn in all directions), {effect}: {more.before_mm:.3f} to "
        f"{more.after_mm:.3f} mm"
    )
