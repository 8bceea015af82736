"""A simulated rig's calibration made from its truth, with the errors that boards would leave.

Boards take most of the rendering time; a benchmark of what comes after them uses this as its
calibration: true cameras and light planes, each pair's pose drawn around the true one.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from bodyscan.calibration.pair import PairCalibration, PairQuality
from bodyscan.geometry.camera import camera_from_fields
from bodyscan.geometry.light_planes import LightPlanes
from bodyscan.geometry.transforms import RigidTransform, adjoint
from bodyscan.geometry.uncertainty import PoseCovariance
from bodyscan.registration.rig_calibration import RigCalibration
from bodyscan.rig.pair import Pair
from bodyscan.rig.rig import Rig, load_rig
from bodyscan.workflows.evaluate import load_truth

MIDDLE = RigidTransform(np.eye(3), np.array([0.0, 0.0, 900.0]))
"""Boards are held where people stand: there a pair's points are known best."""
SHIFT_MM, TURN_DEG = 0.1, 0.01
"""Per axis: what forty boards leave open of the workshop's rig (docs/results.md)."""
PLANES_MM = 0.03
"""Common error of all planes of a pair; 0.15 mm in depth."""


def calibration_from_truth(workspace: Path, seed: int = 0) -> RigCalibration:
    """A calibration from the truth of a workspace.

    workspace: what `simulate` wrote with projectors of kind `mirror` without smile. The same seed
        gives the same errors; all workspaces of a rig have the same truth.
    """
    rig, truth = load_rig(workspace / "rig.yaml"), load_truth(workspace / "truth")
    return calibration_from_facts(rig, truth.facts["pairs"], seed)


def calibration_from_facts(
    rig: Rig,
    truth: Mapping[str, Any],
    seed: int,
    *,
    shift_mm: float = SHIFT_MM,
    turn_deg: float = TURN_DEG,
    planes_mm: float = PLANES_MM,
) -> RigCalibration:
    """A calibration from `pairs` of truth.json. shift_mm, turn_deg: pose errors, per axis; planes_mm:
    of the planes of each pair in common."""
    rng = np.random.default_rng(seed)
    sigmas = np.repeat([np.radians(turn_deg), shift_mm], 3)
    pairs, placed, covariances = {}, {}, []
    to_rig = adjoint(MIDDLE)
    for pair in rig.pairs:
        true = truth[pair.name]
        pairs[pair.name] = _pair(pair, true, planes_mm, rng)
        turn, shift = np.split(sigmas * rng.standard_normal(6), 2)
        off = MIDDLE @ RigidTransform.from_rotation_vector(turn, shift) @ MIDDLE.inverse()
        placed[pair.name] = off @ RigidTransform.from_matrix(true["rig_from_camera"])
        covariances.append(to_rig @ np.diag(sigmas**2) @ to_rig.T)
    size = len(placed)
    blocks = np.einsum("ij,iab->iajb", np.eye(size), np.array(covariances))
    covariance = PoseCovariance(tuple(placed), blocks.reshape(6 * size, 6 * size))
    return RigCalibration(rig, pairs, placed, covariance, {}, {}, ())


def _pair(
    pair: Pair, true: Mapping[str, Any], planes_mm: float, rng: np.random.Generator
) -> PairCalibration:
    camera = camera_from_fields(true["camera"])
    planes = np.array(true["boundary_planes"])
    planes *= np.where(planes[:, 3:] < 0.0, -1.0, 1.0)
    planes[:, 3] += planes_mm * rng.standard_normal()
    spread = np.zeros((len(planes), 4, 4))
    spread[:, 3, 3] = planes_mm**2
    assert pair.projector is not None
    sheets = LightPlanes(planes, spread, pair.projector.direction)
    size = len(camera.parameters)
    quality = PairQuality(None, 0, stripes_calibrated=len(planes), stripes_projected=len(planes))
    return PairCalibration(pair.name, camera, np.zeros((size, size)), sheets, quality)
