"""Find poles that stand off, or a wrong size, from all that one scan shows of a person's motion.

Pairs' motions alone (`pole_steps`) hardly tell poles that all moved outwards from a person who
moved round them in turn. But feet stay in place while a body sways, breath lifts no leg, and
stripes show how fast each place moved: a person who was followed leaves little that only poles
    explain.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from bodyscan.alignment.body_motion import ARM_MM, BodyMotion
from bodyscan.alignment.pole_steps import FEWEST, STEP_MM, STEPS_MM, PoleStep, moving_alone
from bodyscan.alignment.sway_prior import BODY_CENTRE
from bodyscan.arrays import Array, Mask
from bodyscan.geometry.transforms import RigidTransform

SURE = 12.0
"""Log of the likelihood ratio that steps must reach. No model of people is exact: in ten sound
scans of moving people it was -9 to 3, and 5.8 for a restless one; for poles 3 mm off it is 70 and
more. For single pairs it was -9 to 3 in thirteen sound scans, four of them restless; 530 for one 5
mm off."""
LEAST_OUT_MM = 0.3
"""2 mm of a girth; for ten sound people it was 0.22 mm at most."""


@dataclass(frozen=True)
class SizeStep:
    """All poles stand farther from the body than calibrated, or nearer.

    out_mm: how much farther, negative for nearer; every radius of the body was too small by that.
    sigma_mm: its standard deviation.
    """

    out_mm: float
    sigma_mm: float


@dataclass(frozen=True, eq=False)
class PlaceEvidence:
    """What a scan says about P pairs' places, whatever the person may have done meanwhile.

    information, pull: normal equations (6P, 6P), (6P,) of motions, pair after pair, by which the
        pairs stand off beyond what their calibration left open.
    """

    names: tuple[str, ...]
    information: Array
    pull: Array

    @staticmethod
    def of(names: Collection[str], motion: BodyMotion) -> PlaceEvidence:
        return PlaceEvidence(tuple(names), *motion.asked_of_poses())

    def of_steps(self, ways: Array) -> _Told:
        """Evidence for motions along `ways` (6P, k), at the size in mm that explains it best."""
        square, pull = ways.T @ self.information @ ways, ways.T @ self.pull
        own = np.eye(len(pull))
        found = []
        for size_mm in STEPS_MM:
            covariance = np.linalg.inv(square + own / size_mm**2)
            volume = np.linalg.slogdet(own + size_mm**2 * square)[1]
            gain = float(0.5 * pull @ covariance @ pull - 0.5 * volume)
            found.append(_Told(gain, covariance @ pull, covariance))
        return max(found, key=lambda told: told.gain)


@dataclass(frozen=True, eq=False)
class _Told:
    """gain: log of the likelihood ratio of steps against none.  steps (k,) mm, with their
    covariance (k, k)."""

    gain: float
    steps: Array
    covariance: Array


def find_off(
    seen: PlaceEvidence,
    rig_from_camera: Mapping[str, RigidTransform],
    poles: Mapping[str, str],
    freed: Collection[str] = (),
) -> PoleStep | SizeStep | None:
    """Find what explains a scan better than any motion of the person.

    That is one pole or pair that stands off, each pole by itself (`all_moved`), or all of them
    farther out or nearer.

    rig_from_camera: as calibrated.
    poles: the pole of each pair that stands on one.
    freed: pairs of poles that are known to have moved.
    """
    sides = [poles.get(name, name) for name in seen.names]
    if len(set(sides)) < 2 or not set(seen.names) - set(freed):
        return None
    found: list[tuple[float, PoleStep | SizeStep]] = []
    for name, pairs in _moving_alone(seen.names, poles).items():
        if pairs.isdisjoint(freed):
            told = seen.of_steps(_ways(np.isin(seen.names, list(pairs))))
            found.append((told.gain, _step(name, pairs, told.steps)))
    if not freed:
        ways = {side: _ways(np.equal(sides, side)) for side in dict.fromkeys(sides)}
        each = seen.of_steps(np.hstack(list(ways.values())))
        apart = each.steps.reshape(-1, 6) - each.steps.reshape(-1, 6).mean(axis=0)
        farthest = int(np.argmax(np.linalg.norm(apart, axis=1)))
        side = list(ways)[farthest]
        pairs = frozenset(np.array(seen.names)[np.equal(sides, side)].tolist())
        step = replace(_step(f"pole {side}", pairs, apart[farthest]), all_moved=True)
        found.append((each.gain, step))
        size = seen.of_steps(_outward(seen.names, sides, rig_from_camera).reshape(-1, 1))
        sigma_mm = float(np.sqrt(size.covariance[0, 0]))
        found.append((size.gain, SizeStep(float(size.steps[0]), sigma_mm)))
    gain, best = max(found, key=lambda one: one[0], default=(0.0, None))
    return best if best and gain > SURE and _does_harm(best) else None


def _does_harm(found: PoleStep | SizeStep) -> bool:
    if isinstance(found, SizeStep):
        return abs(found.out_mm) > LEAST_OUT_MM
    return float(np.hypot(found.shift_mm, ARM_MM * np.radians(found.turn_deg))) > STEP_MM


def _moving_alone(names: Sequence[str], poles: Mapping[str, str]) -> dict[str, frozenset[str]]:
    """Poles of several pairs, and single pairs if there are enough to tell which one it is."""
    return {
        name: pairs
        for name, pairs in moving_alone(names, poles).items()
        if len(pairs) > 1 or len(names) >= FEWEST
    }


def _step(name: str, pairs: frozenset[str], steps: Array) -> PoleStep:
    """A step of these pairs; steps: (6,) mm, as in `_ways`."""
    shift, turn = np.linalg.norm(steps.reshape(2, 3), axis=1)
    return PoleStep(name, pairs, float(shift), float(np.degrees(turn / ARM_MM)))


def _ways(own: Mask) -> Array:
    """Rigid motions (6P, 6) of the pairs (P,) that move as one.

    Shifts of the body's centre by 1 mm, then turns about it that move a point at arm's length by 1
    mm.
    """
    rigid = np.zeros((6, 6))
    rigid[3:, :3] = np.eye(3)
    rigid[:3, 3:] = np.eye(3) / ARM_MM
    rigid[3:, 3:] = -np.cross(np.eye(3) / ARM_MM, BODY_CENTRE).T
    return np.asarray(np.kron(own.astype(float)[:, None], rigid))


def _outward(
    names: Collection[str], sides: list[str], rig_from_camera: Mapping[str, RigidTransform]
) -> Array:
    """(P, 6): each pair moved level by 1 mm away from the body, all pairs of a pole alike."""
    away = np.array([rig_from_camera[name].translation - BODY_CENTRE for name in names])
    away[:, 2] = 0.0
    out = np.zeros((len(away), 6))
    for side in dict.fromkeys(sides):
        own = np.equal(sides, side)
        middle = away[own].mean(axis=0)
        out[own, 3:] = middle / np.linalg.norm(middle)
    return out
