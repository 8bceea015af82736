"""Kinds of motion that a body may do: displacement fields, their temporal modes and priors."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np

from bodyscan.alignment.sway_prior import BODY_CENTRE, LEVER_MM, correlate_stance
from bodyscan.arrays import Array
from bodyscan.geometry.linear_gaussian import invert_scaled
from bodyscan.geometry.transforms import RigidTransform, adjoint
from bodyscan.motion.body_cells import BodyCells, build_rigid_fields, modulate_fields
from bodyscan.motion.body_parts import build_limb_fields, find_ankles, weigh_above_feet
from bodyscan.motion.breath import build_breath_fields
from bodyscan.motion.temporal_modes import TemporalModes, correlate_breath


@dataclass(frozen=True, eq=False)
class MotionKind:
    """One kind of motion: M displacement fields, each with amplitudes along J temporal modes."""

    name: str
    fields: Array  # (C, 12, M) mm, see `build_rigid_fields`
    modes: TemporalModes
    size: float = 1.0  # prior standard deviation of the amplitudes
    # Prior information (M J, M J) of the amplitudes, instead of `size`.
    precision: Array | None = None
    twists: Array | None = None  # (6, M) about the rig's origin, if the body moves as a whole
    remainder: Array | None = None  # fields less twists, (C, 12, M), if the feet stay
    # In people who stand, mm; it holds as far as the overlaps determine nothing.
    standing_size: float = 1.0

    @property
    def count(self) -> int:
        """Number of amplitudes, M J."""
        return self.fields.shape[2] * self.modes.count

    @property
    def prior_information(self) -> Array:
        """(M J, M J)."""
        return np.eye(self.count) / self.size**2 if self.precision is None else self.precision

    def modes_from_middle(self, pair: int) -> Array:
        """Change (J,) of the modes from the middle of the scan to a pair's moment."""
        return self.modes.values[pair] - self.modes.middle


def build_kinds(
    cells: BodyCells, seconds: Sequence[float | None], middle_s: float, boards: Array, sway: Array
) -> tuple[MotionKind, ...]:
    """All kinds of motion, beginning with the pairs' pose errors.

    seconds: each pair's moment, None if not known.
    middle_s: of the scan.
    boards: covariance (6P, 6P) of the pairs' poses.
    sway: standard deviations (6,) of a usual rotation (radians) and translation (mm) about the
        body's centre.
    """
    stance = TemporalModes.from_correlation(correlate_stance, seconds, middle_s)
    breathing = TemporalModes.from_correlation(correlate_breath, seconds, middle_s)
    pairs = len(seconds)
    by_freedom = np.arange(6 * pairs).reshape(pairs, 6).T.ravel()
    constant = TemporalModes(np.eye(pairs), np.zeros(pairs))
    pose = _build_whole_body("pose", cells, np.eye(6), constant)
    any_twist = adjoint(RigidTransform.from_translation(BODY_CENTRE)) * sway
    translations = build_rigid_fields(cells, np.zeros(3), LEVER_MM)[:, :, 3:]
    # Parts move freely over 250 mm: a forearm, half a thigh, a shoulder.
    parts = modulate_fields(translations, cells, cells.covariance_factor(250.0, 0.02))
    breath = MotionKind("breath", build_breath_fields(cells), breathing)
    return (
        replace(pose, precision=invert_scaled(boards)[np.ix_(by_freedom, by_freedom)]),
        _build_lean(cells, stance),
        _build_whole_body("sway", cells, any_twist, stance),
        *(
            MotionKind(name, field, stance, standing_size=2.0)
            for name, field in build_limb_fields(cells, LEVER_MM).items()
        ),
        MotionKind("parts", parts, stance),
        replace(breath, precision=np.eye(breath.count)),
    )


def retime_kinds(
    kinds: Sequence[MotionKind],
    seconds: Sequence[float | None],
    middle_s: float,
    omitted: Collection[str],
) -> tuple[MotionKind, ...]:
    """All kinds but those omitted, with the modes of other moments, the breath of unit variance.

    No size in people who stand is assumed: who stands very still does so at any times.
    """
    stance = TemporalModes.from_correlation(correlate_stance, seconds, middle_s)
    breathing = TemporalModes.from_correlation(correlate_breath, seconds, middle_s)
    retimed = []
    for kind in kinds:
        if kind.name in omitted:
            continue
        if kind.name in ("pose", "step"):
            retimed.append(kind)
        elif kind.name == "breath":
            identity = np.eye(kind.fields.shape[2] * breathing.count)
            retimed.append(replace(kind, modes=breathing, precision=identity))
        else:
            retimed.append(replace(kind, modes=stance, standing_size=0.0))
    return tuple(retimed)


def _build_whole_body(
    name: str, cells: BodyCells, twists: Array, modes: TemporalModes
) -> MotionKind:
    """A rigid motion of the whole body; twists: (6, M)."""
    fields = build_rigid_fields(cells, np.zeros(3), 1.0) @ twists
    return MotionKind(name, fields, modes, 2.0, twists=twists)


def _build_lean(cells: BodyCells, modes: TemporalModes) -> MotionKind:
    """A lean about the ankles, as of an inverted pendulum (Winter 1995), and a turn; the feet stay. A
    unit of amplitude moves the middle of the body, 1 m above the ankles, by 1 mm."""
    about_ankles = adjoint(RigidTransform.from_translation(find_ankles(cells)))[:, :3] / 1000.0
    whole = _build_whole_body("lean", cells, about_ankles, modes)
    fields = modulate_fields(whole.fields, cells, weigh_above_feet(cells)[:, None])
    return replace(whole, fields=fields, remainder=fields - whole.fields)
