"""The size of a rig by the nominal places of its cameras: all its lengths come from boards' squares."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from bodyscan.errors import FailedWork
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.rig.board import Board
from bodyscan.rig.rig import Rig
from bodyscan.verdict import Mark

OTHER_SIZE, REFUSED_SIZE = 0.03, 0.10
"""Of distances between cameras as a tape measures them. A girth is as wrong: 27 mm of 900 at 3 %."""
LEAST_APART_MM = 100.0


@dataclass(frozen=True)
class NominalSize:
    """ratio: how many times as far apart the cameras stand as their nominal places.  boards: whose
    squares said so."""

    ratio: float
    boards: tuple[Board, ...] = ()

    @property
    def mark(self) -> Mark:
        """Bad where no tape measure errs so far."""
        off = abs(self.ratio - 1.0)
        return "bad" if off > REFUSED_SIZE else "usable" if off > OTHER_SIZE else "good"

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


def nominal_size(rig: Rig, rig_from_camera: Mapping[str, RigidTransform]) -> NominalSize | None:
    """By the median of all distances between cameras; None where fewer than two nominal places are
    known."""
    nominal = {p.name: np.array(p.nominal.position_mm) for p in rig.pairs if p.nominal}
    ratios = [
        float(
            np.linalg.norm(rig_from_camera[a].translation - rig_from_camera[b].translation)
            / np.linalg.norm(nominal[a] - nominal[b])
        )
        for a, b in combinations(sorted(set(nominal) & set(rig_from_camera)), 2)
        if np.linalg.norm(nominal[a] - nominal[b]) > LEAST_APART_MM
    ]
    return NominalSize(float(np.median(ratios)), rig.boards) if ratios else None


def check_nominal_size(rig: Rig, rig_from_camera: Mapping[str, RigidTransform]) -> list[str]:
    """A line if the cameras stand farther apart, or nearer, than they are meant to. Raises FailedWork
    where no tape measure errs so far."""
    size = nominal_size(rig, rig_from_camera)
    if size is None or size.mark == "good":
        return []
    if size.mark == "bad":
        raise FailedWork(size.words, where=f"rig {rig.name}", remedy=size.remedy)
    return [f"{size.words}: {size.remedy}"]
