"""What holds a rig together, where it is weak, and which further shots would help most."""

from __future__ import annotations

import networkx as nx
import numpy as np

from bodyscan.arrays import Array
from bodyscan.registration.cluster_covariance import NormalEquations, build_normal_equations
from bodyscan.registration.joint_solve import linearize_reprojection
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
    sigmas, suggestion = assess_pairs(rig, solution)
    worst = max(sorted(sigmas), key=lambda name: sigmas[name])
    lines.append(f"{worst} has the largest sigma where boards were seen: {sigmas[worst]:.3f} mm")
    return [*lines, *suggestion]


def find_articulation_shots(solution: RigSolution) -> tuple[Target, ...]:
    """Shots without which some pairs would share no view with the others."""
    graph = nx.Graph()
    graph.add_nodes_from(("pair", name) for name in solution.rig_from_camera)
    graph.add_edges_from((("pair", view.pair), ("shot", view.target)) for view in solution.views)
    return tuple(sorted(what for kind, what in nx.articulation_points(graph) if kind == "shot"))


def assess_pairs(rig: Rig, solution: RigSolution) -> tuple[dict[str, float], list[str]]:
    """Sigma of points as each pair sees them, mm across its rays, RMS over the corners it saw; and the
    shot that, repeated, reduces the largest most, in words.

    It is relative to where all pairs see them, and contains the cameras' parameters: a scan needs this.
    Cameras whose focal lengths grow as they stand back err by tenths of a mm, and harm no scan.
    """
    frame, poses = find_frame_target(rig), (solution.rig_from_camera, solution.rig_from_board)
    pair = rig.frame_pair.name if rig.frame_pair else None
    equations = build_normal_equations(
        solution.views,
        solution.cameras,
        *poses,
        fixed_pair=pair,
        fixed_target=frame,
        motions=solution.motions,
    )
    covariance = equations.system.covariance()
    scale = 2.0 * equations.variance_px2 * solution.variance_inflation
    squares = _square_derivatives(solution, equations)
    sigmas = {n: float(scale * np.sum(each * covariance)) ** 0.5 for n, each in squares.items()}
    worst = max(sorted(sigmas), key=lambda name: sigmas[name])
    # A board that holds the frame is no unknown: its part is not that of another shot there.
    visible_to = {
        target: names
        for target, views in by_target(solution.views).items()
        if len(names := sorted({view.pair for view in views})) > 1 and target != frame
    }
    if not visible_to:  # no two pairs share a shot
        return sigmas, []

    def sigma_after(target: Target, shots: int) -> float:
        """With so many more, the gain being that of corners that err independently."""
        more = equations.system + equations.sum_parts([target]) * float(shots)
        return float(scale * np.sum(squares[worst] * more.covariance())) ** 0.5

    best = min(visible_to, key=lambda target: sigma_after(target, MAX_SHOTS))
    sigma, after = sigmas[worst], [sigma_after(best, k) for k in range(1, MAX_SHOTS + 1)]
    shots = next((k for k, one in enumerate(after, start=1) if one <= sigma / 2.0), MAX_SHOTS)
    (shot, board), gain = best, after[shots - 1] / sigma
    effect = f"{sigma:.3f} to {gain * sigma:.3f} mm"
    if gain > 0.8:  # not worth taking
        return sigmas, [
            f"further shots of these boards would improve {worst} little: of all shots, {shots} more "
            f"like {shot} help most, from {effect}"
        ]
    return sigmas, [
        f"{shots} more {'shot' if shots == 1 else 'shots'} like {shot} (board {board} about there, "
        f"tilted differently each time, seen by {', '.join(visible_to[best])}) would "
        f"{'halve' if gain <= 0.5 else 'improve'} the sigma of {worst}: {effect}"
    ]


def _square_derivatives(solution: RigSolution, equations: NormalEquations) -> dict[str, Array]:
    """By pair, mean squares (P, P) of its points' derivatives, mm, by the free unknowns, less what a
    motion of the whole rig explains."""
    rows, motions, poses = [], [], (solution.rig_from_camera, solution.rig_from_board)
    for number, name in enumerate(equations.names):
        views = [view for view in solution.views if view.pair == name]
        derivatives = linearize_reprojection(views, solution.cameras, *poses)[1]()
        # A pixel's length there in mm, from the derivatives by points on the board.
        px_per_mm = np.linalg.norm(derivatives[:, -3:].reshape(-1, 6), axis=1) / np.sqrt(2.0)
        derivatives /= np.repeat(px_per_mm, 2)[:, None]
        row = np.zeros((len(derivatives), equations.prior.size))
        row[:, 6 * number : 6 * number + 6] = derivatives[:, :6]
        row[:, equations.cameras[name]] = derivatives[:, 12:-3]
        rows.append(row)
        motions.append(derivatives[:, 6:12])
    points, motion = np.concatenate(rows), np.concatenate(motions)
    points -= motion @ np.linalg.lstsq(motion, points, rcond=None)[0]
    ends = np.cumsum([len(row) for row in rows])[:-1]
    parts = zip(equations.names, np.split(points[:, equations.free], ends), strict=True)
    return {name: part.T @ part / len(part) for name, part in parts}
