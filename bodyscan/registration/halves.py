"""Truth without truth: the rig placed twice, from halves of the shots, must agree with itself."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import networkx as nx
import numpy as np

from bodyscan.arrays import Array
from bodyscan.calibration.board_views import LocatedView
from bodyscan.errors import FailedWork
from bodyscan.geometry.transforms import RigidTransform, adjoint, twist_jacobian
from bodyscan.registration.rig_solve import RigSolution, solve_rig
from bodyscan.registration.view_graph import view_graph
from bodyscan.rig.rig import Rig
from bodyscan.rig.rig_frame import RigFrame

REACH_MM = 1300.0
"""How far ahead of a camera a pose matters: about where the subject stands."""
ATTEMPTS = 200
RANK_SHARE = 1e-9  # eigenvalues below this share of the largest are the frame's, taken out


@dataclass(frozen=True, eq=False)
class HalvesComparison:
    """Differences between two solutions of the rig, second minus first, the common motion taken out.

    halves: the shots of each.  shifts_mm: (P, 3) of the camera centres, rig frame.  sigmas_mm:
    (P, 3) expected.
    over_expected: RMS of all differences over what the covariances promise; 1 is honest.
    """

    names: tuple[str, ...]
    halves: tuple[tuple[str, ...], tuple[str, ...]]
    shifts_mm: Array
    sigmas_mm: Array
    over_expected: float

    @property
    def summary(self) -> str:
        """One line."""
        shift, sigma = (
            np.sqrt((values**2).sum(axis=1).mean()) for values in (self.shifts_mm, self.sigmas_mm)
        )
        return (
            f"solved from either half of the shots, cameras differ by {shift:.3f} mm RMS "
            f"({sigma:.3f} expected); all differences are {self.over_expected:.2f} times what is "
            "expected"
        )


def compare_halves(rig: Rig, placed: RigSolution, *, seed: int = 0) -> HalvesComparison:
    """Place the rig from either half of its shots and compare, pair by pair.

    Each half's frame is held by one pair and carried to where `placed` has that pair; the common
    motion that remains is the frame's own and is taken out.  Raises FailedWork if there are fewer
    than two pairs or no way to halve the shots leaves both halves connected.
    """
    names = tuple(sorted(placed.rig_from_camera))
    if len(names) < 2:
        raise FailedWork("one pair alone has no pose to compare", where=f"rig {rig.name}")
    halves = split_shots(placed.views, names, seed=seed)
    holder = rig.frame_pair.name if rig.frame_pair else names[0]
    first, second = (_placed_by(rig, placed, shots, holder) for shots in halves)
    # (6P,): twists about the rig's origin that carry each first pose to the second.
    differences = np.concatenate(
        [(second[0][name] @ first[0][name].inverse()).twist for name in names]
    )
    covariance = first[1] + second[1]
    centres = np.array([placed.rig_from_camera[name].translation for name in names])
    ahead = np.array([placed.rig_from_camera[name].rotation[:, 2] for name in names])
    keep = _without_common_motion(centres, ahead)
    differences, covariance = keep @ differences, keep @ covariance @ keep.T
    shown = twist_jacobian(centres)
    own = covariance.reshape(len(names), 6, len(names), 6)[range(len(names)), :, range(len(names))]
    shifts = np.einsum("pij,pj->pi", shown, differences.reshape(-1, 6))
    spread = np.einsum("pii->pi", shown @ own @ shown.transpose(0, 2, 1))
    return HalvesComparison(
        names,
        halves,
        shifts,
        np.sqrt(np.maximum(spread, 0.0)),
        _over_expected(differences, covariance),
    )


def split_shots(
    views: Sequence[LocatedView], names: Sequence[str], *, seed: int = 0
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Two halves of the shots, by chance, in each of which shared views tie all pairs together.

    Raises FailedWork if none of many draws does.
    """
    shots = sorted({view.shot for view in views})
    rng = np.random.default_rng(seed)
    for _ in range(ATTEMPTS):
        order = [shots[k] for k in rng.permutation(len(shots))]
        halves = order[: len(order) // 2], order[len(order) // 2 :]
        if all(_connected(views, names, set(half)) for half in halves):
            return tuple(sorted(halves[0])), tuple(sorted(halves[1]))
    raise FailedWork(
        f"{len(shots)} shots cannot be halved so that both halves tie all pairs together "
        f"({ATTEMPTS} draws)",
        remedy="capture more shots that pairs of different poles see at the same moment",
    )


def _connected(views: Sequence[LocatedView], names: Sequence[str], shots: set[str]) -> bool:
    own = [view for view in views if view.shot in shots]
    return bool(own) and nx.is_connected(view_graph(own, names))


def _placed_by(
    rig: Rig, placed: RigSolution, shots: Sequence[str], holder: str
) -> tuple[dict[str, RigidTransform], Array]:
    """`rig_from_camera` from these shots alone and its covariance, in the frame of `placed`."""
    held = rig.model_copy(update={"rig_frame": RigFrame(pair=holder)})
    views = [view for view in placed.views if view.shot in shots]
    half = solve_rig(held, views, placed.cameras).value
    to_rig = placed.rig_from_camera[holder] @ half.rig_from_camera[holder].inverse()
    carry = np.kron(np.eye(len(half.covariance.names)), adjoint(to_rig))
    placings = {name: to_rig @ t for name, t in half.rig_from_camera.items()}
    return placings, carry @ half.covariance.matrix @ carry.T


def _without_common_motion(centres: Array, ahead: Array) -> Array:
    """(6P, 6P): takes from all pairs' motions the one that moves them alike, least squares over
    each camera's centre and the place it looks at."""
    points = np.concatenate([centres, centres + REACH_MM * ahead])
    own = twist_jacobian(points).reshape(2, len(centres), 3, 6)
    weights = np.einsum("kpij,kpil->pjl", own, own)  # (P, 6, 6)
    common = np.linalg.solve(weights.sum(axis=0), np.concatenate(list(weights), axis=1))
    return np.eye(6 * len(centres)) - np.tile(common, (len(centres), 1))


def _over_expected(differences: Array, covariance: Array) -> float:
    """RMS of the differences in units of their standard deviations, correlations and all."""
    scale = np.sqrt(np.maximum(np.diag(covariance), 1e-300))
    values, vectors = np.linalg.eigh(covariance / np.outer(scale, scale))
    known = values > RANK_SHARE * values[-1]
    parts = vectors[:, known].T @ (differences / scale)
    return float(np.sqrt(np.mean(parts**2 / values[known])))
