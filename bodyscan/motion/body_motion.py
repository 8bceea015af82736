"""How a person's surface moved between the pairs' moments, estimated from all overlaps jointly.

Several kinds of motion compete to explain the overlaps (`motion_kinds`): the body leans above its
ankles or moves as a whole, head and arms rotate about their joints, parts shift, the trunk breathes.
Each is a Gaussian process over surface and time whose variance maximizes the evidence; what the
calibration left open of the pairs' poses is estimated with them.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np
from scipy import sparse
from scipy.linalg import cho_solve
from scipy.linalg.lapack import dpotrf, dtrtri, dtrtrs

from bodyscan.alignment.sway_prior import BODY_CENTRE
from bodyscan.arrays import Array, Indices, Mask
from bodyscan.geometry.linear_gaussian import LinearGaussianSystem
from bodyscan.motion.body_cells import BodyCells
from bodyscan.motion.breath import BreathEstimate, estimate_breath
from bodyscan.motion.cell_equations import CellEquations
from bodyscan.motion.motion_kinds import MotionKind, build_kinds, retime_kinds
from bodyscan.motion.temporal_modes import Breaths, TemporalModes
from bodyscan.progress import map_threads

MODEL_ERROR_MM = 0.07
"""Between the surfaces of two pairs in a cell, by no motion of the body: calibrations warp surfaces by
0.05 mm each, which no number of matches averages out."""


@dataclass(frozen=True, eq=False)
class BodyMotion:
    """Gaussian estimate of the n amplitudes of all kinds of motion."""

    kinds: tuple[MotionKind, ...]
    amplitudes: Array  # of the kinds' fields along their temporal modes, (n,)
    # information, vector: normal equations of the overlaps without prior; the matrix's lower
    # triangle, (n, n), and (n,).
    information: Array
    vector: Array
    factor: Array  # lower Cholesky factor of the posterior information, (n, n)
    breaths: Breaths
    breath: BreathEstimate | None = None  # see `estimate_breath`; None at rest

    @staticmethod
    def at_rest(
        cells: BodyCells,
        seconds: Sequence[float | None],
        middle_s: float,
        boards: Array,
        sway: Array,
    ) -> BodyMotion:
        """The state before anything has moved; arguments as in `build_kinds`."""
        kinds = build_kinds(cells, seconds, middle_s, boards, sway)
        count = sum(kind.count for kind in kinds)
        matrix, vector = np.zeros((count, count)), np.zeros(count)
        breaths = Breaths.from_modes(kinds[-1].modes, seconds, middle_s)
        return BodyMotion(kinds, vector, matrix, vector, matrix, breaths)

    def with_times(
        self,
        seconds: Sequence[float | None],
        middle_s: float,
        omitted: Collection[str] = ("parts",),
    ) -> BodyMotion:
        """At rest at other times of the pairs, without some kinds of motion."""
        kinds = retime_kinds(self.kinds, seconds, middle_s, omitted)
        vector = np.zeros(sum(kind.count for kind in kinds))
        breaths = Breaths.from_modes(kinds[-1].modes, seconds, middle_s)
        return replace(self, kinds=kinds, amplitudes=vector, breaths=breaths)

    def with_step(self, names: Sequence[str], members: Mask, size_mm: float) -> BodyMotion:
        """At rest, with one more kind `step`: a displacement along the named kinds' fields in the views
        of the member pairs (P,) alone.

        size_mm: prior standard deviation of its amplitudes.
        """
        fields = np.concatenate([kind.fields for kind in self.kinds if kind.name in names], axis=2)
        modes = TemporalModes(members.astype(float)[:, None], np.zeros(1))
        precision = np.eye(fields.shape[2]) / size_mm**2
        step = MotionKind("step", fields, modes, precision=precision)
        kinds = (*self.kinds[:-1], step, self.kinds[-1])
        return replace(self, kinds=kinds, amplitudes=np.zeros(sum(kind.count for kind in kinds)))

    @cached_property
    def fields(self) -> Array:
        """Of all kinds, (C, 12, M)."""
        return np.concatenate([kind.fields for kind in self.kinds], axis=2)

    @cached_property
    def slices(self) -> tuple[slice, ...]:
        """For each kind of motion, the slice of `amplitudes` that belongs to it."""
        ends = np.cumsum([0, *(kind.count for kind in self.kinds)]).tolist()
        return tuple(slice(a, b) for a, b in pairwise(ends))

    def whiten(self, columns: Array) -> Array:
        """W (n, K): W^T W is the posterior covariance of the columns' (n, K) sums of amplitudes."""
        return np.asarray(dtrtrs(self.factor, columns, lower=True)[0])

    @property
    def variances(self) -> Array:
        """Posterior variances of the amplitudes, (n,)."""
        inverse = dtrtri(self.factor, lower=True)[0]
        return np.asarray(np.einsum("ij,ij->j", inverse, inverse))

    @property
    def log_evidence(self) -> float:
        """Of the overlaps under the present prior variances, relative to a body that nothing moved."""
        gain = float(self.vector @ self.amplitudes) - 2.0 * np.sum(np.log(np.diag(self.factor)))
        priors = sum(float(np.linalg.slogdet(kind.prior_information)[1]) for kind in self.kinds)
        return 0.5 * (gain + priors)

    def kind(self, name: str) -> MotionKind:
        return next(kind for kind in self.kinds if kind.name == name)

    def amplitudes_at(self, name: str, modes: Array) -> Array:
        """Amplitudes (M, ...) of one kind's fields where its modes have the values (J, ...)."""
        k = self.kinds.index(self.kind(name))
        return np.asarray(self.amplitudes[self.slices[k]].reshape(-1, len(modes)) @ modes)

    def twist(self, pair: int, *, from_middle: bool = False) -> Array:
        """Twist (6,) about the rig's origin by a pair's pose error and the whole body's motion."""
        total = np.zeros(6)
        for kind in self.kinds:
            if kind.twists is not None:
                modes = kind.modes_from_middle(pair) if from_middle else kind.modes.values[pair]
                total += kind.twists @ self.amplitudes_at(kind.name, modes)
        return total

    def displacements(self, names: Sequence[str], *, from_middle: bool = False) -> Array:
        """Displacement fields (P, C, 12) mm by the named kinds at each pair's moment."""
        return self._sum_fields(
            {k.name: k.fields for k in self.kinds if k.name in names}, from_middle
        )

    def non_rigid(self, *, from_middle: bool = False) -> Array:
        """Displacement fields (P, C, 12) mm by all kinds, less `twist`."""
        fields = {k.name: k.fields if k.twists is None else k.remainder for k in self.kinds}
        return self._sum_fields({n: f for n, f in fields.items() if f is not None}, from_middle)

    def _sum_fields(self, fields: Mapping[str, Array], from_middle: bool) -> Array:
        total = np.zeros((self.fields.shape[0] * 12, len(self.kinds[0].modes.values)))
        for name, field in fields.items():
            modes = self.kind(name).modes
            values = modes.values - (modes.middle if from_middle else 0.0)
            total += field.reshape(len(total), -1) @ self.amplitudes_at(name, values.T)
        return total.T.reshape(total.shape[1], -1, 12)

    def find_fields(self, names: Sequence[str]) -> Indices:
        """Numbers of the named kinds' fields among all M."""
        named = [np.full(kind.fields.shape[2], kind.name in names) for kind in self.kinds]
        return np.flatnonzero(np.concatenate(named))

    def project(
        self, equations: Mapping[tuple[int, int], CellEquations]
    ) -> dict[tuple[int, int], LinearGaussianSystem]:
        """Normal equations of the M fields' displacement between each two pairs, whatever the moments.

        equations: by pairs (a, b), linearized at this motion.
        """
        current = self.displacements([kind.name for kind in self.kinds])

        def project(overlap: tuple[tuple[int, int], CellEquations]) -> LinearGaussianSystem:
            (a, b), cells = overlap
            return self._project(cells.with_model_error(MODEL_ERROR_MM), current[a] - current[b])

        systems = map_threads(project, equations.items())
        return dict(zip(equations, systems, strict=True))

    def solve_projected(
        self, projected: Mapping[tuple[int, int], LinearGaussianSystem], updates: int = 3
    ) -> BodyMotion:
        """Estimate all amplitudes, and each kind's prior variance, in one Gauss-Newton step.

        projected: by pairs (a, b), see `project`.
        updates: how often the prior variances are updated; once is enough in a coarse round.
        """
        matrices = np.array([system.information for system in projected.values()])
        vectors = np.array([system.vector for system in projected.values()])
        first, second = np.array(list(projected)).T
        ends = np.cumsum([0, *(kind.fields.shape[2] for kind in self.kinds)])
        differences = [k.modes.values[first] - k.modes.values[second] for k in self.kinds]
        count = len(self.amplitudes)
        information, total = np.zeros((count, count), order="F"), np.zeros(count)
        for g, kind in enumerate(self.kinds):
            columns, rows = slice(ends[g], ends[g + 1]), self.slices[g]
            total[rows] = (vectors[:, columns].T @ differences[g]).ravel()
            for h, other in enumerate(self.kinds[: g + 1]):
                block = matrices[:, columns, ends[h] : ends[h + 1]]
                information[rows, self.slices[h]] = _sum_products(
                    block, differences[g], differences[h]
                ).reshape(kind.count, other.count)
        motion = replace(self, information=information, vector=total)
        motion = motion._solve()._estimate_breath()._solve()
        for _ in range(updates):  # variances that the overlaps do not require shrink step by step
            motion = motion._update_prior_variances()._solve()
        return motion

    def pose_equations(self) -> LinearGaussianSystem:
        """Normal equations of pose errors beyond the calibration's uncertainty.

        Twists (6,), pair after pair, marginalized over everything else (Schur complement).
        """
        pose = self.slices[0]
        # Poses come first: their columns of the lower triangle are complete but for their own block.
        columns = self.information[:, pose].copy()
        columns[pose] = np.tril(columns[pose]) + np.tril(columns[pose], -1).T
        whitened = self.whiten(columns)
        information = columns[pose] - whitened.T @ whitened
        vector = self.vector[pose] - columns.T @ self.amplitudes
        by_pair = np.arange(len(vector)).reshape(6, -1).T.ravel()
        return LinearGaussianSystem(information, vector).select(by_pair)

    def step_equations(
        self,
        projected: Mapping[tuple[int, int], LinearGaussianSystem],
        names: Sequence[str],
        members: Mask,
    ) -> LinearGaussianSystem:
        """Normal equations of a step: a displacement along the named kinds' K fields in the views of
        the member pairs (P,) alone, marginalized over the motion and the poses.

        projected: by pairs (a, b), see `project`.
        """
        fields = self.find_fields(names)
        sign = np.array([float(members[a]) - float(members[b]) for a, b in projected])
        matrices = np.array([system.information[fields] for system in projected.values()])
        vector = sign @ np.array([system.vector[fields] for system in projected.values()])
        first, second = np.array(list(projected)).T
        ends = np.cumsum([0, *(kind.fields.shape[2] for kind in self.kinds)])
        cross = np.hstack(
            [
                np.einsum(
                    "okm,oj->kmj",
                    matrices[:, :, ends[g] : ends[g + 1]],
                    sign[:, None] * (kind.modes.values[first] - kind.modes.values[second]),
                ).reshape(len(fields), -1)
                for g, kind in enumerate(self.kinds)
            ]
        )
        whitened = self.whiten(cross.T)
        information = np.tensordot(sign**2, matrices[:, :, fields], 1) - whitened.T @ whitened
        return LinearGaussianSystem(information, vector - cross @ self.amplitudes)

    def observation_matrix(self, pair: int, cells: Indices, normals: Array) -> Array:
        """Jacobian (c, n) of displacements along normals (c, 3) from the middle to a pair's moment."""
        parts = []
        for kind in self.kinds:
            along = np.einsum("cim,ci->cm", kind.fields[cells, :3], normals)
            parts.append((along[:, :, None] * kind.modes_from_middle(pair)).reshape(len(cells), -1))
        return np.hstack(parts)

    def _project(self, equations: CellEquations, offset: Array) -> LinearGaussianSystem:
        """Project an overlap's normal equations onto the M fields.

        offset: displacement (C, 12) of its pairs at present, at which they were linearized.
        """
        information, vector = equations.system.information, equations.system.vector
        vector = np.einsum("cij,cj->ci", information, offset[equations.cells]) + vector
        return LinearGaussianSystem(information, vector).project(self.fields[equations.cells])

    def _solve(self) -> BodyMotion:
        """Solve the normal equations with the prior, in place by LAPACK. The unknowns' units do not
        matter to Cholesky's method (Demmel 1989): nothing is scaled."""
        matrix = self.information.copy(order="F")
        for kind, block in zip(self.kinds, self.slices, strict=True):
            matrix[block, block] += kind.prior_information
        factor, failed = dpotrf(matrix, lower=True, overwrite_a=True)
        if failed:
            raise np.linalg.LinAlgError("the overlaps do not determine the motion")
        amplitudes = cho_solve((factor, True), self.vector, check_finite=False)
        return replace(self, amplitudes=amplitudes, factor=factor)

    def _estimate_breath(self) -> BodyMotion:
        """Estimate the breath, and set its prior covariance, marginalized over all other motion.
        Motions of limbs could explain most of a breath too, but none of them moves the whole trunk
        periodically."""
        breath, block = self.kinds[-1], self.slices[-1]
        if breath.name != "breath":
            return self
        # Of the last amplitudes the corner of the factor is that of their marginal information.
        corner = self.factor[block, block]
        posterior = corner @ corner.T
        system = LinearGaussianSystem(
            posterior - breath.prior_information, posterior @ self.amplitudes[block]
        )
        found = estimate_breath(system, self.breaths, breath.modes.middle)
        fields = breath.fields.shape[2]
        precision = np.kron(np.eye(fields), np.linalg.inv(found.mode_covariance))
        kinds = (replace(k, precision=precision) if k is breath else k for k in self.kinds)
        return replace(self, kinds=tuple(kinds), breath=found)

    def _update_prior_variances(self) -> BodyMotion:
        """Update each kind's prior variance by type-II maximum likelihood (MacKay 1992).

        The usual size counts as much as the six amplitudes of a rigid motion: what the overlaps
        hardly see did not stand still.
        """
        kinds, variances = [], self.variances
        for kind, block in zip(self.kinds, self.slices, strict=True):
            if kind.precision is None:
                determined = kind.count - np.sum(variances[block]) / kind.size**2
                square = np.sum(self.amplitudes[block] ** 2) + 6.0 * kind.standing_size**2
                size = float(np.sqrt(square / (max(determined, 0.0) + 6.0)))
                kind = replace(kind, size=max(size, 1e-6))  # what stands still moves by a nanometre
            kinds.append(kind)
        return replace(self, kinds=tuple(kinds))


def compute_shape_sigmas(
    motion: BodyMotion, cells: BodyCells, observed: Mask
) -> tuple[Array, Array]:
    """Standard deviations (C,) mm of the shape along the normals, without motions of the whole; and
    those of `compute_girth_sigmas`.

    observed: which pairs measured which cells, (P, C).

    Computed at the landmarks and interpolated with a Gaussian kernel of 60 mm.
    """
    pair, mark = np.nonzero(observed[:, cells.landmarks])
    cell = cells.landmarks[mark]
    rows = np.concatenate([
        motion.observation_matrix(k, cell[pair == k], cells.normals[cell[pair == k]])
        for k in np.unique(pair)
    ])  # fmt: skip
    offsets, normals = cells.centres[cell] - BODY_CENTRE, cells.normals[cell]
    rigid = np.linalg.qr(np.hstack([np.cross(offsets, normals), normals]))[0]
    rows -= rigid @ (rigid.T @ rows)
    # A point is the mean of what all pairs measured of it.
    views = np.bincount(mark, minlength=len(cells.landmarks))
    shape = len(views), len(mark)
    means = sparse.csr_array((1.0 / views[mark], (mark, np.arange(len(mark)))), shape=shape) @ rows
    errors, marks = motion.whiten(means.T).T, cells.landmarks
    girth = compute_girth_sigmas(errors, cells.centres[marks], cells.normals[marks], 60.0)
    variances = np.stack([np.sum(errors**2, axis=1), girth**2])
    kernel = np.exp(-0.5 * (cells.landmark_distances / 60.0) ** 2) * (views > 0)[:, None]
    sigma, girth = np.sqrt(variances @ kernel / np.maximum(kernel.sum(axis=0), 1e-12))
    return sigma, girth


def compute_girth_sigmas(
    errors: Array, centres: Array, normals: Array, near_mm: float = 20.0
) -> Array:
    """Standard deviations (C,) mm of displacements with factor errors (C, n), as they affect a girth.

    Only what cells within `near_mm` of height share does, by the angle that a tape turns at each.
    """
    # In single precision: (C, C) weights, to a millionth.
    heights, errors = centres[:, 2].astype(np.float32), errors.astype(np.float32)
    kernel = np.exp(-0.5 * ((heights[:, None] - heights) / np.float32(near_mm)) ** 2)
    # Cells that face alike, within 0.2 rad, share one piece of the tape.
    level = normals[:, :2].astype(np.float32)
    level /= np.maximum(np.linalg.norm(level, axis=1, keepdims=True), np.float32(1e-6))
    near = np.exp((level @ level.T - 1.0) / np.float32(0.2**2))
    kernel /= np.sum(kernel * near, axis=0)
    sigma = np.linalg.norm(errors, axis=1)
    return sigma * np.linalg.norm(kernel @ errors, axis=1) / np.maximum(kernel @ sigma, 1e-12)


def _sum_products(block: Array, first: Array, second: Array) -> Array:
    """(M, J, N, K): sums over overlaps of (O, M, N) times (O, J) and (O, K)."""
    flat = block.reshape(len(block), -1)
    modes = (first[:, :, None] * second[:, None, :]).reshape(len(block), -1)
    shape = (*block.shape[1:], first.shape[1], second.shape[1])
    return np.asarray((flat.T @ modes).reshape(shape).transpose(0, 2, 1, 3))
