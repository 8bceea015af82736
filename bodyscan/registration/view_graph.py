"""Who shares which board with whom (networkx), and the initial poses that follow from it."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from operator import itemgetter

import networkx as nx
import numpy as np

from bodyscan.arrays import Array
from bodyscan.calibration.board_views import LocatedView, compute_max_displacement_mm
from bodyscan.errors import RigDisconnected
from bodyscan.files.messages import describe_similar_shots
from bodyscan.geometry.transforms import RigidTransform

AGREEMENT = 0.04
"""Poses that differ by this share of the usual distance of boards agree: the graph is rough."""

Target = tuple[str, str]
Group = dict[str, RigidTransform]


@dataclass(frozen=True, eq=False)
class RelativePose:
    """The relative pose of two groups of pairs by the boards that they share."""

    first_from_second: RigidTransform
    targets: tuple[Target, ...]  # the shared targets
    agreeing: tuple[Target, ...]  # those that agree with the pose
    # Votes of the best contradicting pose, which only boards with an ambiguous numbering, or wrong
    # views, can have.
    rivals: int
    corners: int  # number of corners in the shared views
    ambiguous: bool  # whether any of the boards may be numbered in more than one way

    @property
    def votes(self) -> int:
        return len(self.agreeing)

    @property
    def decided(self) -> bool:
        """Whether the pose is settled.

        Either most boards agree on it, more than on any other pose; or three do, and no two agree
        on another: with this pose the rest turn out to fit more closely than the graph can tell, or
        to be wrong.
        """
        majority = self.votes > self.rivals and 2 * self.votes > len(self.targets)
        return majority or (self.votes >= 3 and self.rivals <= 1)

    @property
    def strength(self) -> tuple[bool, int, int]:
        """Sort key: decided ties first, then those with most corners."""
        return self.decided, min(self.votes - self.rivals, 2), self.corners


def build_view_graph(views: Iterable[LocatedView], pairs: Sequence[str]) -> nx.Graph:
    """Nodes: pairs.  Edges: pairs that saw a board at the same moment; attribute `targets`."""
    graph = nx.Graph()
    graph.add_nodes_from(pairs)
    for target, group in by_target(views).items():
        for a, b in combinations(sorted({view.pair for view in group}), 2):
            if not graph.has_edge(a, b):
                graph.add_edge(a, b, targets=[])
            graph.edges[a, b]["targets"].append(target)
    return graph


def find_initial_poses(
    views: Sequence[LocatedView], pairs: Sequence[str]
) -> tuple[dict[str, RigidTransform], dict[str, str]]:
    """Poses of the pairs in a common frame, and the pairs left out, each with the reason.

    Groups of placed pairs grow together, the best decided tie first. All boards that any pair of
    one group and any of the other saw at the same moment vote on the tie. Pairs that see the boards
    elsewhere in every shot are left out if most pairs do agree. Raises RigDisconnected, naming the
    groups and what would tie them, the shots whose board numbering leaves a tie open, or the pairs
    of which no two agree.
    """
    _refuse_disconnected(build_view_graph(views, pairs), views)
    targets, reach = by_target(views), _compute_median_distance(views)
    groups: list[Group] = [{name: RigidTransform.identity()} for name in pairs]
    ties: dict[tuple[int, int], RelativePose | None] = {}
    while len(groups) > 1:
        for i, j in combinations(range(len(groups)), 2):
            if (i, j) not in ties:
                ties[i, j] = _find_tie(groups[i], groups[j], targets, reach)
        found = {key: tie for key, tie in ties.items() if tie is not None}
        (i, j), best = max(found.items(), key=lambda item: item[1].strength)
        # Three shots that agree are a start even where others contradict them: the solve weighs views.
        if not best.decided and (best.ambiguous or best.votes < 3):
            if any(tie.ambiguous for tie in found.values()):
                raise _make_tie_error(groups[i], groups[j], best)
            return _keep_majority(groups, best)
        merged = groups[i] | {
            name: best.first_from_second @ group_from_camera
            for name, group_from_camera in groups[j].items()
        }
        kept = [k for k in range(len(groups)) if k not in (i, j)]
        ties = {
            (kept.index(p), kept.index(q)): tie
            for (p, q), tie in ties.items()
            if p in kept and q in kept
        }
        groups = [*(groups[k] for k in kept), merged]
    return groups[0], {}


def describe_unsynchronised(names: Iterable[str]) -> str:
    """The message on pairs whose views agree with those of others in too few shots."""
    return (
        f"the relative pose of {', '.join(sorted(names))} that follows from shared boards differs "
        "from shot to shot: their images were not taken together with the others', or the board "
        "moved meanwhile"
    )


def _keep_majority(groups: Sequence[Group], best: RelativePose) -> tuple[Group, dict[str, str]]:
    """The group with most pairs, if it has more than half of them; the others are left out."""
    largest = max(groups, key=len)
    others = sorted(name for group in groups if group is not largest for name in group)
    if 2 * len(largest) <= len(largest) + len(others):
        raise RigDisconnected(
            describe_unsynchronised([*largest, *others]),
            remedy="synchronise the cameras, or hold the board still until all have taken their "
            f"image (at best {best.votes} of {len(best.targets)} shots agree)",
        )
    return largest, {name: describe_unsynchronised([name]) for name in others}


def locate_boards_jointly(
    views: Sequence[LocatedView], root_from_camera: Mapping[str, RigidTransform]
) -> tuple[list[LocatedView], dict[Target, RigidTransform], set[Target]]:
    """Resolve every view's alternatives and place every board.

    Returns the views, `root_from_board` of each target, and the targets whose views disagree.
    """
    kept: list[LocatedView] = []
    boards: dict[Target, RigidTransform] = {}
    inconsistent: set[Target] = set()
    reach = _compute_median_distance(views)
    for target, group in by_target(views).items():
        root_from_board = _find_supported_pose(group, root_from_camera, reach)
        boards[target] = root_from_board
        for view in group:
            readings = _list_readings(view, root_from_camera, root_from_board, reach)
            gap, resolved = min(readings, key=itemgetter(0))
            kept.append(resolved)
            if gap > 2.0 * AGREEMENT * reach:
                inconsistent.add(target)
    return kept, boards, inconsistent


def _list_readings(
    view: LocatedView,
    root_from_camera: Mapping[str, RigidTransform],
    root_from_board: RigidTransform,
    reach: float,
) -> list[tuple[float, LocatedView]]:
    """Every numbering of a view's board, with its distance (mm) from a given pose."""
    root, limit = root_from_camera[view.pair], 0.3 * reach
    return [
        (compute_max_displacement_mm(root @ one.camera_from_board, root_from_board, limit), one)
        for one in map(view.resolve, view.alternatives)
    ]


def _find_supported_pose(
    group: Sequence[LocatedView], root_from_camera: Mapping[str, RigidTransform], reach: float
) -> RigidTransform:
    """The pose of a board that most corners of its views support."""
    candidates = [root_from_camera[view.pair] @ view.camera_from_board for view in group]

    def support(root_from_board: RigidTransform) -> int:
        return sum(
            len(view.pixels)
            for view in group
            if min(gap for gap, _ in _list_readings(view, root_from_camera, root_from_board, reach))
            < AGREEMENT * reach
        )

    return max(candidates, key=support)


def _compute_median_distance(views: Sequence[LocatedView]) -> float:
    """Typical distance of boards from cameras, mm: the unit of all agreement, because the squares of
    a board may be given in any unit."""
    distances = [float(np.linalg.norm(view.camera_from_board.translation)) for view in views]
    return float(np.median(distances)) if distances else 1.0


def by_target(views: Iterable[LocatedView]) -> dict[Target, list[LocatedView]]:
    """In the targets' order."""
    groups: dict[Target, list[LocatedView]] = defaultdict(list)
    for view in views:
        groups[view.target].append(view)
    return dict(sorted(groups.items()))


def _find_tie(
    first: Group, second: Group, targets: dict[Target, list[LocatedView]], reach: float
) -> RelativePose | None:
    """Let every target that both groups saw propose `first_from_second`; take the most agreed."""
    proposals: dict[Target, list[RigidTransform]] = {}
    corners: dict[Target, int] = {}
    ambiguous = False
    for target, views in targets.items():
        a = max((v for v in views if v.pair in first), key=_measure_size, default=None)
        b = max((v for v in views if v.pair in second), key=_measure_size, default=None)
        if a is None or b is None:
            continue
        to_board = first[a.pair] @ a.camera_from_board
        from_board = (second[b.pair] @ b.camera_from_board).inverse()
        turns = a.alternatives if a.ambiguous else b.alternatives
        proposals[target] = [to_board @ turn @ from_board for turn in turns]
        corners[target] = min(_measure_size(a), _measure_size(b))
        ambiguous |= len(turns) > 1
    if not proposals:
        return None
    everything = [p for proposal in proposals.values() for p in proposal]
    owner = np.repeat(np.arange(len(proposals)), [len(p) for p in proposals.values()])
    clearest = sorted(proposals, key=lambda target: -corners[target])[:12]
    candidates = [p for target in clearest for p in proposals[target]]
    gaps = np.array([_measure_gaps(candidate, everything, reach) for candidate in candidates])
    voters = [np.unique(owner[gap < 2.0 * AGREEMENT * reach]) for gap in gaps]
    votes = [len(targets_agreeing) for targets_agreeing in voters]
    best = int(np.argmax(votes))
    shared = tuple(proposals)
    rivals = [
        count
        for count, candidate in zip(votes, candidates, strict=True)
        if compute_max_displacement_mm(candidate, candidates[best], reach) > 4.0 * AGREEMENT * reach
    ]
    return RelativePose(
        candidates[best],
        shared,
        tuple(shared[number] for number in voters[best]),
        max(rivals, default=0),
        sum(corners.values()),
        ambiguous,
    )


def _measure_size(view: LocatedView) -> int:
    return len(view.pixels)


def _measure_gaps(
    candidate: RigidTransform, others: Sequence[RigidTransform], reach: float
) -> Array:
    """`compute_max_displacement_mm` between one transform and many others, (N,) mm."""
    rotations = np.array([other.rotation for other in others])
    shifts = np.array([other.translation for other in others]) - candidate.translation
    cosines = (np.einsum("ij,nij->n", candidate.rotation, rotations) - 1.0) / 2.0
    angles = np.arccos(np.clip(cosines, -1.0, 1.0))
    return np.linalg.norm(shifts, axis=1) + angles * reach


def _refuse_disconnected(graph: nx.Graph, views: Iterable[LocatedView]) -> None:
    groups = sorted((sorted(group) for group in nx.connected_components(graph)), key=len)
    if len(groups) > 1:
        smallest, rest = groups[0], groups[-1]
        raise RigDisconnected(
            f"no shared board view ties {', '.join(smallest)} to {', '.join(rest)}",
            remedy=describe_similar_shots((view.pair, view.shot) for view in views)
            or f"capture shots in which {smallest[0]} and {rest[0]} (or others of these two "
            "groups) see the board at the same moment",
        )


def _make_tie_error(first: Group, second: Group, tie: RelativePose) -> RigDisconnected:
    return RigDisconnected(
        f"the relative pose of {', '.join(sorted(first))} and {', '.join(sorted(second))} stays "
        "open: their shared board may be numbered from either end, and their views do not settle "
        f"which (shots {_list_shots(tie.targets)}; at best {_list_shots(tie.agreeing)} agree). "
        "Possible causes: too few shared shots, images not taken together, or shots named "
        "differently in different cameras",
        remedy="look whether these images were taken together and bear the same shots' names. "
        "Then capture one or two more shots that both see, the board tilted differently; or use a "
        "ChArUco board, or one whose columns and rows differ in parity",
    )


def _list_shots(targets: Iterable[Target]) -> str:
    """Names of the shots, the first six."""
    return ", ".join(sorted({shot for shot, _ in targets})[:6])
