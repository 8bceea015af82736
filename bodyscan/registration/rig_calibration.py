"""A calibrated rig: every pair, where it stands, and how well that is known."""

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
    """Board corners that one camera saw and that the joint solve used.

    pixels: (N, 2) float32, where they were seen.  residuals_px: (N, 2) float32, projected less seen.
    target: (N,) int16, number of its (shot, board) among those of `rig_from_board`, sorted.
    """

    pixels: Floats
    residuals_px: Floats
    target: NDArray[np.int16]


@dataclass(frozen=True, eq=False)
class RigCalibration:
    """rig: what the rig file said.  pairs and rig_from_camera: by the pair's name.

    rig_from_board: by (shot, board).  failed: pairs that could not be calibrated, with the reason.
    notes: views that were dropped and other things a builder should know.  advice: how well the
    poses of the pairs are known, and what would help most, in words.  seen: the corners that the
    joint solve used, by the pair's name; empty in calibrations stored before they were kept.
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
