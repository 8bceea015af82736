"""A pole that was moved since the calibration, told from a person who moved while it was scanned.

Both shift pairs relative to each other. But all pairs of a moved pole are off by the same amount,
whenever they fire, while a person moves smoothly: what pairs see within a moment of each other
hardly differs. Both explanations are compared as Gaussian processes over time.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import block_diag

from bodyscan.alignment.body_motion import ARM_MM
from bodyscan.alignment.moments import of_stance
from bodyscan.alignment.sway_prior import SwayPrior, centre_shifts
from bodyscan.arrays import Array
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.geometry.uncertainty import PoseCovariance

FEWEST = 4
"""pairs: with two or three, any could be the one that moved."""
STEP_MM = 1.0
"""Smallest step reported. Calibrations of poles disagree by less, and alignment corrects it."""
SURE = 6.0
"""Log of the likelihood ratio that a moved pole must reach: 400 times."""
NOISE_MM = np.geomspace(0.05, 5.0, 9)
SWAY_MM = np.geomspace(0.05, 20.0, 10)
STILL_MM = 0.4
"""Apparent sway of a mannequin, because calibrations disagree; a standing person's is 1 to 5."""
SHARED, SHARED_MM = 0.6, 0.9
"""Residual of the sway beyond rigid motion, relative to it and at most in mm; it is shared by the
pairs of a pole, which see one side. A side breathes by some 2 mm, and arms move by themselves: of
ten sound standing people half had a pole off by 1.5 to 4 mm, more than 0.3 of their sway can be."""
STEPS_MM = np.geomspace(0.5, 30.0, 8)
NEARLY = 0.5
"""Correlation of a stance with itself 0.8 s later. If a pole fired at no other pole's time, by this
measure, the person may have moved there meanwhile."""
TOLD_SIGMAS = 8.0
"""A shift of x sigmas in one direction has a log likelihood ratio of x^2 / 2 - 3 log(1 + x^2): SURE
is reached at 5.8, and two more keep chance from hiding it."""
SEVERAL = 3
"""scans: with this many, what is alike in all of them is not sway, whenever pairs fire."""
ANYWHERE_MM = 100.0
"""Prior of a common motion of all pairs, which is not of interest."""


FREE = SwayPrior(30.0, 5.0, 1.0, 1.0)
"""How far a moved pole may have moved: farther off it shares no surface with the others."""


@dataclass(frozen=True)
class PoleStep:
    """A pole, or a pair by itself, that stands off from the others and its calibration.

    name: `pole p1` or `pair p1-2`.
    shift_mm, turn_deg: by how much, at the body's centre.
    all_moved: whether each of the others has a step of its own, so that none is where it was.
    """

    name: str
    pairs: frozenset[str]
    shift_mm: float
    turn_deg: float
    all_moved: bool = False

    @staticmethod
    def of(name: str, pairs: frozenset[str], motions: Mapping[str, Array]) -> PoleStep:
        """The step against the mean of the others."""
        own, others = (
            np.mean([twist for n, twist in motions.items() if (n in pairs) == its], axis=0)
            for its in (True, False)
        )
        shift = float(np.linalg.norm(centre_shifts((own - others)[None])[0]))
        return PoleStep(name, pairs, shift, float(np.degrees(np.linalg.norm((own - others)[:3]))))


def moving_alone(names: Sequence[str], poles: Mapping[str, str]) -> dict[str, frozenset[str]]:
    """What may have moved by itself, keyed by its name: `pole p1`, `pair p1-2`.

    poles: the pole of each pair that stands on one.
    """
    groups = {f"pair {name}": frozenset([name]) for name in names}
    for pole in sorted({poles[name] for name in names if name in poles}):
        groups[f"pole {pole}"] = frozenset(name for name in names if poles.get(name) == pole)
    return groups


Scan = tuple[Mapping[str, Array], Mapping[str, float | None]]
"""motions: (6,) of each pair by name, as alignment moved it: a rotation vector about the rig's
origin and a translation.  moments_ms: when each saw the person; None if not known."""


@dataclass(frozen=True)
class StepSearch:
    """The result of a search for a step.

    step: the pole or pair that stands off in all scans, if one does.
    least_mm: smallest step that would have been seen of any pole or pair; infinite if it cannot be
        told at all for some.
    sway_mm: standard deviation of the person's sway, per axis.
    own_mm: standard deviation of each pair's own offset besides.
    """

    step: PoleStep | None
    least_mm: float
    sway_mm: float = 0.0
    own_mm: float = 0.0


def find_steps(
    scans: Sequence[Scan], poles: Mapping[str, str], freed: Collection[str] = ()
) -> StepSearch:
    """Find the step in one scan, or in several since the calibration.

    poles: as in `moving_alone`.
    freed: pairs of poles known to have moved; another one is searched for.

    A person sways differently in each scan, while what was moved stands off the same way in all. In
    a single scan nothing can be said about pairs whose moment is not known. If every pole moved,
    the one that stands off farthest is the step.
    """
    several = len(scans) >= SEVERAL
    seen = _Seen.of(scans, poles, freed, timed=not several)
    if len(set(seen.names)) < FEWEST:
        return StepSearch(None, np.inf)
    nothing = np.zeros_like(seen.sway)
    still, believed, sway_mm, own_mm = _evidence(seen, SWAY_MM, nothing, np.zeros(1))
    found: list[tuple[float, PoleStep]] = []
    least, hidden = STEP_MM, bool(freed)
    for name, pairs in moving_alone(sorted(set(seen.names)), poles).items():
        own = np.array([pair in pairs for pair in seen.names])
        if not pairs.isdisjoint(freed) or not set(seen.names) - pairs - set(freed):
            continue
        if not several and seen.sway[np.ix_(own, ~own)].max() <= NEARLY:
            least, hidden = np.inf, hidden or len(pairs) > 1
            continue
        spread = 1.0 / np.sqrt(own @ np.linalg.solve(believed, own.astype(float)))
        least = max(least, TOLD_SIGMAS * float(spread))
        # One pair may look moved because a head or an arm moved, unless the person hardly swayed.
        free = len(pairs) > 1 or several
        if not free and sway_mm > STILL_MM:
            least = np.inf
        swayed = SWAY_MM if free else SWAY_MM[SWAY_MM < STILL_MM]
        gain = _evidence(seen, swayed, np.outer(own, own), STEPS_MM)[0] - still
        motions = [{n: m[n] for n in m if n in seen.names and n not in freed} for m, _ in scans]
        found.append((gain, PoleStep.of(name, pairs, _mean(motions))))
    if not found:
        return StepSearch(None, np.inf)
    gain, step = max(found, key=lambda one: one[0])
    if not hidden:
        # If all poles moved outwards none moved by itself, and the body comes out too thin.
        each = _evidence(seen, SWAY_MM, _alike(seen.names, poles), STEPS_MM)[0] - still
        if each > max(gain, SURE):
            gain = each
            farthest = max(
                (one for _, one in found), key=lambda one: (len(one.pairs), one.shift_mm)
            )
            step = replace(farthest, all_moved=True)
    lever = np.radians(step.turn_deg) * ARM_MM
    moved = gain > SURE and np.hypot(step.shift_mm, lever) > STEP_MM
    return StepSearch(step if moved else None, least, sway_mm, own_mm)


def _mean(motions: Sequence[Mapping[str, Array]]) -> dict[str, Array]:
    """Mean of each pair over the scans that have it."""
    names = dict.fromkeys(name for own in motions for name in own)
    return {name: np.mean([own[name] for own in motions if name in own], axis=0) for name in names}


def loosened(boards: PoseCovariance, pairs: Collection[str]) -> PoseCovariance:
    """The calibration's covariance with a pole's pairs free to move together."""
    return boards.add_common_motion(pairs, FREE.of_one())


def motions_between(
    before: Mapping[str, RigidTransform], after: Mapping[str, RigidTransform]
) -> dict[str, Array]:
    """Twist (6,) by which each pair was moved, rig frame."""
    return {name: (after[name] @ before[name].inverse()).twist for name in after}


@dataclass(frozen=True, eq=False)
class _Seen:
    """What N pairs saw, scan after scan.

    motions: of the body's centre and of a point at arm's length, (N, 6) mm.
    sway: correlations of a person's sway, (N, N).
    sides: 1 for pairs that saw the same side in one scan, (N, N).
    free: prior variances of what is not of interest, (N, N) mm2: how a scan stands as a whole, and
        poles known to have moved.
    """

    names: tuple[str, ...]
    motions: Array
    sway: Array
    sides: Array
    free: Array

    @staticmethod
    def of(
        scans: Sequence[Scan], poles: Mapping[str, str], freed: Collection[str], *, timed: bool
    ) -> _Seen:
        """timed: leave out pairs whose moment is not known."""
        names: list[str] = []
        motions, sways, sides = [np.empty((0, 6))], [], []
        for moved, moments_ms in scans:
            own = [name for name in moved if not timed or moments_ms[name] is not None]
            twists = np.array([moved[name] for name in own]).reshape(-1, 6)
            motions.append(np.hstack([centre_shifts(twists), ARM_MM * twists[:, :3]]))
            sways.append(_stances([moments_ms[name] for name in own]))
            sides.append(_alike(own, poles))
            names += own
        off = np.array([name in freed for name in names], float)
        free = block_diag(*(np.ones_like(sway) for sway in sways)) + np.outer(off, off)
        return _Seen(
            tuple(names),
            np.concatenate(motions),
            block_diag(*sways),
            block_diag(*sides),
            ANYWHERE_MM**2 * free,
        )


def _stances(moments_ms: Sequence[float | None]) -> Array:
    """Correlations of stances; one at an unknown moment correlates with no other."""
    seconds = np.array([np.nan if at is None else 1e-3 * at for at in moments_ms], float)
    apart = seconds[:, None] - seconds
    return np.where(np.isnan(apart), np.eye(len(seconds)), of_stance(np.nan_to_num(apart)))


def _alike(names: Sequence[str], poles: Mapping[str, str]) -> Array:
    """(N, N): 1 for pairs of one pole."""
    side = [poles.get(name, name) for name in names]
    return np.equal.outer(side, side).astype(float)


def _evidence(
    seen: _Seen, sways_mm: Array, stepped: Array, steps_mm: Array
) -> tuple[float, Array, float, float]:
    """Log likelihood of the motions at the best sizes of sway, step and noise.

    stepped: 1 for two pairs that share a step, (N, N).

    Also returns the covariance (N, N) at these sizes, and the sizes of sway and noise, mm.
    """
    sway2, step2 = (sizes.ravel() for sizes in np.meshgrid(sways_mm**2, steps_mm**2))
    moved = (
        sway2[:, None, None] * seen.sway
        + np.minimum(SHARED**2 * sway2, SHARED_MM**2)[:, None, None] * seen.sides
        + step2[:, None, None] * stepped
        + seen.free
    )
    # Noise adds to the eigenvalues, so one decomposition serves all its sizes.
    variances, ways = np.linalg.eigh(moved)
    noise2 = NOISE_MM**2
    variance = np.maximum(variances, 0.0)[:, None, :] + noise2[:, None]
    along = np.sum((ways.transpose(0, 2, 1) @ seen.motions) ** 2, axis=2)
    fit = np.sum(along[:, None, :] / variance, axis=2)
    volume = seen.motions.shape[1] * np.sum(np.log(variance), axis=2)
    likelihood = -0.5 * fit - 0.5 * volume
    size, noise = np.unravel_index(np.argmax(likelihood), likelihood.shape)
    covariance = moved[size] + noise2[noise] * np.eye(len(seen.names))
    own = float(np.sqrt(sway2[size])), float(np.sqrt(noise2[noise]))
    return float(likelihood[size, noise]), covariance, *own
