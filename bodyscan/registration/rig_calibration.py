"""A calibrated rig: every pair, its pose and covariance; its size against the nominal poses."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from bodyscan.arrays import Floats
from bodyscan.calibration.pair import PairCalibration
from bodyscan.errors import FailedWork
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.geometry.uncertainty import PoseCovariance
from bodyscan.rig.board import Board
from bodyscan.rig.rig import Rig
from bodyscan.verdict import Mark

FLOOR_AXES = "origin on the floor at the rig's centre, x forward, y to the left, z up"


@dataclass(frozen=True, eq=False)
class ObservedCorners:
    """Board corners that one camera saw and the joint solve used."""

    pixels: Floats  # where they were seen, (N, 2) float32
    residuals_px: Floats  # projected less seen, (N, 2) float32
    # Number of the corner's (shot, board) in sorted `rig_from_board`, (N,) int16.
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
    observed: the corners that the joint solve used, by pair; empty in old calibrations.
    """

    rig: Rig
    pairs: dict[str, PairCalibration]
    rig_from_camera: dict[str, RigidTransform]
    covariance: PoseCovariance
    rig_from_board: dict[tuple[str, str], RigidTransform]
    failed: dict[str, str]
    notes: tuple[str, ...]
    advice: tuple[str, ...] = ()
    observed: dict[str, ObservedCorners] = field(default_factory=dict)

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
        pose = self.rig_from_camera.get(pair.name, RigidTransform.identity())
        named = not self.is_import or self.rig.rig_frame.pair is not None
        if not named and not np.array_equal(pose.matrix, np.eye(4)):
            return "that of the imported files, wherever it lies"
        return (
            f"that of camera {pair.name}: x to the right in its image, y down, z the way it looks"
        )


MAX_SIZE_ERROR, REFUSED_SIZE_ERROR = 0.03, 0.10
"""Relative error of the distances between cameras, as measured with a tape. Girths are wrong by the
same share: 27 mm of 900 at 3 %."""


@dataclass(frozen=True)
class NominalSize:
    """The rig's size relative to its nominal poses."""

    ratio: float  # distances between cameras, divided by those between their nominal positions
    boards: tuple[Board, ...] = ()  # those whose squares give the rig's lengths

    @property
    def mark(self) -> Mark:
        """Bad if the ratio is off by more than any tape measure errs."""
        error = abs(self.ratio - 1.0)
        if error > MAX_SIZE_ERROR:
            return "bad" if error > REFUSED_SIZE_ERROR else "usable"
        return "good"

    @property
    def words(self) -> str:
        return f"the cameras stand {self.ratio:.3f} times as far apart as their nominal poses"

    @property
    def remedy(self) -> str:
        where = " of the boards"
        if self.boards:
            squares = ", ".join(f"{board.name}: {board.square_mm:g}" for board in self.boards)
            fits = self.boards[0].square_mm / self.ratio
            where = f" in the rig file ({squares}; {fits:.2f} would fit)"
        return f"square_mm may be wrong{where}; or correct `nominal`, or leave it out"


def find_nominal_size(
    rig: Rig, rig_from_camera: Mapping[str, RigidTransform]
) -> NominalSize | None:
    """The size by the median over all distances between cameras; None if fewer than two nominal
    positions are known."""
    nominal = {p.name: np.array(p.nominal.position_mm) for p in rig.pairs if p.nominal}
    ratios = [
        float(
            np.linalg.norm(rig_from_camera[a].translation - rig_from_camera[b].translation)
            / np.linalg.norm(nominal[a] - nominal[b])
        )
        for a, b in combinations(sorted(set(nominal) & set(rig_from_camera)), 2)
        if np.linalg.norm(nominal[a] - nominal[b]) > 100.0
    ]
    return NominalSize(float(np.median(ratios)), rig.boards) if ratios else None


def refuse_wrong_size(rig: Rig, rig_from_camera: Mapping[str, RigidTransform]) -> None:
    """Raise FailedWork if the size is off by more than any tape measure errs."""
    size = find_nominal_size(rig, rig_from_camera)
    if size is not None and size.mark == "bad":
        raise FailedWork(size.words, where=f"rig {rig.name}", remedy=size.remedy)
