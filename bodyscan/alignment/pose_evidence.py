"""Detect displaced poles, or a wrong scale, from what the subject's motion leaves unexplained.

The pairs' motions alone (`displaced_poles`) hardly distinguish poles that all moved outwards from a
person who moved round them in turn. But feet stay in place while a body sways, and breath lifts no
leg: once the body's motion is estimated, little is left that only displaced poles explain.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from bodyscan.alignment.displaced_poles import (
    MIN_PAIRS,
    MIN_STEP_MM,
    STEPS_MM,
    DisplacedPole,
    group_by_pole,
)
from bodyscan.alignment.sway_prior import BODY_CENTRE, LEVER_MM
from bodyscan.arrays import Array, Mask
from bodyscan.geometry.linear_gaussian import LinearGaussianSystem
from bodyscan.geometry.transforms import RigidTransform

MIN_LOG_RATIO = 12.0
"""Log likelihood ratio that a displacement must reach. No model of people is exact: in ten sound
scans of moving people it was -9 to 5.8, in thirteen for single pairs -9 to 3; for poles displaced by
3 mm it is 70 and more, for a pair by 5 mm 530."""
MIN_ERROR_MM = 0.3
"""Of poses or scale: 2 mm of a girth; a scale's error was 0.22 mm at most for ten sound people."""


@dataclass(frozen=True)
class ScaleError:
    """All poles are farther from the body than calibrated, or nearer."""

    # How much farther, negative for nearer; every radius of the body is too small by that.
    outward_mm: float
    sigma_mm: float  # its standard deviation
    certain: bool = True  # see `DisplacedPole`


@dataclass(frozen=True)
class CommonError:
    """Every pair is displaced alike in its own camera's frame: not poles moved, but all lenses or all
    projectors changed, or were calibrated with one error.
    """

    # (3,) mm, to the right, down and away, where cameras look at the body.
    shift: tuple[float, float, float]
    rotation_deg: float  # about that place
    certain: bool = True  # see `DisplacedPole`

    @property
    def shift_mm(self) -> float:
        return float(np.linalg.norm(self.shift))

    @property
    def size_mm(self) -> float:
        """See `DisplacedPole`."""
        return float(np.hypot(self.shift_mm, LEVER_MM * np.radians(self.rotation_deg)))


@dataclass(frozen=True)
class PostureStep:
    """The subject held another posture while one pole fired: drew the belly in, lifted an arm."""

    pole: str  # or poles, if it may have been another
    pairs: frozenset[str]
    kinds: tuple[str, ...]  # of motion, whose fields the step is a sum of
    moved_mm: float  # largest amplitude
    size_mm: float  # prior standard deviation of the amplitudes
    log_ratio: float  # log likelihood ratio against none


Displacement = DisplacedPole | ScaleError | CommonError | PostureStep
Equations = Callable[[Mask], LinearGaussianSystem]


@dataclass(frozen=True, eq=False)
class PoseEvidence:
    """Normal equations of the pose errors of P pairs, marginalized over the subject's motion.

    system: of the 6P twists, pair after pair, beyond the calibration's uncertainty.
    postures: by kinds of motion, the same of a step of posture in the views of some pairs (P,).
    other_times: moments that explain the motion best, in words before "those in `timing`", and their
        log likelihood ratio against those stated; empty and 0 if none is better beyond doubt.
    fit_clocks: gives such words of one pole's or two pairs' moments; None if the person does not move.
    """

    names: tuple[str, ...]
    system: LinearGaussianSystem
    postures: Mapping[tuple[str, ...], Equations] = field(default_factory=dict)
    other_times: tuple[str, float] = ("", 0.0)
    fit_clocks: Callable[..., str] | None = None

    def fit(self, basis: Array) -> _DisplacementFit:
        """Fit displacements along `basis` (6P, k)."""
        return _DisplacementFit.from_system(self.system.project(basis))


@dataclass(frozen=True, eq=False)
class _DisplacementFit:
    """log_ratio: log likelihood ratio against none.  steps (k,) mm, with covariance (k, k) and prior
    standard deviation."""

    log_ratio: float
    steps: Array
    covariance: Array
    size_mm: float

    @staticmethod
    def from_system(system: LinearGaussianSystem) -> _DisplacementFit:
        """With the prior size of the best evidence."""
        log_evidence = system.log_evidence(STEPS_MM**2)
        best = int(np.argmax(log_evidence))
        size_mm = float(STEPS_MM[best])
        posterior = system + LinearGaussianSystem.from_prior(np.eye(system.size) / size_mm**2)
        return _DisplacementFit(
            float(log_evidence[best]), posterior.solve(), posterior.covariance(), size_mm
        )


def detect_displacement(
    evidence: PoseEvidence,
    rig_from_camera: Mapping[str, RigidTransform],
    poles: Mapping[str, str],
    displaced: Collection[str] = (),
) -> Displacement | None:
    """Find the displacement that explains a scan better than any smooth motion of the subject, or
    other moments.

    Candidates are one pole or pair; every pole by itself (`all_moved`); all poles farther out or
    nearer; all pairs alike in their cameras' frames; another posture while one pole fired.

    rig_from_camera: as calibrated.
    poles: the pole of each pair that is mounted on one.
    displaced: pairs already known to be displaced.
    """
    sides = [poles.get(name, name) for name in evidence.names]
    if len(set(sides)) < 2 or not set(evidence.names) - set(displaced):
        return None
    candidates: list[tuple[float, Displacement]] = []
    single: list[tuple[float, Displacement]] = []  # of one pole, or of all
    for name, pairs in group_by_pole(evidence.names, poles).items():
        # Among few pairs, any single one could be displaced.
        identifiable = len(pairs) > 1 or len(evidence.names) >= MIN_PAIRS
        if identifiable and pairs.isdisjoint(displaced):
            fit = evidence.fit(_build_rigid_basis(np.isin(evidence.names, list(pairs))))
            candidates.append((fit.log_ratio, _describe_displaced_pole(name, pairs, fit.steps)))
            if len(pairs) > 1:
                single.append(candidates[-1])
                candidates += _fit_postures(evidence, name, pairs)
    if not displaced:
        bases = {side: _build_rigid_basis(np.equal(sides, side)) for side in dict.fromkeys(sides)}
        each = evidence.fit(np.hstack(list(bases.values())))
        relative = each.steps.reshape(-1, 6) - each.steps.reshape(-1, 6).mean(axis=0)
        farthest = int(np.argmax(np.linalg.norm(relative, axis=1)))
        side = list(bases)[farthest]
        pairs = frozenset(np.array(evidence.names)[np.equal(sides, side)].tolist())
        pole = _describe_displaced_pole(f"pole {side}", pairs, relative[farthest])
        candidates.append((each.log_ratio, replace(pole, all_moved=True)))
        outward = _build_outward_basis(evidence.names, sides, rig_from_camera)
        scale = evidence.fit(outward.reshape(-1, 1))
        sigma_mm = float(np.sqrt(scale.covariance[0, 0]))
        candidates.append((scale.log_ratio, ScaleError(float(scale.steps[0]), sigma_mm)))
        single.append(candidates[-1])
        common = evidence.fit(build_common_basis(evidence.names, rig_from_camera))
        shift, lever = common.steps.reshape(2, 3)
        turn_deg = float(np.degrees(np.linalg.norm(lever) / LEVER_MM))
        candidates.append((common.log_ratio, CommonError(tuple(shift.tolist()), turn_deg)))
    threshold = max(MIN_LOG_RATIO, evidence.other_times[1])
    likely = [both for both in single if both[0] > threshold]
    log_ratio, best = _select_likeliest(candidates, likely)
    if isinstance(best, PostureStep):
        near = [one for ratio, one in candidates if ratio > log_ratio - MIN_LOG_RATIO]
        either = [one.pole for one in near if isinstance(one, PostureStep)]
        best = replace(best, pole=" or ".join(dict.fromkeys(either)))
    if best and log_ratio > threshold and _is_harmful(best):
        return best
    return None if displaced or evidence.other_times[1] else _find_doubtful(single)


def _select_likeliest(
    candidates: Sequence[tuple[float, Displacement]], single: Sequence[tuple[float, Displacement]]
) -> tuple[float, Displacement | None]:
    """One pole that was knocked is likelier than all at once, unless the evidence is clear: of one 3 mm
    out it was 12.8, of all 13.9; where all were out that of one was 18 less, and more."""
    log_ratio, best = max(candidates, key=lambda one: one[0], default=(0.0, None))
    near = log_ratio - MIN_LOG_RATIO if isinstance(best, ScaleError | CommonError) else np.inf
    poles = [(r, one) for r, one in single if isinstance(one, DisplacedPole) and r > near]
    return max(poles, key=lambda one: one[0], default=(log_ratio, best))


def _find_doubtful(single: Sequence[tuple[float, Displacement]]) -> Displacement | None:
    """A pole, or all, that may be displaced: freed, they do no harm. Girths of a person who sways as
    much were wrong by 4 mm where 3.7 were claimed; with all 1 mm out, points by 1.8 sigmas."""
    for ratio, one in sorted(single, key=lambda both: both[0], reverse=True):
        if isinstance(one, DisplacedPole | ScaleError) and ratio > 6.0 and _is_harmful(one):
            return replace(one, certain=False)  # sound people reach 5.8
    return None


def _fit_postures(
    evidence: PoseEvidence, pole: str, pairs: frozenset[str]
) -> list[tuple[float, PostureStep]]:
    """Log likelihood ratios of other postures while these pairs fired."""
    members = np.isin(evidence.names, list(pairs))
    found = []
    for kinds, equations in evidence.postures.items():
        fit = _DisplacementFit.from_system(equations(members))
        moved_mm = float(np.abs(fit.steps).max(initial=0.0))
        step = PostureStep(pole, pairs, kinds, moved_mm, fit.size_mm, fit.log_ratio)
        found.append((fit.log_ratio, step))
    return found


def _is_harmful(found: Displacement) -> bool:
    if isinstance(found, PostureStep):
        return found.moved_mm > MIN_STEP_MM
    if isinstance(found, ScaleError):
        return abs(found.outward_mm) > MIN_ERROR_MM
    return found.size_mm > MIN_ERROR_MM


def _describe_displaced_pole(name: str, pairs: frozenset[str], steps: Array) -> DisplacedPole:
    """steps: (6,) mm, along `_build_rigid_basis`."""
    shift, lever = np.linalg.norm(steps.reshape(2, 3), axis=1)
    return DisplacedPole(name, pairs, float(shift), float(np.degrees(lever / LEVER_MM)))


def _build_rigid_basis(members: Mask) -> Array:
    """Twists (6P, 6) of the pairs (P,) that move as one.

    Translations of the body's centre by 1 mm, then rotations about it by 1 mm at the lever arm.
    """
    twists = np.zeros((6, 6))
    twists[3:, :3] = np.eye(3)
    twists[:3, 3:] = np.eye(3) / LEVER_MM
    twists[3:, 3:] = -np.cross(np.eye(3) / LEVER_MM, BODY_CENTRE).T
    return np.asarray(np.kron(members.astype(float)[:, None], twists))


def _build_outward_basis(
    names: Collection[str], sides: Sequence[str], rig_from_camera: Mapping[str, RigidTransform]
) -> Array:
    """(P, 6): each pair translated by 1 mm, level and away from the body, equally for one pole."""
    outward = np.array([rig_from_camera[name].translation - BODY_CENTRE for name in names])
    outward[:, 2] = 0.0
    twists = np.zeros((len(outward), 6))
    for side in dict.fromkeys(sides):
        members = np.equal(sides, side)
        mean = outward[members].mean(axis=0)
        twists[members, 3:] = mean / np.linalg.norm(mean)
    return twists


def build_common_basis(
    names: Collection[str], rig_from_camera: Mapping[str, RigidTransform]
) -> Array:
    """Twists (6P, 6) of pairs that all move alike in their own camera's frames.

    Translations by 1 mm along the camera's axes, then rotations about the point on its axis that is as
    far away as the body is in the mean, by which a point at the lever arm moves by 1 mm.
    """
    poses = [rig_from_camera[name] for name in names]
    level = [np.linalg.norm((pose.translation - BODY_CENTRE)[:2]) for pose in poses]
    blocks = []
    for pose in poses:
        looked_at = pose.apply(np.array([0.0, 0.0, np.mean(level)]))
        turns = pose.rotation / LEVER_MM
        rotations = np.vstack([turns, np.cross(looked_at, turns, axisb=0, axisc=0)])
        blocks.append(np.hstack([np.vstack([np.zeros((3, 3)), pose.rotation]), rotations]))
    return np.concatenate(blocks)
