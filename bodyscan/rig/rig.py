"""The whole rig file: boards, poles, pairs, where captures lie and how files are named."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Annotated, Literal

from pydantic import Field, PositiveFloat

from bodyscan.files.model import Model, Name, Problem
from bodyscan.rig.board import Board
from bodyscan.rig.consistency import RigParts, rig_problems
from bodyscan.rig.frame_names import CaptureFolder, FrameNames
from bodyscan.rig.pair import Pair
from bodyscan.rig.rig_frame import Reference, RigFrame


class Volume(Model):
    """The scan volume: an upright cylinder on the floor around the rig's centre."""

    radius_mm: PositiveFloat = 700.0
    bottom_mm: float = 5.0
    top_mm: PositiveFloat = 2200.0

    def problems(self) -> Iterator[Problem]:
        if self.bottom_mm >= self.top_mm:
            yield (
                ("bottom_mm",),
                f"must lie below top_mm ({self.top_mm:g}) (got {self.bottom_mm:g})",
            )


ExposureName = Annotated[str, Field(pattern=r"^[\w.+-]+$", max_length=64)]


class Rig(Model):
    """The whole rig file.

    exposures: what `{exposure}` in file names becomes, the shortest first; () if every image is
        taken once.
    follow_links: whether symbolic links may lead out of a capture folder.
    references: certified lengths that fix the size.
    """

    version: Literal[1] = 1
    name: Name
    boards: tuple[Board, ...] = ()
    pairs: tuple[Pair, ...] = Field(min_length=1)
    calibration: tuple[CaptureFolder, ...] = ()
    references: tuple[Reference, ...] = ()
    files: str = "{shot}/{pair}/{frame}.png"
    exposures: tuple[ExposureName, ...] = ()
    follow_links: bool = False
    frames: FrameNames = FrameNames()
    rig_frame: RigFrame = RigFrame()
    volume: Volume = Volume()

    def pair(self, name: str) -> Pair:
        """Return the pair of that name. Raises KeyError if there is none."""
        return {pair.name: pair for pair in self.pairs}[name]

    def board(self, name: str) -> Board:
        """Return the board of that name. Raises KeyError if there is none."""
        return {board.name: board for board in self.boards}[name]

    @property
    def is_known(self) -> bool:
        """Whether another program calibrated all of it, including the projectors."""
        return all(
            pair.known and (pair.known.projector or not pair.projector) for pair in self.pairs
        )

    @property
    def poles(self) -> dict[str, str]:
        """The pole of each pair that is on one."""
        return {pair.name: pair.pole for pair in self.pairs if pair.pole}

    @property
    def frame_pair(self) -> Pair | None:
        """The pair that fixes the rig frame, or None if a board in a shot does."""
        if self.rig_frame.shot is not None:
            return None
        return self.pair(self.rig_frame.pair) if self.rig_frame.pair else self.pairs[0]

    @property
    def frame_board(self) -> Board | None:
        """The board that fixes the rig frame, or None if a pair does."""
        if self.rig_frame.shot is None:
            return None
        return self.board(self.rig_frame.board) if self.rig_frame.board else self.boards[0]

    def problems(self) -> Iterator[Problem]:
        return rig_problems(
            RigParts(
                board_names=tuple(board.name for board in self.boards),
                boards=self.boards,
                pair_names=tuple(pair.name for pair in self.pairs),
                pairs=self.pairs,
                folders=self.calibration,
                references=self.references,
                files=self.files,
                exposures=self.exposures,
                frames=self.frames,
                rig_frame=self.rig_frame,
            )
        )


def find_unusual_lengths(rig: Rig) -> Iterator[str]:
    """Warn of lengths that a body scanner is unlikely to have, such as metres instead of mm."""
    lengths = [(f"board {one.name}: square_mm", one.square_mm, 2.0, 500.0) for one in rig.boards]
    lengths += [
        ("volume: radius_mm", rig.volume.radius_mm, 50.0, 5000.0),
        ("volume: its height", rig.volume.top_mm - rig.volume.bottom_mm, 50.0, 5000.0),
    ]
    for pair in rig.pairs:
        if pair.nominal is not None:
            distance = math.dist(pair.nominal.position_mm, pair.nominal.look_at_mm)
            what = f"pair {pair.name}: nominal, from what it looks at"
            lengths.append((what, distance, 50.0, 20_000.0))
    for what, value, low, high in lengths:
        if not low <= value <= high:
            yield (
                f"{what} is {value:g} mm, but {low:g} to {high:g} mm is usual: check that it is in "
                "mm, as all lengths of a rig file are"
            )
