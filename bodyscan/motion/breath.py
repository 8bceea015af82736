"""Displacement of a trunk by breath: it swells forward and to its sides, away from its back."""

from __future__ import annotations

import numpy as np
from scipy.spatial.distance import cdist

from bodyscan.arrays import Array
from bodyscan.geometry.linear_gaussian import LinearGaussianSystem
from bodyscan.motion.body_cells import (
    BodyCells,
    modulate_fields,
    pick_one_per_cube,
    rigid_fields,
)
from bodyscan.motion.body_parts import PARTS, leftward, name_parts
from bodyscan.motion.temporal_modes import HARMONICS
from bodyscan.progress import map_threads

SIZES_MM = np.array([0.7, 1.0, 1.4, 2.0, 2.8])
"""Standard deviations over time of the largest displacement: everyone's chest or belly moves by 2 to 8
mm at rest, however little of a breath a scan saw; 4 mm are a standard deviation of 1.4."""


def breath_fields(cells: BodyCells) -> Array:
    """Displacement fields (C, 12, M): of the trunk as one, and of its places forward and sideways.

    A breast, or the edge of the ribs, goes where the chest goes, whichever way its skin faces: the
    forward displacement is smoother than that along the normals. The fields are zero elsewhere.
    """
    axes = _level_axes(cells)
    level = rigid_fields(cells, np.zeros(3), 1.0)[..., 3:5] @ axes
    both = []
    for k, shape in enumerate(_mean_shape(cells, axes).T[..., None]):
        # From place to place breath varies by 0.35 of the front's common displacement.
        functions = np.hstack([shape, 0.35 * _local_functions(cells.centres, shape)])
        both.append(modulate_fields(level[..., k : k + 1], cells, functions))
    common = sum(fields[..., :1] for fields in both)
    return np.concatenate([common, *(fields[..., 1:] for fields in both)], axis=2)


def _local_functions(centres: Array, shape: Array) -> Array:
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


def estimate_breath_covariance(
    information: Array, vector: Array, covariances: Array, priors: Array
) -> Array:
    """Posterior mean (J, J) of the covariance of a breath's amplitudes over all breaths and sizes.

    Each counts by its prior probability times its evidence.

    information, vector: normal equations (M J, M J), (M J,) of M fields along J temporal modes,
        marginalized over all other motion.
    covariances: of the possible breaths, (K, J, J).
    priors: their probabilities, (K,).
    """
    modes = covariances.shape[1]
    eigenvalues, eigenvectors = np.linalg.eigh(covariances)
    # Harmonics and less do not distinguish breaths, and cost most.
    main = (eigenvalues > HARMONICS**2 * eigenvalues[:, -1:]).any(axis=0)
    roots = eigenvectors[:, :, main] * np.sqrt(eigenvalues[:, None, main])
    blocks = information.reshape(-1, modes, len(information) // modes, modes)
    count = len(vector) // modes

    def log_evidence(root: Array) -> Array:
        """Log evidence (S,) of one breath in all sizes."""
        projected = np.einsum("ai,manb,bj->minj", root, blocks, root, optimize=True)
        system = LinearGaussianSystem(
            projected.reshape(2 * (count * root.shape[1],)),
            (vector.reshape(-1, modes) @ root).ravel(),
        )
        return system.log_evidence(SIZES_MM**2)

    log_evidences = np.array(map_threads(log_evidence, roots, stage="aligning"))
    # Neighbouring cells share errors of non-rigid calibrations, so that three count as one.
    weights = priors[:, None] * np.exp((log_evidences - log_evidences.max()) * 0.3)
    return np.asarray(np.einsum("kij,ks,s->ij", covariances, weights / weights.sum(), SIZES_MM**2))


def breath_along_normals(cells: BodyCells) -> Array:
    """Displacement (C,) along the normals by a breath that moves the trunk's front by 1 mm."""
    axes = _level_axes(cells)
    displacement = _mean_shape(cells, axes) @ axes.T
    return np.asarray(np.sum(displacement * cells.normals[:, :2], axis=1))


def _mean_shape(cells: BodyCells, axes: Array) -> Array:
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


def _level_axes(cells: BodyCells) -> Array:
    """Unit vectors forward and to the left of the subject, as columns, (2, 2)."""
    left = leftward(cells)
    return np.array([[left[1], left[0]], [-left[0], left[1]]])


def _smoothstep(values: Array, low: float, high: float) -> Array:
    """0 below `low`, 1 above `high`, smooth between."""
    t = np.clip((values - low) / (high - low), 0.0, 1.0)
    return np.asarray(t * t * (3.0 - 2.0 * t))
