"""What holds a rig together, where it is weak, and which further shots would help most."""

from __future__ import annotations

import networkx as nx
import numpy as np

from bodyscan.geometry.transforms import twist_jacobian
from bodyscan.geometry.uncertainty import compute_position_sigma
from bodyscan.registration.cluster_covariance import build_normal_equations
from bodyscan.registration.rig_frame import find_frame_target
from bodyscan.registration.rig_solve import RigSolution
from bodyscan.registration.view_graph import Target, by_target
from bodyscan.rig.rig import Rig

MAX_SHOTS = 10
"""More are not suggested: nobody takes them."""


def advise(rig: Rig, solution: RigSolution) -> list[str]:
    """What ties a rig together, and the most useful further shots, in words."""
    lines = []
    if shots := find_articulation_shots(solution):
        names = ", ".join(f"{shot} ({board})" for shot, board in shots)
        lines.append(f"without any one of these shots the rig is disconnected: {names}")
    sigmas = {name: pair_sigma_mm(solution, name) for name in solution.rig_from_camera}
    worst = max(sorted(sigmas), key=lambda name: sigmas[name])
    lines.append(f"{worst} has the largest sigma in the rig frame: {sigmas[worst]:.3f} mm")
    return lines + suggest_shots(rig, solution, worst)


def pair_sigma_mm(solution: RigSolution, name: str) -> float:
    """Sigma of a camera's position over all axes, mm."""
    position = solution.rig_from_camera[name].translation
    return float(np.linalg.norm(compute_position_sigma(solution.covariance, name, position)))


def find_articulation_shots(solution: RigSolution) -> tuple[Target, ...]:
    """Shots without which some pairs would share no view with the others."""
    graph = nx.Graph()
    graph.add_nodes_from(("pair", name) for name in solution.rig_from_camera)
    graph.add_edges_from((("pair", view.pair), ("shot", view.target)) for view in solution.views)
    return tuple(sorted(what for kind, what in nx.articulation_points(graph) if kind == "shot"))


def suggest_shots(rig: Rig, solution: RigSolution, pair: str) -> list[str]:
    """Find the shot that, repeated, reduces the sigma of `pair`'s position most; a line that says so.

    As many repetitions as halve it, or MAX_SHOTS. No line if no two pairs share a shot.
    """
    equations = build_normal_equations(
        solution.views,
        solution.cameras,
        solution.rig_from_camera,
        solution.rig_from_board,
        fixed_pair=rig.frame_pair.name if rig.frame_pair else None,
        fixed_target=find_frame_target(rig),
        motions=solution.motions,
    )
    visible_to = {
        target: sorted({view.pair for view in views})
        for target, views in by_target(solution.views).items()
    }
    # A board that holds the frame is no unknown: its part is not that of another shot there.
    candidates = [
        t for t, pairs in visible_to.items() if len(pairs) > 1 and t != find_frame_target(rig)
    ]
    if not candidates:
        return []
    system, first = equations.system, 6 * equations.names.index(pair)
    jacobian = np.zeros((3, equations.prior.size))
    position = solution.rig_from_camera[pair].translation
    jacobian[:, first : first + 6] = twist_jacobian(position[None])[0]
    jacobian = jacobian[:, equations.free]

    def variance(target: Target, shots: int) -> float:
        """Of the pair's position with so many more, px2 of corners that err independently."""
        more = system + equations.sum_parts([target]) * float(shots)
        return float(np.trace(jacobian @ more.covariance() @ jacobian.T))

    best = min(candidates, key=lambda target: variance(target, MAX_SHOTS))
    before = variance(best, 0)
    after = [variance(best, shots) for shots in range(1, MAX_SHOTS + 1)]
    shots = next((k for k, one in enumerate(after, start=1) if one <= before / 4.0), MAX_SHOTS)
    # The sigma as boards have shown it; the gain as if corners erred independently.
    gain = float(np.sqrt(after[shots - 1] / before))
    (shot, board), sigma = best, pair_sigma_mm(solution, pair)
    effect = f"{sigma:.3f} to {gain * sigma:.3f} mm"
    if gain > 0.8:  # not worth taking
        return [
            f"further shots of these boards would improve {pair} little: of all shots, {shots} more "
            f"like {shot} help most, from {effect}"
        ]
    return [
        f"{shots} more {'shot' if shots == 1 else 'shots'} like {shot} (board {board} about there, "
        f"tilted differently each time, seen by {', '.join(visible_to[best])}) would "
        f"{'halve' if gain <= 0.5 else 'improve'} the sigma of {pair}: {effect}"
    ]
