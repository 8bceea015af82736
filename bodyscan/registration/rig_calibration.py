"""A calibrated rig: every pair, its pose, and how well that is known."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from bodyscan.arrays import Floats
from bodyscan.calibration.pair import PairCalibration
from bodyscan.geometry.pose_covariance import PoseCovariance
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.rig.rig import Rig


@dataclass(frozen=True, eq=False)
class SeenCorners:
    """Board corners that one camera saw and the joint solve used.

    pixels: where they were seen, (N, 2) float32.
    residuals_px: projected less seen, (N, 2) float32.
    target: number of the corner's (shot, board) in sorted `rig_from_board`, (N,) int16.
    """

    pixels: Floats
    residuals_px: Floats
    target: NDArray[np.int16]


@dataclass(frozen=True, eq=False)
class RigCalibration:
    """A calibrated rig.

    rig: content of the rig file.
    pairs, rig_from_camera: by the pair's name.
    covariance: of the poses of the pairs.
    rig_from_board: by (shot, board).
    failed: pairs that could not be calibrated, with the reason.
    notes: views that were dropped, and other things a builder should know.
    advice: how well the pairs' poses are known, and what would help most, in words.
    seen: the corners that the joint solve used, by pair; empty in calibrations stored before
        corners were kept.
    """

    rig: Rig
    pairs: dict[str, PairCalibration]
    rig_from_camera: dict[str, RigidTransform]
    covariance: PoseCovariance
    rig_from_board: dict[tuple[str, str], RigidTransform]
    failed: dict[str, str]
    notes: tuple[str, ...]
    advice: tuple[str, ...] = ()
    seen: dict[str, SeenCorners] = field(default_factory=dict)
