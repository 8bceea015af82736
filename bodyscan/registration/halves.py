"""A check without ground truth: the rig solved from either half of the shots must agree."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import networkx as nx
import numpy as np

from bodyscan.arrays import Array
from bodyscan.calibration.board_views import LocatedView
from bodyscan.errors import BadInput, FailedWork
from bodyscan.geometry.robust import rms
from bodyscan.geometry.uncertainty import PoseCovariance
from bodyscan.registration.rig_solve import RigSolution, solve_rig
from bodyscan.registration.view_graph import view_graph
from bodyscan.rig.rig import Rig
from bodyscan.rig.rig_frame import RigFrame

MIN_BOARDS = 3
"""Fewest boards per camera in a half: fewer do not determine its lens and focal length."""


@dataclass(frozen=True, eq=False)
class HalvesComparison:
    """Differences between two solutions of the rig.

    names: the pairs compared.
    excluded: pairs not compared, which saw too few boards in a half or could not be solved from it.
    shifts_mm: how far the second's position relative to the first moves, for every two pairs, (K,).
    sigmas_mm: what the covariances predict of each shift, over all axes, (K,).
    """

    names: tuple[str, ...]
    excluded: tuple[str, ...]
    shifts_mm: Array
    sigmas_mm: Array

    @property
    def over_expected(self) -> float:
        """RMS of all shifts in units of what the covariances predict; 1 if consistent."""
        return rms(self.shifts_mm / self.sigmas_mm)

    @property
    def summary(self) -> str:
        """The comparison in one line."""
        without = (
            f" (without {', '.join(self.excluded)}, not known from a half)" if self.excluded else ""
        )
        return (
            f"solved from either half of the shots, cameras{without} differ, relative to each other, "
            f"by {rms(self.shifts_mm):.3f} mm RMS ({rms(self.sigmas_mm):.3f} expected); all "
            f"differences are {self.over_expected:.2f} times what is expected"
        )


def compare_halves(rig: Rig, solution: RigSolution, *, seed: int = 0) -> HalvesComparison:
    """Solve the rig from either half of its shots and compare, for every two pairs.

    Raises FailedWork if there are fewer than two pairs, if no halves tie two of them together with
    enough boards for their cameras, or if halves determine the rig so much worse than all shots that
    nothing follows; RigDisconnected as `solve_rig`.
    """
    everyone = tuple(sorted(solution.rig_from_camera))
    if len(everyone) < 2:
        raise FailedWork("one pair alone has no pose to compare", where=f"rig {rig.name}")
    connected, *shots = split_shots(solution.views, everyone, seed=seed)
    halves = [_solve_half(rig, solution, connected, half) for half in shots]
    names = tuple(n for n in connected if all(n in half.rig_from_camera for half in halves))
    links = list(combinations(names, 2))
    if not links:
        raise _cannot_halve(len({view.shot for view in solution.views}))
    first, second = halves
    shifts = [second.relative_position(*two) - first.relative_position(*two) for two in links]
    sigmas = np.array(
        [np.hypot(first.relative_sigma_mm(*two), second.relative_sigma_mm(*two)) for two in links]
    )
    expected = rms(sigmas)
    whole = rms(np.array([solution.relative_sigma_mm(*two) for two in links]))
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
        np.linalg.norm(shifts, axis=1),
        sigmas,
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
    rig: Rig, solution: RigSolution, names: Sequence[str], shots: Sequence[str]
) -> RigSolution:
    """The solution of these pairs from these shots alone, in the frame of one of them.

    Pairs that disagree with the others there are left out. Raises FailedWork if the one that fixes
    the frame does.
    """
    frame_pair = rig.frame_pair.name if rig.frame_pair else ""
    holder = frame_pair if frame_pair in names else names[0]
    rig_with_fixed_pair = rig.model_copy(update={"rig_frame": RigFrame(pair=holder)})
    views = [view for view in solution.views if view.shot in shots and view.pair in names]
    cameras = {name: solution.cameras[name] for name in names}
    try:
        half = solve_rig(rig_with_fixed_pair, views, cameras, choose=False).value
    except BadInput as error:
        raise FailedWork(f"{holder} does not fit the others in a half of the shots") from error
    # The inflation over independent corners is better determined by all boards.
    more_inflation = max(solution.variance_inflation / half.variance_inflation, 1.0)
    matrix = more_inflation * half.covariance.matrix
    return replace(half, covariance=PoseCovariance(half.covariance.names, matrix))
