"""Truth without truth: the rig placed twice, from halves of the shots, must agree with itself."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import networkx as nx
import numpy as np

from bodyscan.arrays import Array
from bodyscan.calibration.board_views import LocatedView
from bodyscan.errors import BadInput, FailedWork
from bodyscan.geometry.pose_covariance import PoseCovariance
from bodyscan.geometry.robust import rms_length
from bodyscan.geometry.transforms import RigidTransform, adjoint, twist_jacobian
from bodyscan.registration.rig_solve import RigSolution, solve_rig
from bodyscan.registration.view_graph import view_graph
from bodyscan.rig.rig import Rig
from bodyscan.rig.rig_frame import RigFrame

REACH_MM = 1300.0
"""How far ahead of a camera a pose matters: about where the subject stands."""
ATTEMPTS = 200
FEWEST_BOARDS = 3
"""Of a camera in a half: from fewer its lens and focal length do not follow."""
TIMES_WHOLE = 5.0
"""Two halves should differ by twice the sigma of the whole: either knows the rig from half as much,
and both err. Beyond this a half lacks something that holds the rig, not only shots, and says nothing
of the whole."""
RANK_SHARE = 1e-9  # eigenvalues below this share of the largest are the frame's, taken out


@dataclass(frozen=True, eq=False)
class HalvesComparison:
    """Differences between two solutions of the rig, second minus first, the common motion taken out.

    names: the pairs compared.  apart: those that are not, which saw too few boards in a half or could
    not be placed from it.  halves: the shots of each.  shifts_mm: (P, 3) of the camera centres, rig
    frame.  sigmas_mm: (P, 3) expected.
    over_expected: RMS of all differences over what the covariances promise; 1 is honest.
    """

    names: tuple[str, ...]
    apart: tuple[str, ...]
    halves: tuple[tuple[str, ...], tuple[str, ...]]
    shifts_mm: Array
    sigmas_mm: Array
    over_expected: float

    @property
    def summary(self) -> str:
        """One line."""
        shift, sigma = rms_length(self.shifts_mm), rms_length(self.sigmas_mm)
        without = f" (without {', '.join(self.apart)}, not known from a half)" if self.apart else ""
        return (
            f"solved from either half of the shots, cameras{without} differ by {shift:.3f} mm RMS "
            f"({sigma:.3f} expected); all differences are {self.over_expected:.2f} times what is "
            "expected"
        )


def compare_halves(rig: Rig, placed: RigSolution, *, seed: int = 0) -> HalvesComparison:
    """Place the rig from either half of its shots and compare, pair by pair.

    Each half's frame is held by one pair and carried to where `placed` has that pair; the common
    motion that remains is the frame's own and is taken out.  Raises FailedWork if there are fewer
    than two pairs, if no halves tie two of them together with boards enough for their cameras, or if
    halves know the rig so much worse than all shots do that nothing follows; RigDisconnected as
    `solve_rig`.
    """
    everyone = tuple(sorted(placed.rig_from_camera))
    if len(everyone) < 2:
        raise FailedWork("one pair alone has no pose to compare", where=f"rig {rig.name}")
    tied, *halves = split_shots(placed.views, everyone, seed=seed)
    holder = rig.frame_pair.name if rig.frame_pair and rig.frame_pair.name in tied else tied[0]
    first, second = (_placed_by(rig, placed, tied, shots, holder) for shots in halves)
    names = tuple(name for name in tied if name in first[0] and name in second[0])
    if len(names) < 2:
        raise _not_halved(len({view.shot for view in placed.views}))
    # (6P,): twists about the rig's origin that carry each first pose to the second.
    differences = np.concatenate(
        [(second[0][name] @ first[0][name].inverse()).twist for name in names]
    )
    centres = np.array([placed.rig_from_camera[name].translation for name in names])
    ahead = np.array([placed.rig_from_camera[name].rotation[:, 2] for name in names])
    keep = _without_common_motion(centres, ahead)
    differences = keep @ differences
    covariance = keep @ (first[1].among(names) + second[1].among(names)) @ keep.T
    known = keep @ placed.covariance.among(names) @ keep.T
    shifts = np.einsum("pij,pj->pi", twist_jacobian(centres), differences.reshape(-1, 6))
    sigmas = _centre_sigmas(covariance, centres)
    expected, whole = rms_length(sigmas), rms_length(_centre_sigmas(known, centres))
    if expected > TIMES_WHOLE * whole:
        raise FailedWork(
            f"halves of the shots should differ by {expected:.2g} mm where all shots know the rig to "
            f"{whole:.2g} mm: too few boards, or too much alike, in a half",
            remedy="capture more shots that all pairs see, differently tilted",
        )
    apart = tuple(name for name in everyone if name not in names)
    over = _over_expected(differences, covariance)
    return HalvesComparison(names, apart, (halves[0], halves[1]), shifts, sigmas, over)


def split_shots(
    views: Sequence[LocatedView], names: Sequence[str], *, seed: int = 0
) -> tuple[tuple[str, ...], tuple[str, ...], tuple[str, ...]]:
    """The pairs that two halves of the shots, drawn by chance, both tie together with boards enough
    for each; and the halves: of many draws those in which most pairs are.

    Raises FailedWork if in none two are.
    """
    shots = sorted({view.shot for view in views})
    rng = np.random.default_rng(seed)
    best: tuple[tuple[str, ...], tuple[str, ...], tuple[str, ...]] = ((), (), ())
    for _ in range(ATTEMPTS):
        order = [shots[k] for k in rng.permutation(len(shots))]
        halves = set(order[: len(order) // 2]), set(order[len(order) // 2 :])
        tied = _tied([[v for v in views if v.shot in half] for half in halves], names)
        if len(tied) > len(best[0]):
            best = tied, tuple(sorted(halves[0])), tuple(sorted(halves[1]))
        if len(tied) == len(names):
            break
    if len(best[0]) < 2:
        raise _not_halved(len(shots))
    return best


def _not_halved(shots: int) -> FailedWork:
    return FailedWork(
        f"{shots} shots cannot be halved so that both halves tie pairs together and show each "
        f"{FEWEST_BOARDS} boards",
        remedy="capture more shots that pairs of different poles see at the same moment",
    )


def _tied(halves: Sequence[Sequence[LocatedView]], names: Sequence[str]) -> tuple[str, ...]:
    """The largest group of pairs that every half ties together, with boards enough for each."""
    group = set(names)
    while True:
        left = set(group)
        for half in halves:
            boards = Counter(view.pair for view in half)
            left = {name for name in left if boards[name] >= FEWEST_BOARDS}
            graph = view_graph([view for view in half if view.pair in left], sorted(left))
            left = max(nx.connected_components(graph), key=len, default=set())
        if left == group:
            return tuple(sorted(group))
        group = left


def _placed_by(
    rig: Rig, placed: RigSolution, names: Sequence[str], shots: Sequence[str], holder: str
) -> tuple[dict[str, RigidTransform], PoseCovariance]:
    """`rig_from_camera` of these pairs from these shots alone, and its covariance, in the frame of
    `placed`; without those that disagree with the others there.

    Raises FailedWork if the holder does."""
    held = rig.model_copy(update={"rig_frame": RigFrame(pair=holder)})
    views = [view for view in placed.views if view.shot in shots and view.pair in names]
    cameras = {name: placed.cameras[name] for name in names}
    try:
        half = solve_rig(held, views, cameras, choose=False).value
    except BadInput as error:
        raise FailedWork(f"{holder} does not fit the others in a half of the shots") from error
    to_rig = placed.rig_from_camera[holder] @ half.rig_from_camera[holder].inverse()
    carry = np.kron(np.eye(len(half.covariance.names)), adjoint(to_rig))
    placings = {name: to_rig @ t for name, t in half.rig_from_camera.items()}
    # How much more than independent corners boards err is seen better on all of them.
    unseen = max(placed.excess / half.excess, 1.0)
    matrix = unseen * carry @ half.covariance.matrix @ carry.T
    return placings, PoseCovariance(half.covariance.names, matrix)


def _centre_sigmas(covariance: Array, centres: Array) -> Array:
    """(P, 3) mm of the camera centres (P, 3), from the covariance (6P, 6P) of the pairs' motions."""
    count, shown = len(centres), twist_jacobian(centres)
    own = covariance.reshape(count, 6, count, 6)[range(count), :, range(count)]
    variance = np.einsum("pii->pi", shown @ own @ shown.transpose(0, 2, 1))
    return np.sqrt(np.maximum(variance, 0.0))


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
