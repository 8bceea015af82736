"""A calibrated rig: every pair, its pose, and how well that is known."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from bodyscan.arrays import Floats
from bodyscan.calibration.pair import PairCalibration
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.geometry.uncertainty import PoseCovariance
from bodyscan.rig.rig import Rig

FLOOR_AXES = "origin on the floor at the rig's centre, x forward, y to the left, z up"


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

    @property
    def is_import(self) -> bool:
        """Whether all of it was taken from other programs, and no image looked at."""
        return all(pair.quality.imported for pair in self.pairs.values())

    @property
    def axes(self) -> str:
        """Where the rig frame lies, in words."""
        pair = self.rig.frame_pair
        if pair is None or pair.nominal is not None:
            return FLOOR_AXES
        placed = self.rig_from_camera.get(pair.name, RigidTransform.identity())
        named = not self.is_import or self.rig.rig_frame.pair is not None
        if not named and not np.array_equal(placed.matrix, np.eye(4)):
            return "that of the imported files, wherever it lies"
        return (
            f"that of camera {pair.name}: x to the right in its picture, y down, z the way it looks"
        )
