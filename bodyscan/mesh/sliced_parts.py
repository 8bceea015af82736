"""The parts of a standing body in level slices, by connectivity over all heights.

Where skin touches skin a slice's outline goes round two parts. It is cut there at its neck: a chord
shorter than all chords near it, and than the parts on either side are wide along it. The pieces of all
layers, linked where they lie above each other, are a graph of the body's height (Reeb 1946). In it
legs are what the trunk divides into on its way to the floor, and arms what hangs beside them. Cuts
within one part are undone.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import cv2
import networkx as nx
import numpy as np
from scipy import ndimage

from bodyscan.arrays import Array, Floats, Indices
from bodyscan.mesh.body_frame import ARMPIT, find_body_frame
from bodyscan.mesh.slices import Loop, MeshSlicer, keep_segments

SIDES, LEGS = ("left", "right"), "left leg and right leg"
NECK, CLEFT = 0.85, 0.6
"""Longest neck, in widths of the narrower part along it: an arm pressed flat by a quarter has one; and
of one between two parts alike, such as thighs: the trunk above the crotch has a cleft."""
LAYER, HANGING, HAND, THIGH = 0.008, 0.05, 0.11, 0.43
"""Shares of the stature: distance of layers; how far at most a chin or a breast hangs down; length of
a hand, and height of a thigh surely below the crotch (Drillis and Contini 1966)."""


@dataclass(frozen=True, eq=False)
class Piece:
    """One part of a body in one slice."""

    # Trunk, head (above the neck), left leg, right leg, left arm, right arm, or other; several,
    # joined by " and ", where they touch and no neck divides them.
    part: str
    loop: Loop  # its outline, closed straight where it was cut from others
    touches: tuple[str, ...]  # the parts that it was cut from


@dataclass(frozen=True)
class Contact:
    """Two parts that touch between two heights, mm."""

    parts: tuple[str, str]
    low_mm: float
    high_mm: float


@dataclass(frozen=True, eq=False)
class BodyParts:
    """slices: by height, mm, the pieces in it, largest first."""

    slices: dict[float, tuple[Piece, ...]]
    contacts: tuple[Contact, ...]


@dataclass(eq=False)
class _Node:
    """A piece of a loop: the segments of number `label`; its part is found last."""

    height_mm: float
    loop: Loop
    labels: Indices
    label: int
    area_mm2: float
    y_mm: float
    part: str = "other"


def find_parts(slicer: MeshSlicer, heights_mm: Sequence[float] = ()) -> BodyParts:
    """Find the parts of a standing body (body frame) in slices at some heights, and in layers
    between, and where parts touch."""
    top = float(slicer.vertices[:, 2].max())
    step = LAYER * top
    heights = np.union1d(np.arange(0.5 * step, top, step), heights_mm)
    graph = _link_layers(slicer, heights)
    _name_trunk_and_legs(graph, top)
    zones = _find_hidden_arms(graph, _name_limbs(graph, top), top)
    _name_head(graph)
    layers: dict[float, list[_Node]] = {float(height): [] for height in heights}
    for node in graph:
        layers[node.height_mm].append(node)
    touching: dict[tuple[str, str], list[float]] = {}
    slices = {}
    for height, nodes in layers.items():
        for arm, low, high in zones:
            if low <= height <= high and arm not in {node.part for node in nodes}:
                _join_hidden(nodes, arm)
                touching.setdefault((arm, "trunk"), []).append(height)
        slices[height] = tuple(_join_pieces(nodes))
        for piece in slices[height]:
            for other in piece.touches:
                one, two = sorted(part.split(" and ")[0] for part in (piece.part, other))
                touching.setdefault((one, two), []).append(height)
    contacts = [
        Contact(both, float(part[0]), float(part[-1]))
        for both, at in sorted(touching.items())
        for part in np.split(np.array(at), np.flatnonzero(np.diff(at) > 3.5 * step) + 1)
    ]
    return BodyParts(slices, tuple(contacts))


def find_mesh_parts(vertices: Array, faces: Indices) -> BodyParts:
    """Find the parts of a mesh of a standing body, vertices (V, 3) in the rig frame."""
    body_from_rig = find_body_frame(vertices).rig_from_body.inverse()
    return find_parts(MeshSlicer(body_from_rig.apply(vertices), faces))


def _link_layers(slicer: MeshSlicer, heights: Array) -> nx.DiGraph[_Node]:
    """Graph of all pieces, with edges from each to those below it, and the area that they share."""
    cell_mm = 5.0
    low = slicer.vertices[:, :2].min(axis=0) - cell_mm
    shape = np.ceil((slicer.vertices[:, :2].max(axis=0) - low) / cell_mm).astype(int) + 1
    graph: nx.DiGraph[_Node] = nx.DiGraph()
    below, below_nodes = np.zeros(shape[::-1], np.int32), list[_Node]()
    for height in heights:
        canvas, nodes = np.zeros(shape[::-1], np.int32), list[_Node]()
        for loop in slicer.slice(float(height)):
            if loop.area_mm2 < 50.0:  # less: a fingertip, or a hollow
                continue
            labels = cut_at_necks(loop)
            for label in range(int(labels.max()) + 1):
                piece = loop.segments[labels == label, 0].astype(np.float32)
                area, y = cv2.contourArea(piece), piece[:, 1].mean()
                nodes.append(_Node(float(height), loop, labels, label, area, y))
                corners = np.rint((piece - low) / cell_mm).astype(np.int32)
                cv2.fillPoly(canvas, [corners], len(nodes))
        graph.add_nodes_from(nodes)
        both = canvas.astype(np.int64) * (len(below_nodes) + 1) + below
        count = np.bincount(both[(canvas > 0) & (below > 0)])
        for key in np.flatnonzero(count):
            one, other = divmod(int(key), len(below_nodes) + 1)
            here, there, area = nodes[one - 1], below_nodes[other - 1], count[key] * cell_mm**2
            if area > 0.1 * min(here.area_mm2, there.area_mm2):  # less: neighbours across a cut
                graph.add_edge(here, there, mm2=float(area))
        below, below_nodes = canvas, nodes
    return graph


def cut_at_necks(loop: Loop) -> Indices:
    """Cut a loop at all its necks: the number (N,), from 0, of the piece of each segment."""
    labels, count = np.zeros(len(loop.segments), np.int64), 0
    uncut = [np.arange(len(loop.segments))]
    while uncut:
        index = uncut.pop()
        outline = loop.segments[index, 0].astype(np.float32)
        hull = cv2.arcLength(cv2.convexHull(outline), True)
        # Without hollows there is no neck.
        neck = _find_neck(outline) if cv2.arcLength(outline, True) > 1.01 * hull else None
        if neck is None:
            labels[index] = count
            count += 1
        else:
            uncut += [index[neck[0] : neck[1]], np.delete(index, np.s_[neck[0] : neck[1]])]
    return labels


def _find_neck(outline: Floats) -> tuple[int, int] | None:
    """The points of an outline (N, 2) between which its most marked neck runs."""
    around = np.concatenate([outline, outline[:1]])
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(around, axis=0), axis=1))])
    # Points 6 mm apart: a finger's half; no more than 256 around a trunk.
    count = int(np.clip(along[-1] / 6.0, 8, 256))
    even = np.linspace(0.0, along[-1], count, endpoint=False)
    points = np.stack([np.interp(even, along, column) for column in around.T], axis=-1)
    chord = np.linalg.norm(points[:, None] - points, axis=-1)
    i, j = np.triu_indices(count, 4)
    arc = np.minimum(j - i, count - (j - i)) * along[-1] / count
    # Half a circle has a chord of 2 / pi of its arc.
    short = (chord == ndimage.minimum_filter(chord, 5, mode="wrap"))[i, j]
    short &= chord[i, j] < 2.0 / np.pi * arc
    i, j, ratio = i[short], j[short], (chord[i, j] / arc)[short]
    for k in np.argsort(ratio)[:8]:
        inner = points[i[k] : j[k] + 1]
        outer = np.concatenate([points[j[k] :], points[: i[k] + 1]])
        across = (points[j[k]] - points[i[k]]) / chord[i[k], j[k]]
        width = min(float(np.ptp(side @ across)) for side in (inner, outer))
        small, large = sorted(cv2.contourArea(side.astype(np.float32)) for side in (inner, outer))
        longest = NECK if small < 0.4 * large else CLEFT
        middle = 0.5 * (points[i[k]] + points[j[k]])
        inside = cv2.pointPolygonTest(outline, tuple(middle.tolist()), False) > 0
        if chord[i[k], j[k]] < longest * width and inside:
            first, last = np.searchsorted(along[:-1], even[[i[k], j[k]]])
            return int(first), int(last)
    return None


def _name_trunk_and_legs(graph: nx.DiGraph[_Node], top: float) -> None:
    """Follow the trunk from its largest piece up to the head, and down to where it divides in two."""
    middle = [node for node in graph if 0.55 * top < node.height_mm < 0.75 * top]
    if not middle:
        return
    lowest: dict[_Node, float] = {}
    for node in graph:  # from the lowest layer up
        lowest[node] = min([lowest[below] for below in graph.succ[node]], default=node.height_mm)
    seed = at = max(middle, key=lambda node: node.area_mm2)
    while at is not None:
        at.part = "trunk"
        at = max(graph.pred[at], key=lambda node: graph.edges[node, at]["mm2"], default=None)
    trunk, height = [seed], seed.height_mm
    while trunk:
        for node in trunk:  # lower: cloth, or thighs that touch all the way
            node.part = "trunk" if height > THIGH * top else LEGS
        below = sorted({n for at in trunk for n in graph.succ[at]}, key=lambda n: -n.area_mm2)
        # Less is a stick; where the crotch was not measured, the filling divides one leg.
        legs = [node for node in below[:2] if node.area_mm2 > 0.2 * below[0].area_mm2]
        # What ends higher up is a hand that touches a leg.
        below_each = [nx.descendants(graph, leg) | {leg} for leg in legs]
        standing = [{n for n in nodes if lowest[n] < 0.1 * top} for nodes in below_each]
        shared = set.intersection(*standing) if len(legs) == 2 else set()
        joined = max((node.height_mm for node in shared), default=0.0)
        # What joins again at once was the cleft above the crotch.
        if len(legs) == 2 and all(standing) and joined < height - 0.05 * top:
            left = legs[0].y_mm > legs[1].y_mm
            for leg, side in zip(standing, SIDES if left else SIDES[::-1], strict=True):
                for node in leg:
                    node.part = LEGS if node in shared else f"{side} leg"
            return
        trunk, height = legs, legs[0].height_mm if legs else 0.0


def _name_limbs(graph: nx.DiGraph[_Node], top: float) -> dict[str, list[list[_Node]]]:
    """Name what is left: arms, and what hangs from another part for a little. What stands on the
    floor, is as large as a trunk, or is one arm too many is something else.

    Also returns each arm's stretches that contacts leave: nodes from the lowest up."""
    rest = graph.subgraph([node for node in graph if node.part == "other"])
    trunk = [node for node in graph if node.part == "trunk"]
    axis = {node.height_mm: node.y_mm for node in trunk}
    middle = float(np.mean(list(axis.values()) or [0.0]))
    largest = max((node.area_mm2 for node in trunk), default=0.0)
    arms: dict[str, list[list[_Node]]] = {f"{side} arm": [] for side in SIDES}
    found_pieces = nx.weakly_connected_components(rest)
    components = [sorted(piece, key=lambda node: node.height_mm) for piece in found_pieces]
    for nodes in sorted(components, key=lambda nodes: nodes[0].height_mm - nodes[-1].height_mm):
        found = set(nodes)
        areas: dict[str, float] = {}
        for node in nodes:
            for one, other, mm2 in [*graph.in_edges(node, "mm2"), *graph.out_edges(node, "mm2")]:
                neighbour = other if one is node else one
                if neighbour not in found:
                    areas[neighbour.part] = areas.get(neighbour.part, 0.0) + mm2
        low, high = nodes[0].height_mm, nodes[-1].height_mm
        if areas and high - low < HANGING * top:
            part = max(areas, key=lambda name: areas[name])
        else:
            sideways = np.mean([node.y_mm - axis.get(node.height_mm, middle) for node in nodes])
            part = "left arm" if sideways > 0.0 else "right arm"
            if (
                low < 0.02 * top
                or max(node.area_mm2 for node in nodes) > 0.35 * largest
                or any(
                    min(other[-1].height_mm, high) - max(other[0].height_mm, low) > 0.2 * top
                    for other in arms[part]
                )
            ):
                continue
            arms[part].append(nodes)
        for node in nodes:
            node.part = part
    return arms


def _name_head(graph: nx.DiGraph[_Node]) -> None:
    """Name head what of the trunk is above the neck: its thinnest layer between chest and nose, at 0.76
    to 0.92 of the crown's height (a child's chin is at 0.8, an adult's at 0.87). A neck has a fifth of
    the trunk's widest layer. What has over half of it is none, as of a column."""
    trunk = [node for node in graph if node.part == "trunk"]
    crown = max((node.height_mm for node in trunk), default=0.0)
    areas: dict[float, float] = {}
    for node in trunk:
        areas[node.height_mm] = areas.get(node.height_mm, 0.0) + node.area_mm2
    between = [height for height in areas if 0.76 * crown < height < 0.92 * crown]
    neck_mm = min(between, key=lambda height: areas[height], default=crown)
    for node in trunk:
        if node.height_mm > neck_mm and areas[neck_mm] < 0.5 * max(areas.values()):
            node.part = "head"


def _find_hidden_arms(
    graph: nx.DiGraph[_Node], arms: dict[str, list[list[_Node]]], top: float
) -> list[tuple[str, float, float]]:
    """Find heights, mm, at which an arm is part of another part's outline, and no neck divides them:
    between stretches of it, from a wrist down, and up to the armpit."""
    zones = []
    for arm, found in arms.items():
        stretches, ends = sorted(found, key=lambda nodes: nodes[0].height_mm), []
        for nodes in stretches:
            low, high = nodes[0], nodes[-1]
            down = [graph.edges[low, n]["mm2"] for n in graph.succ[low] if n.part != arm]
            up = [graph.edges[n, high]["mm2"] for n in graph.pred[high] if n.part != arm]
            ends.append((sum(down) > 0.5 * low.area_mm2, sum(up) > 0.5 * high.area_mm2))
        for (lower, upper), (one, other) in zip(pairwise(stretches), pairwise(ends), strict=True):
            if one[1] and other[0] and lower[-1].height_mm < upper[0].height_mm:
                zones.append((arm, lower[-1].height_mm, upper[0].height_mm))
        if not stretches and not _may_be_raised(graph, arm, top):
            zones.append((arm, (ARMPIT - 0.36) * top, ARMPIT * top))
        if stretches and ends[0][0] and stretches[0][0].area_mm2 > 1000.0:  # a wrist; fingers end
            low_mm = stretches[0][0].height_mm
            zones.append((arm, low_mm - HAND * top, low_mm))
        if stretches and ends[-1][1] and stretches[-1][-1].height_mm < (ARMPIT - 0.02) * top:
            zones.append((arm, stretches[-1][-1].height_mm, ARMPIT * top))
    return zones


def _may_be_raised(graph: nx.DiGraph[_Node], arm: str, top: float) -> bool:
    """Whether an arm that is not seen may be raised instead of hidden by the trunk: the trunk reaches
    over 0.3 `top` to the arm's side, front or back, or there are no legs."""
    sign = 1.0 if arm.startswith(SIDES[0]) else -1.0
    trunk = [node.loop.segments for node in graph if node.part == "trunk"]
    reach = [max((sign * ends[..., 1]).max(), np.abs(ends[..., 0]).max()) for ends in trunk]
    legs = {f"{side} leg" for side in SIDES}
    return not any(node.part in legs for node in graph) or max(reach) > 0.3 * top


def _join_hidden(nodes: Iterable[_Node], arm: str) -> None:
    """Say of a slice's trunk, or else of the leg on the arm's side, that it includes the arm."""
    leg = arm.replace("arm", "leg")
    hosts = [node for node in nodes if node.part.startswith("trunk")]
    for node in hosts or [node for node in nodes if node.part == leg]:
        if arm not in node.part:
            node.part += f" and {arm}"


def _join_pieces(nodes: Sequence[_Node]) -> list[Piece]:
    """Make the pieces of a slice: what was cut within one part is joined again."""
    pieces = []
    for loop in {id(node.loop): node.loop for node in nodes}.values():
        by_label = {node.label: node for node in nodes if node.loop is loop}
        names = [by_label[label].part for label in range(len(by_label))]
        parts = list(dict.fromkeys(names))
        label = np.array([parts.index(name) for name in names])[by_label[0].labels]
        adjacent = np.unique(np.stack([label, np.roll(label, 1)]), axis=1).T
        for k, part in enumerate(parts):
            touches = tuple(parts[other] for one, other in adjacent if one == k != other)
            piece = keep_segments(loop, label == k) if len(parts) > 1 else loop
            pieces.append(Piece(part, piece, touches))
    return sorted(pieces, key=lambda piece: -piece.loop.area_mm2)
