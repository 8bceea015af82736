"""A check without ground truth: the rig solved from either half of the shots must agree."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import networkx as nx
import numpy as np

from bodyscan.arrays import Array
from bodyscan.calibration.board_views import LocatedView
from bodyscan.errors import BadInput, FailedWork
from bodyscan.geometry.robust import rms_length
from bodyscan.geometry.transforms import RigidTransform, adjoint, twist_jacobian
from bodyscan.geometry.uncertainty import PoseCovariance
from bodyscan.registration.rig_solve import RigSolution, solve_rig
from bodyscan.registration.view_graph import view_graph
from bodyscan.rig.rig import Rig
from bodyscan.rig.rig_frame import RigFrame

MIN_BOARDS = 3
"""Fewest boards per camera in a half: fewer do not determine its lens and focal length."""


@dataclass(frozen=True, eq=False)
class HalvesComparison:
    """Differences between two solutions of the rig, second minus first, common motion removed.

    names: the pairs compared.
    excluded: pairs not compared, which saw too few boards in a half or could not be solved from it.
    shifts_mm: of the camera centres, (P, 3), rig frame.
    sigmas_mm: expected sigmas of the shifts, (P, 3).
    over_expected: RMS of all differences in units of what the covariances predict; 1 if consistent.
    """

    names: tuple[str, ...]
    excluded: tuple[str, ...]
    shifts_mm: Array
    sigmas_mm: Array
    over_expected: float

    @property
    def summary(self) -> str:
        """The comparison in one line."""
        without = (
            f" (without {', '.join(self.excluded)}, not known from a half)" if self.excluded else ""
        )
        return (
            f"solved from either half of the shots, cameras{without} differ by "
            f"{rms_length(self.shifts_mm):.3f} mm RMS ({rms_length(self.sigmas_mm):.3f} expected); "
            f"all differences are {self.over_expected:.2f} times what is expected"
        )


def compare_halves(rig: Rig, solution: RigSolution, *, seed: int = 0) -> HalvesComparison:
    """Solve the rig from either half of its shots and compare, pair by pair.

    Each half's frame is fixed by one pair and carried to where `solution` has that pair; the
    remaining common motion is the frame's own and is removed. Raises FailedWork if there are fewer
    than two pairs, if no halves tie two of them together with enough boards for their cameras, or
    if halves determine the rig so much worse than all shots that nothing follows; RigDisconnected
    as `solve_rig`.
    """
    everyone = tuple(sorted(solution.rig_from_camera))
    if len(everyone) < 2:
        raise FailedWork("one pair alone has no pose to compare", where=f"rig {rig.name}")
    connected, *halves = split_shots(solution.views, everyone, seed=seed)
    frame_pair = rig.frame_pair.name if rig.frame_pair else ""
    holder = frame_pair if frame_pair in connected else connected[0]
    (first, first_covariance), (second, second_covariance) = (
        _solve_half(rig, solution, connected, shots, holder) for shots in halves
    )
    names = tuple(name for name in connected if name in first and name in second)
    if len(names) < 2:
        raise _cannot_halve(len({view.shot for view in solution.views}))
    # (6P,): twists about the rig's origin that carry each first pose to the second.
    twists = np.concatenate([(second[name] @ first[name].inverse()).twist for name in names])
    poses = [solution.rig_from_camera[name] for name in names]
    centres = np.array([pose.translation for pose in poses])
    keep = _common_motion_projector(centres, np.array([pose.rotation[:, 2] for pose in poses]))
    differences = keep @ twists
    covariance = keep @ (first_covariance.select(names) + second_covariance.select(names)) @ keep.T
    sigmas = _centre_sigmas(covariance, centres)
    prior = keep @ solution.covariance.select(names) @ keep.T
    expected, whole = rms_length(sigmas), rms_length(_centre_sigmas(prior, centres))
    # Halves should differ by twice the sigma of the whole, since each has half of the information
    # and both err. Far beyond that a half lacks a connection of the rig, not only shots.
    if expected > 5.0 * whole:
        raise FailedWork(
            f"halves of the shots should differ by {expected:.2g} mm where all shots know the rig to "
            f"{whole:.2g} mm: too few boards, or too much alike, in a half",
            remedy="capture more shots that all pairs see, differently tilted",
        )
    return HalvesComparison(
        names,
        tuple(name for name in everyone if name not in names),
        np.einsum("pij,pj->pi", twist_jacobian(centres), differences.reshape(-1, 6)),
        sigmas,
        _normalized_rms(differences, covariance),
    )


def split_shots(
    views: Sequence[LocatedView], names: Sequence[str], *, seed: int = 0
) -> tuple[tuple[str, ...], tuple[str, ...], tuple[str, ...]]:
    """Split the shots at random into two halves that both tie as many pairs together as possible.

    Returns the pairs connected in both, with enough boards for each, and the shots of the two
    halves: the best of many draws. Raises FailedWork if no draw ties two pairs.
    """
    shots = sorted({view.shot for view in views})
    rng = np.random.default_rng(seed)
    best: tuple[tuple[str, ...], tuple[str, ...], tuple[str, ...]] = ((), (), ())
    for _ in range(200):
        order = [shots[k] for k in rng.permutation(len(shots))]
        first, second = sorted(order[: len(order) // 2]), sorted(order[len(order) // 2 :])
        connected = _largest_connected(
            [[v for v in views if v.shot in half] for half in (first, second)], names
        )
        if len(connected) > len(best[0]):
            best = connected, tuple(first), tuple(second)
        if len(connected) == len(names):
            break
    if len(best[0]) < 2:
        raise _cannot_halve(len(shots))
    return best


def _cannot_halve(shots: int) -> FailedWork:
    return FailedWork(
        f"{shots} shots cannot be halved so that both halves tie pairs together and show each "
        f"{MIN_BOARDS} boards",
        remedy="capture more shots that pairs of different poles see at the same moment",
    )


def _largest_connected(
    halves: Sequence[Sequence[LocatedView]], names: Sequence[str]
) -> tuple[str, ...]:
    """The largest group of pairs that every half ties together, with enough boards for each."""
    group = set(names)
    while True:
        left = set(group)
        for half in halves:
            boards = Counter(view.pair for view in half)
            left = {name for name in left if boards[name] >= MIN_BOARDS}
            graph = view_graph([view for view in half if view.pair in left], sorted(left))
            left = max(nx.connected_components(graph), key=len, default=set())
        if left == group:
            return tuple(sorted(group))
        group = left


def _solve_half(
    rig: Rig, solution: RigSolution, names: Sequence[str], shots: Sequence[str], holder: str
) -> tuple[dict[str, RigidTransform], PoseCovariance]:
    """`rig_from_camera` of these pairs from these shots alone, and its covariance.

    In the frame of `solution`, without pairs that disagree with the others there. Raises FailedWork
    if the holder does.
    """
    rig_with_fixed_pair = rig.model_copy(update={"rig_frame": RigFrame(pair=holder)})
    views = [view for view in solution.views if view.shot in shots and view.pair in names]
    cameras = {name: solution.cameras[name] for name in names}
    try:
        half = solve_rig(rig_with_fixed_pair, views, cameras, choose=False).value
    except BadInput as error:
        raise FailedWork(f"{holder} does not fit the others in a half of the shots") from error
    to_rig = solution.rig_from_camera[holder] @ half.rig_from_camera[holder].inverse()
    carry = np.kron(np.eye(len(half.covariance.names)), adjoint(to_rig))
    # The inflation over independent corners is better determined by all boards.
    more_inflation = max(solution.variance_inflation / half.variance_inflation, 1.0)
    matrix = more_inflation * carry @ half.covariance.matrix @ carry.T
    return (
        {name: to_rig @ pose for name, pose in half.rig_from_camera.items()},
        PoseCovariance(half.covariance.names, matrix),
    )


def _centre_sigmas(covariance: Array, centres: Array) -> Array:
    """Sigmas (P, 3) mm of camera centres (P, 3), from the covariance (6P, 6P) of their motions."""
    count, jacobian = len(centres), twist_jacobian(centres)
    blocks = covariance.reshape(count, 6, count, 6)[range(count), :, range(count)]
    variance = np.einsum("pii->pi", jacobian @ blocks @ jacobian.transpose(0, 2, 1))
    return np.sqrt(np.maximum(variance, 0.0))


def _common_motion_projector(centres: Array, ahead: Array) -> Array:
    """(6P, 6P): removes from the pairs' motions the part common to all, by least squares over each
    camera's centre and the position it looks at."""
    # 1300 mm ahead of a camera is about where the subject stands.
    points = np.concatenate([centres, centres + 1300.0 * ahead])
    jacobians = twist_jacobian(points).reshape(2, len(centres), 3, 6)
    weights = np.einsum("kpij,kpil->pjl", jacobians, jacobians)  # (P, 6, 6)
    common = np.linalg.solve(weights.sum(axis=0), np.concatenate(list(weights), axis=1))
    return np.eye(6 * len(centres)) - np.tile(common, (len(centres), 1))


def _normalized_rms(differences: Array, covariance: Array) -> float:
    """RMS of the differences in their standard deviations, with correlations."""
    scale = np.sqrt(np.maximum(np.diag(covariance), 1e-300))
    values, vectors = np.linalg.eigh(covariance / np.outer(scale, scale))
    # Smaller eigenvalues are those of the common motion, which was removed.
    known = values > 1e-9 * values[-1]
    parts = vectors[:, known].T @ (differences / scale)
    return float(np.sqrt(np.mean(parts**2 / values[known])))
