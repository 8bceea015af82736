"""A board carried round a rig: what each camera has covered, what ties pairs together, how well each
pair is known, and where to hold the board next.

Boards are found image by image, as they come, and the advice that follows from what pictures cover
is there at once. The joint solve of all shots so far takes longer; it comes when it is ready. Once
every pair has its boards a whole calibration by the shots so far says whether they are enough.
"""

from __future__ import annotations

import os
import time
from collections import Counter
from collections.abc import Mapping, Sequence, Set
from contextlib import suppress
from dataclasses import dataclass, field, replace
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np

from bodyscan.arrays import Indices
from bodyscan.boards.view import BoardView
from bodyscan.captures.folder import Captures, ImageSequence, open_captures, resolve_capture_path
from bodyscan.errors import BodyscanError
from bodyscan.jobs.watching import STABLE_S, has_end_mark
from bodyscan.optional import optional
from bodyscan.registration.advice import pair_sigma_mm, suggest_shots
from bodyscan.registration.calibration_verdict import LIMITS, collect_figures, grade_calibration
from bodyscan.registration.rig_frame import find_frame_target
from bodyscan.registration.rig_solve import solve_rig
from bodyscan.rig.pair import Pair
from bodyscan.rig.rig import find_connected_groups, load_rig
from bodyscan.workflows.calibrate_rig import solve_boards
from bodyscan.workflows.find_boards import (
    FoundBoards,
    calibrate_cameras,
    find_all_boards,
    locate_views,
)

COLUMNS, ROWS = 4, 3
"""Cells of a picture: a person can tell one from another when told where to hold the board."""
BOARDS = int(LIMITS["stripe_shots"].value)
"""Boards that each pair should see with its stripes: with fewer no calibration is good."""

Stamp = tuple[str, str, int, int]


@dataclass
class BoardTour:
    """The calibration captures that a rig file names, looked at again and again."""

    rig_file: Path
    views: list[BoardView] = field(default_factory=list)  # boards found so far
    # Pair, shot, size and time of the images in which they were looked for, retaken ones too.
    looked: Set[Stamp] = frozenset()
    seen: Set[str] = frozenset()  # their shots
    # Pairs and shots of which only the lit image was taken, which places a board but shows no
    # stripes on it.
    lit: Set[tuple[str, str]] = frozenset()
    missed: dict[str, list[str]] = field(default_factory=dict)
    solved: dict[str, Any] = field(default_factory=dict)  # see `solve`
    refused: Sequence[str] = ()  # why the captures cannot be opened
    _pending: Mapping[Stamp, float] = field(default_factory=dict)  # and since when, s
    _folders: Mapping[str, int] | None = None  # when each changed
    _changed_s: float = -np.inf

    def __post_init__(self) -> None:
        self.rig = load_rig(self.rig_file)

    def look(self) -> list[str]:
        """Find boards in the images that have come since, and return the names of their shots.

        Pairs take turns, so a shot's images come one by one; one that was taken again is looked at
        again. What other threads read meanwhile is replaced, never changed.
        """
        if not self._may_have_changed():
            return []
        try:
            captures = open_captures(self.rig, self.rig_file)
        except BodyscanError as error:
            self.refused = [str(error)]  # such as no image yet
            return []
        self.refused = []
        there = {(s.pair, s.shot): s for s in captures.sequences if s.board_path.exists()}
        projected = {pair.name for pair in self.rig.pairs if pair.projector}
        self.lit = {i for i, s in there.items() if i[0] in projected and not s.has_stripes}
        files = ((image, s.board_path.stat()) for image, s in there.items())
        stamps = {(*i, file.st_size, file.st_ctime_ns) for i, file in files} - self.looked
        now_s = time.monotonic()
        since_s = {stamp: self._pending.get(stamp, now_s) for stamp in stamps}
        fresh = {
            stamp[:2]: stamp
            for stamp, since in since_s.items()
            if now_s - since >= STABLE_S or has_end_mark(there[stamp[:2]].board_path, stamp[2])
        }
        self._pending = {one: since for one, since in since_s.items() if one not in fresh.values()}
        if fresh:
            self.looked |= set(fresh.values())
            self._find(captures, tuple(there[image] for image in fresh))
        return sorted({shot for _, shot in fresh})

    def _may_have_changed(self) -> bool:
        """Whether files may have come in the last second: folders say when a name came into them, in
        steps of hundredths of a second."""
        now_s, before = time.monotonic(), self._folders
        roots = [resolve_capture_path(self.rig_file, entry) for entry in self.rig.calibration]
        walks = (os.walk(root) for root in roots)
        with suppress(FileNotFoundError):  # removed meanwhile: it is another at the next look
            self._folders = {p: os.stat(p).st_ctime_ns for walk in walks for p, _, _ in walk}
        if self._folders != before or self._pending or self.rig.follow_links:
            self._changed_s = now_s
        return now_s - self._changed_s < 1.0

    def _find(self, captures: Captures, fresh: tuple[ImageSequence, ...]) -> None:
        shots = tuple(dict.fromkeys(s.shot for s in fresh))
        self.seen |= set(shots)
        again = {(s.pair, s.shot) for s in fresh}
        kept = [view for view in self.views if (view.pair, view.shot) not in again]
        found = find_all_boards(self.rig, replace(captures, shots=shots, sequences=fresh))
        self.views = kept + found.value
        for shot in shots:
            seeing = {view.pair for view in self.views if view.shot == shot}
            missed = sorted({pair for pair, one, *_ in self.looked if one == shot} - seeing)
            # The last shot is the last of them.
            self.missed = {k: v for k, v in self.missed.items() if k != shot} | {shot: missed}

    def solve(self) -> None:
        """Solve for all cameras and poses by the boards so far, and calibrate with them once every
        pair has its boards; what fails is a line of advice."""
        notes: list[str] = []
        sigmas: dict[str, float] = {}
        images = len(self.looked)
        with optional("sigmas", notes.append):
            cameras = calibrate_cameras(self.rig, self.views, folder=self.rig_file.parent).value
            located = locate_views(self.rig, self.views, cameras).value
            if located:
                lenses = {name: one.camera for name, one in cameras.items()}
                solution = solve_rig(self.rig, located, lenses).value
                sigmas = {name: pair_sigma_mm(solution, name) for name in solution.rig_from_camera}
                worst = max(sorted(sigmas), key=lambda name: sigmas[name])
                notes += suggest_shots(self.rig, solution, worst)
        finite = {name: sigma for name, sigma in sigmas.items() if np.isfinite(sigma)}
        solved = {"images": images, "sigmas_mm": finite, "advice": notes}
        boards = min(len(self._calibrating(pair.name)) for pair in self.rig.pairs)
        if boards >= BOARDS and self._choose_by_pictures()["say"] != "tie":
            with optional("a trial calibration", notes.append):
                solved["weakest"], reasons = self._calibrate()
                solved["enough"] = not reasons
                solved["advice"] = [*reasons, *notes]
        self.solved = solved

    def _calibrate(self) -> tuple[str | None, Sequence[str]]:
        """Calibrate by the boards so far: the pair that is farthest beyond a limit of its figures, None
        if none is; and why the calibration would not be good."""
        captures, boards = open_captures(self.rig, self.rig_file), FoundBoards(list(self.views))
        found = solve_boards(self.rig, captures, boards, folder=self.rig_file.parent).calibration
        beyond = [(each[0], pair.name) for pair in collect_figures(found) for each in pair.beyond()]
        return max(beyond, default=(0.0, None))[1], grade_calibration(found).reasons

    def describe(self) -> dict[str, Any]:
        """Everything that a page shows of it."""
        by_pair = {pair.name: self._calibrating(pair.name) for pair in self.rig.pairs}
        cells = self._count_cells()
        last, missed = next(reversed(self.missed.items()), (None, []))
        return {
            "shots": len(self.seen),
            "last": last,
            "missed": missed,
            "pairs": [
                {
                    "name": name,
                    "boards": len(found),
                    "cells": cells[name].astype(int).ravel().tolist(),
                    "sigma_mm": self.solved.get("sigmas_mm", {}).get(name),
                }
                for name, found in by_pair.items()
            ],
            "groups": self._find_groups(),
            "shared": self._count_shared_shots(),
            "next": self._choose_next(cells),
            "advice": [*self.refused, *self.solved.get("advice", [])],
            "wanted": BOARDS,
        }

    def _choose_next(self, cells: Mapping[str, Indices]) -> dict[str, Any]:
        """Where to hold the board next: where pictures are not covered, or where the pair saw it least
        that a calibration by all of these shots found not to be good."""
        target = find_frame_target(self.rig)
        if target is not None and target not in {(view.shot, view.board) for view in self.views}:
            return {"say": "frame", "shot": target[0], "board": target[1]}
        hold = self._choose_by_pictures()
        if self.solved.get("images") != len(self.looked) or hold["say"] == "tie":
            return hold
        if self.solved.get("enough"):
            return {"say": "enough"}
        weakest = self.solved.get("weakest") or hold.get("pair") or self.rig.pairs[0].name
        return _hold_in(weakest, cells[weakest], len(self._calibrating(weakest)))

    def _choose_by_pictures(self) -> dict[str, Any]:
        boards = {pair.name: len(self._calibrating(pair.name)) for pair in self.rig.pairs}
        return _choose_next_hold(self._count_cells(), boards, self._find_groups())

    def _count_cells(self) -> dict[str, Indices]:
        """See the function `_count_cells`, by pair."""
        return {p.name: _count_cells(p, self._calibrating(p.name)) for p in self.rig.pairs}

    def _calibrating(self, pair: str) -> list[BoardView]:
        """Boards that calibrate a pair: those on which it took its stripes, if it has any."""
        return [v for v in self.views if v.pair == pair and (pair, v.shot) not in self.lit]

    def _count_shared_shots(self) -> list[tuple[str, str, int]]:
        """Pairs of pairs, and how many shots they share."""
        shots = (sorted({v.pair for v in self.views if v.shot == shot}) for shot in self.seen)
        counts = Counter(two for names in shots for two in combinations(names, 2))
        return [(*two, count) for two, count in sorted(counts.items())]

    def _find_groups(self) -> list[list[str]]:
        """Pairs that shots tie together, the largest group first."""
        ties = ((first, second) for first, second, _ in self._count_shared_shots())
        groups = find_connected_groups([pair.name for pair in self.rig.pairs], ties)
        return sorted(map(sorted, groups), key=lambda one: (-len(one), one))


def _choose_next_hold(
    cells: Mapping[str, Indices], boards: Mapping[str, int], groups: Sequence[Sequence[str]]
) -> dict[str, Any]:
    """Where to hold the board next, as words' keys and what goes into them: first where it was
    hardly seen, then what ties groups together, then what images lack.

    cells: of each pair, see `_count_cells`. boards: how many calibrate each pair. groups: of pairs that
        shots tie together.
    """
    barest_pair = min(boards, key=lambda name: boards[name])
    if len(groups) > 1 and min(boards.values()) >= 2:
        return {"say": "tie", "one": groups[0], "other": groups[1]}
    # Twice in a cell: once may be by a corner of the board, and says nothing of the lens there.
    share = {name: float(np.mean(each > 1)) for name, each in cells.items()}
    barest = min(share, key=lambda name: share[name])
    target = barest_pair if boards[barest_pair] < BOARDS else barest
    if boards[barest_pair] >= BOARDS and share[barest] >= 0.8:
        return {"say": "checking"}  # by a calibration
    return _hold_in(target, cells[target], boards[target])


def _hold_in(pair: str, cells: Indices, boards: int) -> dict[str, Any]:
    """Advice to hold the board where a pair with so many boards saw it least."""
    rows, columns = np.indices(cells.shape)
    rim = np.hypot(rows - (ROWS - 1) / 2.0, columns - (COLUMNS - 1) / 2.0)
    # Of equal cells the inner one is named.
    row, column = divmod(int(np.argmin(cells + 0.01 * rim)), COLUMNS)
    return {"say": "hold", "pair": pair, "row": row, "column": column, "boards": boards}


def _count_cells(pair: Pair, views: Sequence[BoardView]) -> Indices:
    """How many boards have shown in each cell of a pair's picture (ROWS, COLUMNS)."""
    counts = np.zeros((ROWS, COLUMNS), np.int64)
    size = np.array([pair.camera.width, pair.camera.height])
    for view in views:
        column, row = (np.clip(view.pixels / size, 0.0, 0.999) * [COLUMNS, ROWS]).astype(int).T
        counts.ravel()[np.unique(row * COLUMNS + column)] += 1
    return counts
