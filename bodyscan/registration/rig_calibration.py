"""A calibrated rig: every pair, where it stands, and how well that is known."""

from __future__ import annotations

from dataclasses import dataclass, field

from bodyscan.calibration.pair import PairCalibration
from bodyscan.geometry.placing_covariance import PlacingCovariance
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.registration.seen_corners import SeenCorners
from bodyscan.rig.rig import Rig


@dataclass(frozen=True, eq=False)
class RigCalibration:
    """rig: what the rig file said.  pairs and rig_from_camera: by the pair's name.

    rig_from_board: by (shot, board).  failed: pairs that could not be calibrated, with the reason.
    notes: views that were dropped and other things a builder should know.  advice: how well the
    placing of the pairs is known, and what would help most, in words.  seen: the corners that the
    joint solve used, by the pair's name; empty in calibrations stored before they were kept.
    """

    rig: Rig
    pairs: dict[str, PairCalibration]
    rig_from_camera: dict[str, RigidTransform]
    covariance: PlacingCovariance
    rig_from_board: dict[tuple[str, str], RigidTransform]
    failed: dict[str, str]
    notes: tuple[str, ...]
    advice: tuple[str, ...] = ()
    seen: dict[str, SeenCorners] = field(default_factory=dict)
