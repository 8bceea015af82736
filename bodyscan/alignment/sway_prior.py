"""A subject's sway: how far people move between the pairs' shots, assumed, found and bounded.

Alignment removes it (see `icp`): each pair's pose may move about the body's centre as far as this
prior allows, in addition to what the boards left open.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np

from bodyscan.arrays import Array
from bodyscan.geometry.linear_gaussian import solve_scaled
from bodyscan.geometry.robust import rms
from bodyscan.geometry.transforms import RigidTransform, adjoint
from bodyscan.geometry.uncertainty import PoseCovariance, position_sigma
from bodyscan.settings import BODY_CENTRE_MM, AlignmentSettings

BODY_CENTRE = np.array(BODY_CENTRE_MM)
SWAY_ROOM = 1.5  # assumed standard deviations over those found


@dataclass(frozen=True)
class SwayPrior:
    """Standard deviations of a subject's motion between pairs: a shift, and a rotation about the
    body's centre; 0 for a rigid object. The sway found scales both, from `least` to `most`.
    """

    shift_mm: float
    rotation_deg: float
    least: float
    most: float

    @staticmethod
    def of(settings: AlignmentSettings) -> SwayPrior:
        return SwayPrior(
            settings.sway_mm, settings.sway_deg, settings.least_sway, settings.most_sway
        )

    def scale(self, motion: Array) -> float:
        """Size of motions (P, 6) in multiples of `shift_mm`, with some room.

        Too tight a prior would leave part of the sway in; too wide a one would let noise in.
        """
        if not self.shift_mm:
            return 1.0
        found = rms(centre_shifts(motion)) / self.shift_mm
        return float(np.clip(SWAY_ROOM * found, self.least, self.most))

    def covariance(self, names: Sequence[str], boards: PoseCovariance, scale: float = 1.0) -> Array:
        """The calibration's covariance plus `scale` times each pair's usual sway, (6P, 6P)."""
        return boards.select(names) + np.kron(np.eye(len(names)), self.of_one(scale))

    def of_one(self, scale: float = 1.0) -> Array:
        """Covariance of one pair's sway, rig frame, (6, 6)."""
        rotation, translation = scale * np.radians(self.rotation_deg), scale * self.shift_mm
        own = np.diag([max(rotation, 1e-7) ** 2] * 3 + [max(translation, 1e-4) ** 2] * 3)
        carry = adjoint(RigidTransform.from_translation(BODY_CENTRE))
        return np.asarray(carry @ own @ carry.T)

    def loosen(self, boards: PoseCovariance, untied: Collection[str]) -> PoseCovariance:
        """The calibration's covariance plus the sway of the pairs that no overlap ties."""
        return boards.add_independent_motions(untied, self.of_one())


def centre_shifts(motion: Array) -> Array:
    """How far motions (P, 6) carry the body's centre, (P, 3) mm."""
    return motion[:, 3:] + np.cross(motion[:, :3], BODY_CENTRE)


def centre_sigmas(boards: PoseCovariance) -> dict[str, float]:
    """How far each pair's pose error may put the body's centre off, mm."""
    return {
        name: float(np.linalg.norm(position_sigma(boards, name, BODY_CENTRE)))
        for name in boards.names
    }


def bound_motions(
    names: Sequence[str], motion: Array, covariance: Array, limit_sigmas: float
) -> tuple[Array, dict[str, float]]:
    """Motions (P, 6), set to 0 for pairs that moved more than `limit_sigmas` of their own prior.

    Sigmas are over six degrees of freedom; also returns those of the refused pairs.
    """
    kept, refused = motion.copy(), {}
    for k, name in enumerate(names):
        block = covariance[6 * k : 6 * k + 6, 6 * k : 6 * k + 6]
        sigmas = float(np.sqrt(motion[k] @ solve_scaled(block, motion[k]) / 6.0))
        if sigmas > limit_sigmas:
            refused[name] = sigmas
            kept[k] = 0.0
    return kept, refused


def better_known(
    one: PoseCovariance, other: PoseCovariance, names: Collection[str]
) -> PoseCovariance:
    """Of two covariances the one by which these pairs put the body's centre off by less; the first
    where there are none."""
    if not names:
        return one
    sizes = (centre_sigmas(poses) for poses in (one, other))
    ours, theirs = (rms(np.array([sigmas[name] for name in names])) for sigmas in sizes)
    return other if theirs < ours else one
