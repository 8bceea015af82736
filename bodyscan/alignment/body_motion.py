"""How a person's surface moved between the pairs' moments, solved from all overlaps together.

Several kinds of motion compete to explain the overlaps: the whole body leans above its ankles or
moves in any other way, head and arms turn about their joints or shift, any part shifts, the trunk
breathes. Each is a Gaussian process over surface and time, as large as the evidence says; with them
is solved what the boards left open of the pairs' poses.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np
from scipy.linalg import cho_solve
from scipy.linalg.lapack import dpotrf, dpotri, dtrtri, dtrtrs

from bodyscan.alignment.body_cells import BodyCells, modulated, rigid_fields
from bodyscan.alignment.breath import breath_fields, likely_breath
from bodyscan.alignment.cell_evidence import CellEvidence
from bodyscan.alignment.limbs import limb_fields
from bodyscan.alignment.moments import Courses, breaths, of_breath, of_stance
from bodyscan.alignment.part_names import above_feet, ankles
from bodyscan.alignment.sway_prior import BODY_CENTRE
from bodyscan.arrays import Array, Indices
from bodyscan.geometry.linear_gaussian import invert_scaled
from bodyscan.geometry.transforms import RigidTransform, adjoint
from bodyscan.progress import map_threads

LEAN_MM = 1000.0  # the middle of a body above the ankles: a unit of lean moves it by 1 mm
PART_MM = 250.0  # extent of what moves as one: a forearm, half a thigh, a shoulder
LEAST_PART = 0.02
ARM_MM = 400.0  # at this distance a part's turn displaces as much as its shift
FIRST_MM, WHOLE_MM = 1.0, 2.0
SIZINGS = 3
"""Resizings in each round: what the evidence does not ask for shrinks step by step."""
SMALLEST_MM = 1e-3
PARTS_SHARE = 1 / 15
"""How far parts above the legs may have moved unseen, relative to the breath found: 0.1 mm in those who
stand, 0.25 in the restless. Evidence sizes the parts of the whole body at once, and legs that stood
still say nothing about a hip; but who breathes and stirs little moves a hip little."""
APART_MM = 0.07
"""mm between the surfaces of two pairs in a cell that no motion of the body explains: calibrations
are bent by 0.05 mm each, which no number of matches averages out."""


@dataclass(frozen=True, eq=False)
class Kind:
    """One kind of motion: displacement fields, each along J courses.

    fields: (C, 12, M) mm.
    size: prior standard deviation of the amplitudes.
    precision: prior inverse covariance (M J, M J), instead of `size` where it is known.
    alike: prior covariance (J, J) of each field's amplitudes, where courses are not independent.
    twists: (6, M) about the rig's origin, if the body moves as a whole, apart from its feet.
    bends: fields less twists, (C, 12, M), which no pose of a pair accounts for.
    """

    name: str
    fields: Array
    courses: Courses
    size: float = FIRST_MM
    precision: Array | None = None
    alike: Array | None = None
    twists: Array | None = None
    bends: Array | None = None

    @staticmethod
    def whole(name: str, cells: BodyCells, twists: Array, courses: Courses) -> Kind:
        """A motion of the whole body."""
        fields = rigid_fields(cells, np.zeros(3), 1.0) @ twists
        return Kind(name, fields, courses, WHOLE_MM, twists=twists)

    @staticmethod
    def lean(cells: BodyCells, courses: Courses) -> Kind:
        """A lean about the ankles, as an inverted pendulum (Winter 1995), and a turn; feet stay.

        Other sway of the whole body is smaller, and no larger than the evidence asks for.
        """
        about_ankles = adjoint(RigidTransform.from_translation(ankles(cells)))[:, :3] / LEAN_MM
        whole = Kind.whole("lean", cells, about_ankles, courses)
        fields = modulated(whole.fields, cells, above_feet(cells)[:, None])
        return replace(whole, fields=fields, bends=fields - whole.fields)

    @property
    def count(self) -> int:
        return self.fields.shape[2] * self.courses.count

    @property
    def moves(self) -> bool:
        """Whether the motion is the person's rather than an error of the pairs."""
        return self.precision is None

    @property
    def prior(self) -> Array:
        if self.precision is not None:
            return self.precision
        if self.alike is not None:
            return np.kron(np.eye(self.fields.shape[2]), np.linalg.inv(self.alike))
        return np.eye(self.count) / self.size**2

    def during(self, pair: int) -> Array:
        """Courses (J,) from the middle to a pair's moment; for pose errors, at that moment."""
        return self.courses.values[pair] - self.courses.middle


@dataclass(frozen=True, eq=False)
class BodyMotion:
    """The amplitudes of all kinds of motion.

    fields: of all kinds, (C, 12, M).
    amplitudes: of the fields along their courses, (n,).
    normal: lower triangle of the information on them without any prior, (n, n).
    pull: its right-hand side, (n,).
    factor: lower Cholesky factor (n, n) of their inverse covariance in units (n,).
    breaths: possible breaths (K, J, J) and their prior probabilities (K,), see `moments.breaths`.
    """

    kinds: tuple[Kind, ...]
    fields: Array
    amplitudes: Array
    normal: Array
    pull: Array
    factor: Array
    units: Array
    breaths: tuple[Array, Array]

    @staticmethod
    def start(
        cells: BodyCells, seconds: Sequence[float | None], boards: Array, sway: Array
    ) -> BodyMotion:
        """The state before anything has moved.

        seconds: each pair's moment, None if not known.
        boards: covariance (6P, 6P) of the pairs' poses.
        sway: standard deviations (6,) of a usual turn (radians) and shift (mm) about the body's
            centre.
        """
        stance, pairs = Courses.of(of_stance, seconds), len(seconds)
        by_freedom = np.arange(6 * pairs).reshape(pairs, 6).T.ravel()
        known = invert_scaled(boards)[np.ix_(by_freedom, by_freedom)]
        pose = Kind.whole("pose", cells, np.eye(6), Courses.steady(pairs))
        any_way = adjoint(RigidTransform.from_translation(BODY_CENTRE)) * sway
        shifts = rigid_fields(cells, np.zeros(3), ARM_MM)[:, :, 3:]
        any_part = modulated(shifts, cells, cells.alike(PART_MM, LEAST_PART))
        rising = Courses.of(of_breath, seconds)
        kinds = (
            replace(pose, precision=known),
            Kind.lean(cells, stance),
            Kind.whole("sway", cells, any_way, stance),
            *(Kind(name, field, stance) for name, field in limb_fields(cells, ARM_MM).items()),
            Kind("parts", any_part, stance),
            Kind("breath", breath_fields(cells), rising, alike=np.eye(rising.count)),
        )
        count = sum(kind.count for kind in kinds)
        nothing, none = np.zeros((count, count)), np.zeros(count)
        fields = np.concatenate([kind.fields for kind in kinds], axis=2)
        known_breaths = breaths(rising, seconds)
        return BodyMotion(
            kinds, fields, none, nothing, none, nothing, np.ones(count), known_breaths
        )

    @cached_property
    def slices(self) -> tuple[slice, ...]:
        """Where each kind's amplitudes are."""
        ends = np.cumsum([0, *(kind.count for kind in self.kinds)]).tolist()
        return tuple(slice(a, b) for a, b in pairwise(ends))

    @cached_property
    def covariance(self) -> Array:
        """Covariance of the amplitudes, (n, n)."""
        lower = np.tril(dpotri(self.factor, lower=True)[0])
        return (lower + np.tril(lower, -1).T) * self.units[:, None] * self.units

    def covariance_of(self, some: slice) -> Array:
        """Block of `covariance` for some amplitudes, (m, m), without working out the rest."""
        unit = np.zeros((len(self.units), some.stop - some.start), order="F")
        unit[some] = np.diag(self.units[some])
        solved = dtrtrs(self.factor, unit, lower=True, overwrite_b=True)[0]
        return np.asarray(solved.T @ solved, np.float64)

    @property
    def variances(self) -> Array:
        """Variances of the amplitudes, (n,): all a round needs, at half the covariance's cost."""
        root = dtrtri(self.factor, lower=True)[0]
        return np.asarray(np.einsum("ij,ij->j", root, root) * self.units**2, np.float64)

    def kind(self, name: str) -> Kind:
        return next(kind for kind in self.kinds if kind.name == name)

    def twist(self, pair: int, *, from_middle: bool = False) -> Array:
        """A pair's own error and the motion of the whole person, (6,), about the rig's origin."""
        total = np.zeros(6)
        for kind in self.kinds:
            if kind.twists is not None:
                course = kind.during(pair) if from_middle else kind.courses.values[pair]
                total += kind.twists @ self.of(kind.name, course)
        return total

    def of(self, name: str, course: Array) -> Array:
        """Amplitudes (M, ...) of one kind's fields along courses (J, ...)."""
        k = self.kinds.index(self.kind(name))
        return np.asarray(self.amplitudes[self.slices[k]].reshape(-1, len(course)) @ course)

    def displacements(self, names: Sequence[str], *, from_middle: bool = False) -> Array:
        """Displacements (P, C, 12) mm by those kinds at each pair's moment."""
        return self._sum({k.name: k.fields for k in self.kinds if k.name in names}, from_middle)

    def bends(self, *, from_middle: bool = False) -> Array:
        """Displacements (P, C, 12) mm by all kinds, apart from `twist`."""
        beside = {k.name: k.fields if k.twists is None else k.bends for k in self.kinds}
        return self._sum({n: f for n, f in beside.items() if f is not None}, from_middle)

    def _sum(self, fields: Mapping[str, Array], from_middle: bool) -> Array:
        total = np.zeros((self.fields.shape[0] * 12, len(self.kinds[0].courses.values)))
        for name, field in fields.items():
            courses = self.kind(name).courses
            course = courses.values - (courses.middle if from_middle else 0.0)
            total += field.reshape(len(total), -1) @ self.of(name, course.T)
        return total.T.reshape(total.shape[1], -1, 12)

    def solved(self, evidence: Mapping[tuple[int, int], CellEvidence]) -> BodyMotion:
        """One step of all amplitudes, with each kind as large as the evidence says.

        Every round searches matches again.

        evidence: by pairs (a, b).
        """
        now = self.displacements([kind.name for kind in self.kinds])

        def asked_of(overlap: tuple[tuple[int, int], CellEvidence]) -> tuple[Array, Array]:
            (a, b), seen = overlap
            return self._asked(seen.doubted(APART_MM), now[a] - now[b])

        asked = map_threads(asked_of, evidence.items(), stage="aligning")
        squares, pulls = zip(*asked, strict=True)
        square, pull = np.array(squares), np.array(pulls)
        first, second = np.array(list(evidence)).T
        ends = np.cumsum([0, *(kind.fields.shape[2] for kind in self.kinds)])
        apart = [k.courses.values[first] - k.courses.values[second] for k in self.kinds]
        count = len(self.amplitudes)
        normal, total = np.zeros((count, count), order="F"), np.zeros(count)
        for g, kind in enumerate(self.kinds):
            own, rows = slice(ends[g], ends[g + 1]), self.slices[g]
            total[rows] = (pull[:, own].T @ apart[g]).ravel()
            for h, other in enumerate(self.kinds[: g + 1]):
                block = square[:, own, ends[h] : ends[h + 1]]
                normal[rows, self.slices[h]] = _products(block, apart[g], apart[h]).reshape(
                    kind.count, other.count
                )
        motion = replace(self, normal=normal, pull=total)._settled()._in_breath()._settled()
        for _ in range(SIZINGS):
            motion = motion._resized()._settled()
        return motion

    def doubted(self) -> Array:
        """Covariance (n, n) of the amplitudes if parts had moved as in people who breathe so."""
        breath = self.kind("breath").alike
        assert breath is not None
        least = PARTS_SHARE * float(np.sqrt(np.linalg.eigvalsh(breath)[-1]))
        kinds = (
            replace(kind, size=max(kind.size, least)) if kind.name == "parts" else kind
            for kind in self.kinds
        )
        return replace(self, kinds=tuple(kinds))._settled().covariance

    def asked_of_poses(self) -> tuple[Array, Array]:
        """Normal equations (6P, 6P), (6P,) of pose errors, a motion (6,) for each pair.

        The errors are those beyond what the boards left open, whatever the person may have done.
        """
        pose = self.slices[0]
        # Poses come first: their columns of the lower triangle are complete except for their own
        # block.
        seen = self.normal[:, pose].copy()
        seen[pose] = np.tril(seen[pose]) + np.tril(seen[pose], -1).T
        information = seen[pose] - seen.T @ self.covariance @ seen
        pull = self.pull[pose] - seen.T @ self.amplitudes
        by_pair = np.arange(len(pull)).reshape(6, -1).T.ravel()
        return information[np.ix_(by_pair, by_pair)], pull[by_pair]

    def _asked(self, seen: CellEvidence, apart: Array) -> tuple[Array, Array]:
        """What an overlap asks of the fields, (M, M), (M,); apart: (C, 12) of its pairs now."""
        fields = self.fields[seen.cells]
        basis = fields.reshape(-1, fields.shape[2])
        wanted = np.einsum("cij,cj->ci", seen.information, apart[seen.cells]) - seen.gradient
        return basis.T @ (seen.information @ fields).reshape(basis.shape), basis.T @ wanted.ravel()

    def _settled(self) -> BodyMotion:
        """The motion that solves the normal equations with the prior.

        They grow with the number of pairs, so the matrix is laid out for LAPACK to work in place.
        """
        normal = self.normal.copy(order="F")
        for kind, own in zip(self.kinds, self.slices, strict=True):
            normal[own, own] += kind.prior
        units = 1.0 / np.sqrt(np.diag(normal))
        normal *= units[:, None]
        normal *= units
        factor, failed = dpotrf(normal, lower=True, overwrite_a=True)
        if failed:
            raise np.linalg.LinAlgError("what was seen of a motion leaves its amplitudes open")
        amplitudes = units * cho_solve((factor, True), units * self.pull, check_finite=False)
        return replace(self, amplitudes=amplitudes, factor=factor, units=units)

    def _in_breath(self) -> BodyMotion:
        """Estimate the breath from the evidence, whatever else moved.

        Motions of limbs could explain most of a breath too, but none of them comes and goes like a
        breath on the whole trunk at once.
        """
        breath = self.kind("breath")
        own = self.slices[self.kinds.index(breath)]
        known = np.linalg.inv(self.covariance_of(own))
        seen = known - breath.prior
        alike = likely_breath(seen, known @ self.amplitudes[own], *self.breaths)
        kinds = (replace(k, alike=alike) if k is breath else k for k in self.kinds)
        return replace(self, kinds=tuple(kinds))

    def _resized(self) -> BodyMotion:
        """Make each kind as large as the evidence says (MacKay 1992); unneeded ones shrink."""
        kinds, variances = [], self.variances
        for kind, some in zip(self.kinds, self.slices, strict=True):
            if kind.precision is None and kind.alike is None:
                told = kind.count - np.sum(variances[some]) / kind.size**2
                size = np.sqrt(np.sum(self.amplitudes[some] ** 2) / max(told, 1e-6))
                kind = replace(kind, size=max(float(size), SMALLEST_MM))
            kinds.append(kind)
        return replace(self, kinds=tuple(kinds))


def _products(block: Array, first: Array, second: Array) -> Array:
    """(M, J, N, K): sums over overlaps of (O, M, N) times courses (O, J) and (O, K)."""
    flat = block.reshape(len(block), -1)
    courses = (first[:, :, None] * second[:, None, :]).reshape(len(block), -1)
    shape = (*block.shape[1:], first.shape[1], second.shape[1])
    return np.asarray((flat.T @ courses).reshape(shape).transpose(0, 2, 1, 3))


def _along(kind: Kind, cells: Indices, normals: Array, course: Array) -> Array:
    along = np.einsum("cim,ci->cm", kind.fields[cells, :3], normals)
    return (along[:, :, None] * course).reshape(len(cells), -1)


def outward_errors(motion: BodyMotion, name: str, course: Array, normals: Array) -> Array:
    """Uncertainty of one kind's displacement along normals (C, 3), as independent errors.

    course: (J,).

    Returns (C, n): the effects of n errors of standard deviation 1.
    """
    kind = motion.kind(name)
    own = motion.slices[motion.kinds.index(kind)]
    rows = _along(kind, np.arange(len(normals)), normals, course)
    sizes, ways = np.linalg.eigh(motion.covariance[own, own])
    return np.asarray(rows @ (ways * np.sqrt(np.maximum(sizes, 0.0))))


def observed(motion: BodyMotion, pair: int, cells: Indices, normals: Array) -> Array:
    """(c, n): displacement by each amplitude of cells along normals (c, 3), as a pair saw them.

    Relative to the middle of the scan.
    """
    return np.hstack([_along(kind, cells, normals, kind.during(pair)) for kind in motion.kinds])
