"""Prior of a subject's sway, and the displacement of the body's centre by a pair's twist.

People move between the moments at which pairs capture them. Alignment (`icp`) therefore lets each
pair move about the body's centre by a sway, in addition to what the calibration left open.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np

from bodyscan.arrays import Array
from bodyscan.geometry.linear_gaussian import solve_scaled
from bodyscan.geometry.robust import rms
from bodyscan.geometry.transforms import RigidTransform, adjoint
from bodyscan.geometry.uncertainty import PoseCovariance, compute_position_sigma
from bodyscan.settings import BODY_CENTRE_MM, AlignmentSettings

BODY_CENTRE = np.array(BODY_CENTRE_MM)
LEVER_MM = 400.0
"""Lever arm: at this distance from a joint or the body's centre, a unit of rotation displaces a
point as far as a unit of translation."""


def correlate_stance(seconds: Array) -> Array:
    """Correlation of a standing person's posture with itself after so many seconds.

    Matern's of order 3/2 with a length of 0.8 s: people sway at 0.1 to 1 Hz, and muscles change the
    acceleration at once, so that only the velocity tells where a limb will be.
    """
    r = np.sqrt(3.0) * np.abs(seconds) / 0.8
    return np.asarray((1.0 + r) * np.exp(-r))


@dataclass(frozen=True)
class SwayPrior:
    """Standard deviations of a subject's motion between pairs: a translation, and a rotation about the
    body's centre; 0 for a rigid object. Both are scaled by a factor from `min_scale` to `max_scale`.
    """

    shift_mm: float
    rotation_deg: float
    min_scale: float
    max_scale: float

    @staticmethod
    def from_settings(settings: AlignmentSettings) -> SwayPrior:
        return SwayPrior(settings.sway_mm, settings.sway_deg, settings.min_sway, settings.max_sway)

    def scale(self, motion: Array) -> float:
        """Estimate the prior's scale from twists (P, 6).

        1.5 times the RMS displacement: too tight a prior leaves part of the sway in, too wide a one
        lets noise in.
        """
        if not self.shift_mm:
            return 1.0
        ratio = rms(compute_centre_shifts(motion)) / self.shift_mm
        return float(np.clip(1.5 * ratio, self.min_scale, self.max_scale))

    def covariance(self, names: Sequence[str], boards: PoseCovariance, scale: float = 1.0) -> Array:
        """The calibration's covariance plus each pair's sway, `scale` times the usual, (6P, 6P)."""
        return boards.select(names) + np.kron(np.eye(len(names)), self.pair_covariance(scale))

    def pair_covariance(self, scale: float = 1.0) -> Array:
        """Covariance of the twist by which one pair's subject swayed, rig frame, (6, 6)."""
        rotation, translation = scale * np.radians(self.rotation_deg), scale * self.shift_mm
        centred = np.diag([max(rotation, 1e-7) ** 2] * 3 + [max(translation, 1e-4) ** 2] * 3)
        carry = adjoint(RigidTransform.from_translation(BODY_CENTRE))
        return np.asarray(carry @ centred @ carry.T)

    def loosen(self, boards: PoseCovariance, names: Collection[str]) -> PoseCovariance:
        """Add the usual sway to the covariance of these pairs."""
        return boards.add_motions(names, self.pair_covariance(), common=False)


def compute_centre_shifts(motion: Array) -> Array:
    """Displacements (P, 3) mm of the body's centre by twists (P, 6)."""
    return motion[:, 3:] + np.cross(motion[:, :3], BODY_CENTRE)


def compute_centre_sigmas(boards: PoseCovariance) -> dict[str, float]:
    """Standard deviation, mm, of the body's centre due to each pair's pose error."""
    return {
        name: float(np.linalg.norm(compute_position_sigma(boards, name, BODY_CENTRE)))
        for name in boards.names
    }


def reject_large_motions(
    names: Sequence[str], motion: Array, covariance: Array, limit_sigmas: float
) -> tuple[Array, dict[str, float]]:
    """Set twists (P, 6) beyond `limit_sigmas` of their prior (6P, 6P) to zero.

    Sigmas are Mahalanobis distances over the root of six degrees of freedom. Also returns those of
    the rejected pairs.
    """
    kept, refused = motion.copy(), {}
    for k, name in enumerate(names):
        block = covariance[6 * k : 6 * k + 6, 6 * k : 6 * k + 6]
        sigmas = float(np.sqrt(motion[k] @ solve_scaled(block, motion[k]) / 6.0))
        if sigmas > limit_sigmas:
            refused[name] = sigmas
            kept[k] = 0.0
    return kept, refused


def select_tighter(
    one: PoseCovariance, other: PoseCovariance, names: Collection[str]
) -> PoseCovariance:
    """Select the covariance with the smaller RMS sigma of the body's centre over these pairs.

    The first if there are no names.
    """
    if not names:
        return one
    sizes = (compute_centre_sigmas(poses) for poses in (one, other))
    first, second = (rms(np.array([sigmas[name] for name in names])) for sigmas in sizes)
    return other if second < first else one
