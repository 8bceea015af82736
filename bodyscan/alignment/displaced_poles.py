"""Detect poles that were displaced since the calibration, from the pairs' motions in alignment.

A displaced pole and a moving subject both shift pairs relative to each other. But all pairs of a
displaced pole are off by the same rigid motion at all times, while a person moves continuously:
pairs that fire within a moment of each other see nearly the same posture. Both explanations are
compared by the likelihood of Gaussian processes over time.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import block_diag
from scipy.special import fdtri

from bodyscan.alignment.sway_prior import (
    LEVER_MM,
    SwayPrior,
    compute_centre_shifts,
    correlate_stance,
)
from bodyscan.arrays import Array
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.geometry.uncertainty import PoseCovariance

MIN_PAIRS = 4
"""With two or three pairs, any could be the displaced one."""
MIN_SCANS = 3
"""What is equal in this many scans is not the sway of one person."""
MIN_STEP_MM = 1.0
"""Calibrations of poles disagree by less, and alignment corrects it."""
MIN_DRIFT_MM = 0.3
STEPS_MM = np.geomspace(0.5, 30.0, 8)  # prior standard deviations of a displacement
SWAYS_MM = np.geomspace(0.05, 20.0, 10)
STILL_MM = 0.4
"""Apparent sway of a mannequin, because calibrations disagree; a standing person's is 1 to 5."""
MIN_LOG_RATIO = 6.0
"""Log likelihood ratio, 400 to 1, that a displaced pole must reach."""


@dataclass(frozen=True)
class DisplacedPole:
    """A pole, or a single pair, that is displaced from its calibrated pose.

    name: `pole p1` or `pair p1-2`.
    shift_mm, rotation_deg: at the body's centre.
    all_moved: whether every other pole is displaced too, so that none is a reference.
    certain: whether it is displaced beyond doubt, not only freed in case it is.
    """

    name: str
    pairs: frozenset[str]
    shift_mm: float
    rotation_deg: float
    all_moved: bool = False
    certain: bool = True

    @property
    def size_mm(self) -> float:
        """By shift and rotation together, at the lever arm."""
        return float(np.hypot(self.shift_mm, LEVER_MM * np.radians(self.rotation_deg)))

    @staticmethod
    def from_motions(
        name: str, pairs: frozenset[str], motions: Mapping[str, Array]
    ) -> DisplacedPole:
        """The mean twist (6,) of these pairs relative to the mean of the others."""
        mean, reference = (
            np.mean([twist for n, twist in motions.items() if (n in pairs) == inside], axis=0)
            for inside in (True, False)
        )
        shift = float(np.linalg.norm(compute_centre_shifts((mean - reference)[None])[0]))
        rotation = float(np.degrees(np.linalg.norm((mean - reference)[:3])))
        return DisplacedPole(name, pairs, shift, rotation)


@dataclass(frozen=True)
class DisplacementSearch:
    """The result of a search for a displaced pole."""

    found: DisplacedPole | None  # the pole or pair that is displaced in all scans, if any
    # Smallest displacement that would have been detected of any pole or pair; infinite if that of
    # some cannot be told from sway.
    detectable_mm: float
    sway_mm: float = 0.0  # standard deviation of the person's sway, per axis
    offset_mm: float = 0.0  # standard deviation of each pair's independent offset


@dataclass(frozen=True)
class PairDrift:
    """Mean motion of a pair or pole over several scans, which no person's sway explains."""

    pair: str
    shift: tuple[float, float, float]  # (3,) mm at the body's centre, rig axes
    # Standard error of its length, from the variation between scans; None for fewer than three
    # scans.
    sigma_mm: float | None
    limit_mm: float  # a larger shift is not chance

    @property
    def shift_mm(self) -> float:
        return float(np.linalg.norm(self.shift))

    @property
    def moved(self) -> bool:
        return self.shift_mm > self.limit_mm


def estimate_drift(name: str, shifts: Array) -> PairDrift:
    """Estimate the drift of a pair or pole from its shifts (scans, 3) mm at the body's centre.
    Hotelling's test with one variance for all axes, at 1e-4; a sigma of at least 0.05 mm."""
    scans = len(shifts)
    x, y, z = (float(value) for value in shifts.mean(axis=0))
    if scans < MIN_SCANS:
        return PairDrift(name, (x, y, z), None, np.inf)
    sigma = max(float(np.sqrt(shifts.var(axis=0, ddof=1).sum() / scans)), 0.05)
    ratio = float(np.sqrt(fdtri(3, 3 * (scans - 1), 1.0 - 1e-4)))
    return PairDrift(name, (x, y, z), sigma, max(ratio * sigma, MIN_DRIFT_MM))


def group_by_pole(names: Sequence[str], poles: Mapping[str, str]) -> dict[str, frozenset[str]]:
    """Pairs that can only be displaced together, keyed by name: `pole p1`, `pair p1-2`.

    poles: the pole of each pair that is mounted on one.
    """
    groups = {f"pair {name}": frozenset([name]) for name in names}
    for pole in sorted({poles[name] for name in names if name in poles}):
        groups[f"pole {pole}"] = frozenset(name for name in names if poles.get(name) == pole)
    return groups


def free_pairs(boards: PoseCovariance, pairs: Collection[str]) -> PoseCovariance:
    """Let these pairs move together by 30 mm and 5 degrees (standard deviations). A pole displaced
    farther shares no surface with the others."""
    return boards.add_motions(pairs, SwayPrior(30.0, 5.0, 1.0, 1.0).pair_covariance(), common=True)


def compute_motions_between(
    before: Mapping[str, RigidTransform], after: Mapping[str, RigidTransform]
) -> dict[str, Array]:
    """Twist (6,) by which each pair's pose changed, rig frame."""
    return {name: (after[name] @ before[name].inverse()).twist for name in after}


Scan = tuple[Mapping[str, Array], Mapping[str, float | None]]
"""Twist (6,) by which alignment moved each pair, about the rig's origin; and each pair's time, ms,
None if not known."""


def find_displaced_pole(
    scans: Sequence[Scan], poles: Mapping[str, str], displaced: Collection[str] = ()
) -> DisplacementSearch:
    """Find the pole or pair that is displaced in one scan, or in several since the calibration.

    poles: as in `group_by_pole`.
    displaced: pairs already known to be displaced; another one is searched for.

    A person sways differently in each scan, while a displacement is the same in all. In a single
    scan nothing is known of pairs without a time. If every pole is displaced, the one that is
    farthest off is returned.
    """
    several = len(scans) >= MIN_SCANS
    measured = _PoseMotions.from_scans(scans, poles, displaced, timed=not several)
    if len(set(measured.names)) < MIN_PAIRS:
        return DisplacementSearch(None, np.inf)
    nothing = np.zeros_like(measured.sway)
    null, covariance, sway_mm, offset_mm = _maximize_likelihood(
        measured, SWAYS_MM, nothing, np.zeros(1)
    )
    others = [name for name in dict.fromkeys(measured.names) if name not in displaced]
    means = {n: np.mean([m[n] for m, _ in scans if n in m], axis=0) for n in others}
    candidates: list[tuple[float, DisplacedPole]] = []
    detectable, ambiguous = MIN_STEP_MM, bool(displaced)
    for name, pairs in group_by_pole(sorted(set(measured.names)), poles).items():
        members = np.array([pair in pairs for pair in measured.names])
        if not pairs.isdisjoint(displaced) or not set(measured.names) - pairs - set(displaced):
            continue
        # Correlation 0.8 s apart: if a pole fires at no other pole's time, the person may have
        # moved meanwhile.
        if not several and measured.sway[np.ix_(members, ~members)].max() <= 0.5:
            detectable, ambiguous = np.inf, ambiguous or len(pairs) > 1
            continue
        sigma = 1.0 / np.sqrt(members @ np.linalg.solve(covariance, members.astype(float)))
        # x sigmas along one direction have a log likelihood ratio of x^2 / 2 - 3 log(1 + x^2), which
        # is MIN_LOG_RATIO at 5.8; two more keep chance from hiding it.
        detectable = max(detectable, 8.0 * float(sigma))
        # A single pair may look displaced because a head or an arm moved, unless the subject was still.
        any_sway = len(pairs) > 1 or several
        if not any_sway and sway_mm > STILL_MM:
            detectable = np.inf
        sways = SWAYS_MM if any_sway else SWAYS_MM[SWAYS_MM < STILL_MM]
        stepped = np.outer(members, members)
        gain = _maximize_likelihood(measured, sways, stepped, STEPS_MM)[0] - null
        candidates.append((gain, DisplacedPole.from_motions(name, pairs, means)))
    if not candidates:
        return DisplacementSearch(None, np.inf)
    if not ambiguous:
        same_pole = _mark_same_pole(measured.names, poles)
        each = _maximize_likelihood(measured, SWAYS_MM, same_pole, STEPS_MM)[0] - null
        if each > max(MIN_LOG_RATIO, *(other for other, _ in candidates)):
            # If all poles moved outwards, none moved relative to the others, and the body is too thin.
            farthest = max((one for _, one in candidates), key=lambda p: (len(p.pairs), p.shift_mm))
            candidates = [(each, replace(farthest, all_moved=True))]
    gain, best = max(candidates, key=lambda one: one[0])
    significant = gain > MIN_LOG_RATIO and best.size_mm > MIN_STEP_MM
    return DisplacementSearch(best if significant else None, detectable, sway_mm, offset_mm)


@dataclass(frozen=True, eq=False)
class _PoseMotions:
    """Motions of N pairs, scan after scan, and the covariances that may explain them."""

    names: tuple[str, ...]
    motions: Array  # of the body's centre and of a point at the lever arm, (N, 6) mm
    sway: Array  # correlations of the person's sway, (N, N)
    sides: Array  # 1 for pairs of one pole in one scan, (N, N)
    # Prior variances of each scan's common motion, and of displaced poles, (N, N) mm^2.
    nuisance: Array

    @staticmethod
    def from_scans(
        scans: Sequence[Scan], poles: Mapping[str, str], displaced: Collection[str], *, timed: bool
    ) -> _PoseMotions:
        """timed: leave out pairs without a time."""
        names: list[str] = []
        motions, sways, sides = [np.empty((0, 6))], [], []
        for twist_of, moments_ms in scans:
            used = [name for name in twist_of if not timed or moments_ms[name] is not None]
            twists = np.array([twist_of[name] for name in used]).reshape(-1, 6)
            motions.append(np.hstack([compute_centre_shifts(twists), LEVER_MM * twists[:, :3]]))
            sways.append(_correlate_stances([moments_ms[name] for name in used]))
            sides.append(_mark_same_pole(used, poles))
            names += used
        is_displaced = np.array([name in displaced for name in names], float)
        nuisance = block_diag(*(np.ones_like(sway) for sway in sways))
        nuisance += np.outer(is_displaced, is_displaced)
        return _PoseMotions(
            tuple(names),
            np.concatenate(motions),
            block_diag(*sways),
            block_diag(*sides),
            100.0**2 * nuisance,
        )


def _correlate_stances(moments_ms: Sequence[float | None]) -> Array:
    """Correlations of the posture between moments; an unknown one correlates with no other."""
    seconds = np.array([np.nan if at is None else 1e-3 * at for at in moments_ms], float)
    lag = seconds[:, None] - seconds
    return np.where(np.isnan(lag), np.eye(len(seconds)), correlate_stance(np.nan_to_num(lag)))


def _mark_same_pole(names: Sequence[str], poles: Mapping[str, str]) -> Array:
    """(N, N): 1 for two pairs of one pole."""
    side = [poles.get(name, name) for name in names]
    return np.equal.outer(side, side).astype(float)


def _maximize_likelihood(
    measured: _PoseMotions, sways_mm: Array, stepped: Array, steps_mm: Array
) -> tuple[float, Array, float, float]:
    """Maximize the log likelihood of the motions over the sizes of sway, displacement and noise.

    stepped: 1 for two pairs that share a displacement, (N, N). Also returns the covariance (N, N)
        there, and the sizes of sway and noise, mm.
    """
    sway2, step2 = (sizes.ravel() for sizes in np.meshgrid(sways_mm**2, steps_mm**2))
    # A pole's pairs see one side, which breathes by some 2 mm, and arms: the non-rigid remainder
    # is 0.6 of the sway and at most 0.9 mm (ten sound standing people: 1.5 to 4 mm at a pole).
    side2 = np.minimum(0.6**2 * sway2, 0.9**2)
    covariances = (
        sway2[:, None, None] * measured.sway
        + side2[:, None, None] * measured.sides
        + step2[:, None, None] * stepped
        + measured.nuisance
    )
    # Noise adds to the eigenvalues, so one decomposition serves all its sizes.
    eigenvalues, eigenvectors = np.linalg.eigh(covariances)
    noise2 = np.geomspace(0.05, 5.0, 9) ** 2
    variance = np.maximum(eigenvalues, 0.0)[:, None, :] + noise2[:, None]
    squares = np.sum((eigenvectors.transpose(0, 2, 1) @ measured.motions) ** 2, axis=2)
    chi2 = np.sum(squares[:, None, :] / variance, axis=2)
    log_det = measured.motions.shape[1] * np.sum(np.log(variance), axis=2)
    log_likelihood = -0.5 * chi2 - 0.5 * log_det
    size, noise = np.unravel_index(np.argmax(log_likelihood), log_likelihood.shape)
    covariance = covariances[size] + noise2[noise] * np.eye(len(measured.names))
    scales = float(np.sqrt(sway2[size])), float(np.sqrt(noise2[noise]))
    return float(log_likelihood[size, noise]), covariance, *scales
