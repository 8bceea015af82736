"""Displacement of a trunk by breath: it swells forward and to its sides, away from its back."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import block_diag
from scipy.spatial.distance import cdist
from scipy.special import log_ndtr

from bodyscan.arrays import Array
from bodyscan.geometry.linear_gaussian import LinearGaussianSystem
from bodyscan.motion.body_cells import (
    BodyCells,
    build_rigid_fields,
    modulate_fields,
    pick_one_per_cube,
)
from bodyscan.motion.body_parts import PARTS, find_leftward, name_parts
from bodyscan.motion.temporal_modes import Breaths

SIZES_MM = np.array([0.7, 1.0, 1.4, 2.0, 2.8])
"""Standard deviations over time of the largest displacement: everyone's chest or belly moves by 2 to 8
mm at rest, however little of a breath a scan saw; 4 mm are a standard deviation of 1.4."""
COMMON = 3
"""Fields of the whole trunk: as one; chest against belly; and its width, since upper ribs mostly move
forward, lower ones mostly sideways."""


def build_breath_fields(cells: BodyCells) -> Array:
    """Displacement fields (C, 12, M): of the trunk as one, of chest against belly, in width
    alone, and of places forward and sideways.

    A breast, or the edge of the ribs, goes where the chest goes, whichever way its skin faces: the
    forward displacement is smoother than that along the normals. The fields are zero elsewhere.
    """
    axes = _find_level_axes(cells)
    level = build_rigid_fields(cells, np.zeros(3), 1.0)[..., 3:5] @ axes
    both = []
    # They meet between the navel and the end of the sternum.
    chest = _smoothstep(cells.centres[:, 2:] / cells.centres[:, 2].max(), 0.60, 0.68)
    for k, shape in enumerate(_evaluate_mean_shape(cells, axes).T[..., None]):
        wider = k * shape / 0.3
        local = _factor_local_covariance(cells.centres, shape)
        # By 0.35 of the front's common displacement; chest and belly breathe independently (Konno and
        # Mead 1967): standing, the chest has 0.5 to 0.8 of a breath (Sharp et al. 1975, J. Appl.
        # Physiol. 39), 1 to 4 times the belly's.
        varying = 0.35 * np.hstack([(2.0 * chest - 1.0) * shape, wider, local])
        both.append(modulate_fields(level[..., k : k + 1], cells, np.hstack([shape, varying])))
    common = sum(fields[..., :COMMON] for fields in both)
    return np.concatenate([common, *(fields[..., COMMON:] for fields in both)], axis=2)


def _factor_local_covariance(centres: Array, shape: Array) -> Array:
    """Low-rank factor (C, M) of a squared-exponential covariance of cells (C, 3), times shape (C, 1).

    The length is 80 mm: a breast, the side of a chest. A trunk's front is far from its back in a
    straight line too, so no geodesic distances are needed.
    """
    trunk = np.flatnonzero(shape)
    if not len(trunk):
        return np.zeros((len(centres), 0))
    landmarks = trunk[pick_one_per_cube(centres[trunk], 60.0)]
    covariance = np.exp(-0.5 * (cdist(centres, centres[landmarks]) / 80.0) ** 2)
    eigenvalues, eigenvectors = np.linalg.eigh(covariance[landmarks])
    kept = eigenvalues > 1e-3 * eigenvalues[-1]
    functions = covariance @ (eigenvectors[:, kept] / np.sqrt(eigenvalues[kept])) * shape
    eigenvalues, eigenvectors = np.linalg.eigh(functions.T @ functions)
    return np.asarray(functions @ eigenvectors[:, eigenvalues > 0.02 * eigenvalues[-1]])


@dataclass(frozen=True, eq=False)
class BreathEstimate:
    """What the overlaps tell of M breath fields along J temporal modes."""

    mode_covariance: Array  # of each field's amplitudes, (J, J)
    # at_middle, covariance: mean (M,) and covariance (M, M) of the fields mid-scan.
    at_middle: Array
    covariance: Array


def estimate_breath(
    system: LinearGaussianSystem, breaths: Breaths, middle: Array
) -> BreathEstimate:
    """Posterior moments over all breaths and sizes, each by its prior probability times its evidence.

    system: normal equations (M J,) of M fields along J modes, marginalized over all other motion.
    middle: the modes in the middle of the scan, (J,).

    How large a breath is shows in the common fields; what varies from place to place, and what is not
    periodic, has its typical size. If no moment is known all is irregular, and as large as it shows.
    """
    system = system * 0.3  # neighbouring cells share errors of calibrations: three count as one
    modes, fields = len(middle), system.size // len(middle)
    variances, typical = SIZES_MM**2, float(np.mean(SIZES_MM**2))
    if not breaths.waves.any():
        log_evidence = system.log_evidence(variances)
        likely = np.exp(log_evidence - log_evidence.max())
        typical = float(likely @ variances / likely.sum())
    waves = breaths.waves
    any_wave = np.einsum("k,kai,kbi->ab", breaths.priors, waves, waves)
    local = np.arange(fields)[:, None, None] >= COMMON
    other = typical * (breaths.irregular + local * any_wave)  # (M, J, J), of each field
    by_other = system.information.reshape(-1, fields, 1, modes) @ other
    known = np.column_stack([system.information, system.vector])
    certain = np.linalg.solve(np.eye(system.size) + by_other.reshape(2 * (system.size,)), known)
    information, vector = certain[:, :-1], certain[:, -1]
    first = COMMON * modes
    blocks = information[:first, :first].reshape(COMMON, modes, COMMON, modes)
    to_middle = np.kron(np.eye(fields), middle)
    correction = block_diag(*(middle @ other))
    remaining = correction @ (to_middle.T - information @ correction.T)
    of_common = (to_middle - correction @ information)[:, :first].reshape(fields, COMMON, modes)

    # Of every wave: log evidence (K, S) at each size, and the means (K, S, M) mid-scan.
    projected = np.einsum("kai,manb,kbj->kminj", waves, blocks, waves, optimize=True)
    eigenvalues, basis = np.linalg.eigh(projected.reshape(-1, 2 * COMMON, 2 * COMMON))
    by_field = vector[:first].reshape(COMMON, modes) @ waves
    along = by_field.reshape(-1, 1, 2 * COMMON) @ basis
    carried = np.tensordot(of_common, waves, (2, 1)).transpose(2, 0, 1, 3)
    carried = carried.reshape(len(waves), fields, -1) @ basis
    inflation = 1.0 + variances[:, None] * np.maximum(eigenvalues, 0.0)[:, None]
    gains = variances[:, None] / inflation
    log_evidence = 0.5 * np.sum(gains * along**2 - np.log(inflation), axis=2)
    # Whoever breathes in comes forward, and is carried back.
    forward = basis[:, :1]
    size, sigma = np.sum(gains * along * forward, 2), np.sqrt(np.sum(gains * forward**2, 2))
    log_evidence += log_ndtr(-size / sigma)
    means = (gains * along) @ carried.transpose(0, 2, 1)

    weights = breaths.priors[:, None] * np.exp(log_evidence - log_evidence.max())
    weights /= weights.sum()
    mean = np.tensordot(weights, means, 2)
    spread = (np.sqrt(weights)[..., None] * (means - mean)).reshape(-1, fields)
    within = carried * np.sqrt(np.sum(weights[..., None] * gains, axis=1, keepdims=True))
    second = spread.T @ spread + np.tensordot(within, within, ((0, 2), (0, 2)))
    periodic = np.tensordot((weights @ variances)[:, None, None] * waves, waves, ((0, 2), (0, 2)))
    return BreathEstimate(
        periodic + typical * breaths.irregular, correction @ vector + mean, remaining + second
    )


def project_breath_on_normals(cells: BodyCells) -> Array:
    """Displacement (C,) along the normals by a breath that moves the trunk's front by 1 mm."""
    axes = _find_level_axes(cells)
    displacement = _evaluate_mean_shape(cells, axes) @ axes.T
    return np.asarray(np.sum(displacement * cells.normals[:, :2], axis=1))


def _evaluate_mean_shape(cells: BodyCells, axes: Array) -> Array:
    """Displacement (C, 2) along `axes` (forward, leftward) by a breath of 1 mm at the trunk's front.

    Ribs turn about the spine and a belly swells in front of it: displacement grows linearly with the
    distance from the back, and sideways with the distance from the middle, to 0.3 at the sides (1 to
    2 mm for 3 to 5 at the ribs: De Groote et al. 1997, J. Appl. Physiol. 83).
    """
    stature = cells.centres[:, 2].max()
    height = cells.centres[:, 2] / stature
    # A belly's wall begins at the pubic bone and moves most at the navel; ribs end at the collarbones.
    at_height = _smoothstep(height, 0.51, 0.60) * (1.0 - _smoothstep(height, 0.79, 0.86))
    weight = at_height * (name_parts(cells) == PARTS.index("trunk"))
    breathes = weight > 0.5
    if not breathes.any():
        return np.zeros((len(weight), 2))
    position = cells.centres[:, :2] @ axes
    low, high = np.percentile(position[breathes], (2.0, 98.0), axis=0)
    # At least a tenth of the stature deep and 0.15 wide, where less of a trunk was measured.
    deep, wide = np.maximum(high - low, np.multiply((0.1, 0.15), stature))
    forward = np.clip((position[:, 0] - high[0]) / deep + 1.0, 0.0, 1.0)
    sideways = np.clip((position[:, 1] - 0.5 * (low[1] + high[1])) / (0.5 * wide), -1.0, 1.0)
    return weight[:, None] * np.stack([forward, 0.3 * sideways], axis=1)


def _find_level_axes(cells: BodyCells) -> Array:
    """Unit vectors forward and to the left of the subject, as columns, (2, 2)."""
    left = find_leftward(cells)
    return np.array([[left[1], left[0]], [-left[0], left[1]]])


def _smoothstep(values: Array, low: float, high: float) -> Array:
    """0 below `low`, 1 above `high`, smooth between."""
    t = np.clip((values - low) / (high - low), 0.0, 1.0)
    return np.asarray(t * t * (3.0 - 2.0 * t))
