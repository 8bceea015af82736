"""A calibrated rig: every pair, where it stands, and how well that is known."""

from __future__ import annotations

from dataclasses import dataclass

from bodyscan.calibration.pair import PairCalibration
from bodyscan.capture.rig import Rig
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.registration.uncertainty import PlacingCovariance


@dataclass(frozen=True, eq=False)
class RigCalibration:
    """rig: what the rig file said.  pairs and rig_from_camera: by the pair's name.

    rig_from_board: by (shot, board).  failed: pairs that could not be calibrated, with the reason.
    notes: views that were dropped and other things a builder should know.
    """

    rig: Rig
    pairs: dict[str, PairCalibration]
    rig_from_camera: dict[str, RigidTransform]
    covariance: PlacingCovariance
    rig_from_board: dict[tuple[str, str], RigidTransform]
    failed: dict[str, str]
    notes: tuple[str, ...]
