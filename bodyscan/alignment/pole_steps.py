"""A pole that was moved since the calibration, told from a person who moved while it was scanned.

Both shift pairs against each other. But all pairs of a pole that was moved are off by the same, at
once and whenever they fire, while a person moves smoothly: what pairs see within a moment of each
other hardly differs. Which of the two explains the pairs' motions better is asked of both as
Gaussian processes over time.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from bodyscan.alignment.body_motion import ARM_MM
from bodyscan.alignment.moments import of_stance
from bodyscan.alignment.sway import SwayPrior, centre_shifts
from bodyscan.arrays import Array
from bodyscan.geometry.pose_covariance import PoseCovariance
from bodyscan.geometry.transforms import RigidTransform

FEWEST = 4
"""pairs: of two or three, any may have been the one that moved."""
STEP_MM = 1.0
"""What it is said from. Less is what calibrations of poles disagree by, and alignment takes it out."""
SURE = 6.0
"""Logarithm of how many times as well a moved pole has to explain it: 400 times."""
NOISE_MM = np.geomspace(0.05, 1.0, 5)
SWAY_MM = np.geomspace(0.05, 20.0, 10)
STILL_MM = 0.4
"""What a mannequin seems to sway by, as calibrations disagree; a person who stands, by 1 to 5."""
SHARED = 0.3
"""Of a sway: what its rigid motion leaves, alike for the pairs of a pole, which see the same side."""
STEPS_MM = np.geomspace(0.5, 30.0, 8)
NEARLY = 0.5
"""Correlation of a stance with that of 0.8 s later. A pole that fired when no other did, by
that, saw a person who may have gone there meanwhile."""
ANYWHERE_MM = 100.0
"""Of all pairs together: how the whole stands is not asked."""


FREE = SwayPrior(30.0, 5.0, 1.0, 1.0)
"""How far a pole that moved may have: farther off it shares no surface with the others."""


@dataclass(frozen=True)
class PoleStep:
    """A pole, or a pair by itself, that stands off by shift_mm at the body's centre, and turned, from
    where the others and its calibration put it.  name: `pole p1`."""

    name: str
    pairs: frozenset[str]
    shift_mm: float
    turn_deg: float

    @staticmethod
    def of(name: str, pairs: frozenset[str], motions: Mapping[str, Array]) -> PoleStep:
        """Against the mean of the others."""
        own, others = (
            np.mean([twist for n, twist in motions.items() if (n in pairs) == its], axis=0)
            for its in (True, False)
        )
        shift = float(np.linalg.norm(centre_shifts((own - others)[None])[0]))
        return PoleStep(name, pairs, shift, float(np.degrees(np.linalg.norm((own - others)[:3]))))


def moving_alone(names: Sequence[str], poles: Mapping[str, str]) -> dict[str, frozenset[str]]:
    """What may have moved by itself, by what it is called: `pole p1`, `pair p1-2`.

    poles: of the pairs that stand on one."""
    groups = {f"pair {name}": frozenset([name]) for name in names}
    for pole in sorted({poles[name] for name in names if name in poles}):
        groups[f"pole {pole}"] = frozenset(name for name in names if poles.get(name) == pole)
    return groups


def find_pole_step(
    motions: Mapping[str, Array], moments_ms: Mapping[str, float | None], poles: Mapping[str, str]
) -> PoleStep | None:
    """The pole that moved by itself, or the pair, if one did.

    motions: (6,) of each pair by its name, as alignment moved it: a rotation vector about the rig's
    origin, a translation.  moments_ms: when each saw the person; of pairs whose moment is not known
    (None) nobody can tell.  poles: as in `moving_alone`.
    """
    names = [name for name in motions if moments_ms[name] is not None]
    if len(names) < FEWEST:
        return None
    twists = np.array([motions[name] for name in names])
    seen = np.hstack([centre_shifts(twists), ARM_MM * twists[:, :3]])
    seconds = 1e-3 * np.array([moments_ms[name] for name in names], float)
    stance = of_stance(seconds[:, None] - seconds)
    side = [poles.get(name, name) for name in names]
    sway = stance + SHARED**2 * np.equal.outer(side, side)
    still = _evidence(seen, SWAY_MM, sway, np.zeros((len(names),) * 2), np.zeros(1))
    found: list[tuple[float, PoleStep]] = []
    for name, pairs in moving_alone(names, poles).items():
        own = np.array([pair in pairs for pair in names])
        if not own.all() and stance[np.ix_(own, ~own)].max() > NEARLY:
            # A head or an arm that moved looks like the one pair that saw it: of those who stand.
            swayed = SWAY_MM if len(pairs) > 1 else SWAY_MM[SWAY_MM < STILL_MM]
            gain = _evidence(seen, swayed, sway, np.outer(own, own).astype(float), STEPS_MM) - still
            found.append((gain, PoleStep.of(name, pairs, {n: motions[n] for n in names})))
    if not found:
        return None
    gain, step = max(found, key=lambda one: one[0])
    lever = np.radians(step.turn_deg) * ARM_MM
    return step if gain > SURE and np.hypot(step.shift_mm, lever) > STEP_MM else None


def loosened(boards: PoseCovariance, pairs: Collection[str]) -> PoseCovariance:
    """The calibration's covariance with a pole's pairs free to move, all alike."""
    matrix, own = boards.matrix.copy(), FREE.of_one()
    places = [6 * boards.names.index(name) for name in pairs]
    for i in places:
        for j in places:
            matrix[i : i + 6, j : j + 6] += own
    return PoseCovariance(boards.names, matrix)


def motions_between(
    before: Mapping[str, RigidTransform], after: Mapping[str, RigidTransform]
) -> dict[str, Array]:
    """(6,) by which each pair was moved, rig frame."""
    return {name: (after[name] @ before[name].inverse()).twist for name in after}


def _evidence(seen: Array, sways_mm: Array, sway: Array, step: Array, steps_mm: Array) -> float:
    """Logarithm of the likelihood of motions (P, 6), at the sizes of sway, step and noise that
    explain them best."""
    size = len(sway)
    noise2, sway2, step2 = np.meshgrid(NOISE_MM**2, sways_mm**2, steps_mm**2, indexing="ij")
    covariance = (
        noise2.ravel()[:, None, None] * np.eye(size)
        + sway2.ravel()[:, None, None] * sway
        + step2.ravel()[:, None, None] * step
        + ANYWHERE_MM**2
    )
    pulls = np.linalg.solve(covariance, np.broadcast_to(seen, (len(covariance), *seen.shape)))
    fit = np.einsum("pi,kpi->k", seen, pulls)
    return float(np.max(-0.5 * fit - 0.5 * seen.shape[1] * np.linalg.slogdet(covariance)[1]))
