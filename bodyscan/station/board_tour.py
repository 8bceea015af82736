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
from bodyscan.captures.folder import Captures, open_captures, resolve_capture_path
from bodyscan.errors import BodyscanError
from bodyscan.jobs.watching import STABLE_S, has_end_mark
from bodyscan.optional import optional
from bodyscan.registration.advice import assess_pairs
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
BOARDS = int(LIMITS["poses"].value)
"""Boards that each pair should see: with fewer no calibration is good."""

Stamp = tuple[str, str, int, int]


@dataclass
class BoardTour:
    """The calibration captures that a rig file names, looked at again and again."""

    rig_file: Path
    views: list[BoardView] = field(default_factory=list)  # boards found so far
    # Pair, shot, size and time of the images in which they were looked for, retaken ones too.
    looked: Set[Stamp] = frozenset()
    # Pairs and shots of which only the lit image was taken, which places a board but shows no
    # stripes on it.
    lit: Set[tuple[str, str]] = frozenset()
    missed: dict[str, list[str]] = field(default_factory=dict)  # by shot, who did not see it
    solved: dict[str, Any] = field(default_factory=dict)  # see `solve`
    refused: Sequence[str] = ()  # why the captures cannot be opened
    _pending: Mapping[Stamp, float] = field(default_factory=dict)  # and since when, s
    _folders: Mapping[str, int] | None = None  # when each changed
    _changed_s: float = -np.inf

    def __post_init__(self) -> None:
        self.rig = load_rig(self.rig_file)
        self._roots = [resolve_capture_path(self.rig_file, each) for each in self.rig.calibration]

    def look(self) -> str:
        """Find boards in a shot's images that have come since; return its name, "" if none came.

        Pairs take turns, so a shot's images come one by one; one that was taken again is looked at
        again. What other threads read meanwhile is replaced, never changed. Of many shots, as after
        a restart, one is looked at in each call, the one that fixes the rig frame first.
        """
        if not self._may_have_changed():
            return ""
        if not any(any(root.glob("*")) for root in self._roots):  # a new rig's first calibration
            self.refused = [f"no image of the board yet: they come into {self._roots[0]}"]
            return ""
        try:
            captures = open_captures(self.rig, self.rig_file)
        except BodyscanError as error:
            self.refused = [str(error)]
            return ""
        self.refused = []
        sequences = sorted(captures.sequences, key=lambda s: s.shot != self.rig.rig_frame.shot)
        there = {(s.pair, s.shot): s for s in sequences if s.board_path.exists()}
        alone = (i for i, s in there.items() if not s.has_stripes)
        self.lit = {i for i in alone if self.rig.pair(i[0]).projector}
        files = ((image, s.board_path.stat()) for image, s in there.items())
        stamps = [(*i, file.st_size, file.st_ctime_ns) for i, file in files]
        now_s = time.monotonic()
        since_s = {one: self._pending.get(one, now_s) for one in stamps if one not in self.looked}
        whole = [
            (pair, shot, size, changed_ns)
            for (pair, shot, size, changed_ns), since in since_s.items()
            if now_s - since >= STABLE_S or has_end_mark(there[pair, shot].board_path, size)
        ]
        shot = whole[0][1] if whole else ""
        fresh = {one for one in whole if one[1] == shot}
        self._pending = {one: since for one, since in since_s.items() if one not in fresh}
        if fresh:
            self.looked |= fresh
            self._find(captures, shot, {pair for pair, *_ in fresh})
        return shot

    def _may_have_changed(self) -> bool:
        """Whether files may have come in the last second, by when a name came into the folders."""
        now_s, before = time.monotonic(), self._folders
        walks = (os.walk(root) for root in self._roots)
        with suppress(FileNotFoundError):  # removed meanwhile: it is another at the next look
            self._folders = {p: os.stat(p).st_ctime_ns for walk in walks for p, _, _ in walk}
        if self._folders != before or self._pending or self.rig.follow_links:
            self._changed_s = now_s
        return now_s - self._changed_s < 1.0

    def _find(self, captures: Captures, shot: str, pairs: Set[str]) -> None:
        """Find boards in the images that these pairs took of a shot."""
        fresh = tuple(s for s in captures.shot_sequences(shot) if s.pair in pairs)
        kept = [view for view in self.views if view.shot != shot or view.pair not in pairs]
        captures = replace(captures, shots=(shot,), sequences=fresh)
        self.views = kept + find_all_boards(self.rig, captures, explain=False).value
        seeing = {view.pair for view in self.views if view.shot == shot}
        missed = sorted({pair for pair, one, *_ in self.looked if one == shot} - seeing)
        # The last shot is the last of them.
        self.missed = {k: v for k, v in self.missed.items() if k != shot} | {shot: missed}

    def solve(self) -> None:
        """Solve by the boards so far, and calibrate once every pair has its; failures are advice."""
        notes: list[str] = []
        sigmas: dict[str, float] = {}
        images = len(self.looked)
        with optional("sigmas", notes.append):
            cameras = calibrate_cameras(self.rig, self.views, folder=self.rig_file.parent).value
            located = locate_views(self.rig, self.views, cameras).value
            if located:
                lenses = {name: one.camera for name, one in cameras.items()}
                solution = solve_rig(self.rig, located, lenses).value
                sigmas, suggestion = assess_pairs(self.rig, solution)
                notes += suggestion
        finite = {name: sigma for name, sigma in sigmas.items() if np.isfinite(sigma)}
        solved = {"images": images, "sigmas_mm": finite, "advice": notes}
        counts = self._count_boards()
        if min(counts.values()) >= BOARDS and len(self._find_groups()) == 1:
            with optional("a trial calibration", notes.append):
                captures, boards = open_captures(self.rig, self.rig_file), FoundBoards(self.views)
                found = solve_boards(self.rig, captures, boards, folder=self.rig_file.parent)
                # No errors that forbid no use: at 512 px single points of held-out boards were missed
                # by 0.3 to 0.6 mm, however many came, and a body's points right to 0.03 to 0.08 mm.
                beyond = [
                    (times, pair.name)
                    for pair in collect_figures(found.calibration)
                    for times, is_error, _ in pair.beyond()
                    if times > 2.0 or not is_error
                ]
                # A quarter of a good scan's 0.15 mm RMS. After 20 boards four more gain under a tenth.
                rough = {n: mm for n, mm in finite.items() if mm > 0.0375 and counts[n] < 20}
                worst = max(rough, key=lambda name: rough[name], default=None)
                solved["weakest"] = max(beyond, default=(0.0, worst))[1]  # farthest beyond a limit
                lost = counts.keys() - finite.keys() | found.calibration.failed.keys()
                solved["enough"] = not (beyond or rough or lost)
                solved["advice"] = [*grade_calibration(found.calibration).reasons, *notes]
        self.solved = solved

    def describe(self) -> dict[str, Any]:
        """Everything that a page shows of it."""
        boards, sigmas = self._count_boards(), self.solved.get("sigmas_mm", {})
        cells = {pair.name: self._count_cells(pair) for pair in self.rig.pairs}
        pairs = [
            {"name": n, "boards": boards[n], "cells": c.ravel().tolist(), "sigma_mm": sigmas.get(n)}
            for n, c in cells.items()
        ]
        last, missed = next(reversed(self.missed.items()), (None, []))
        return {
            "shots": len(self.missed),
            "last": last,
            "missed": missed,
            "pairs": pairs,
            "shared": self._count_shared_shots(),
            "next": self._choose_next(cells, boards),
            "advice": [*self.refused, *self.solved.get("advice", [])],
            "wanted": BOARDS,
        }

    def _choose_next(
        self, cells: Mapping[str, Indices], boards: Mapping[str, int]
    ) -> dict[str, Any]:
        """Where to hold the board next, as words' keys and what goes into them: first where it fixes
        the rig frame, then where it was hardly seen, then what ties groups together, then what
        pictures lack, or the pair that a calibration by all of these shots found farthest from good."""
        target = find_frame_target(self.rig)
        if target is not None and target not in {(view.shot, view.board) for view in self.views}:
            return {"say": "frame", "shot": target[0], "board": target[1]}
        groups, poorest = self._find_groups(), min(boards, key=lambda name: boards[name])
        if len(groups) > 1 and boards[poorest] >= 2:
            return {"say": "tie", "one": groups[0], "other": groups[1]}
        # Twice in a cell: once may be by a corner of the board, and says nothing of the lens there.
        share = {name: float(np.mean(each > 1)) for name, each in cells.items()}
        barest = min(share, key=lambda name: share[name])
        wanted = poorest if boards[poorest] < BOARDS else barest
        is_solved = self.solved.get("images") == len(self.looked)
        if is_solved and self.solved.get("enough"):
            return {"say": "enough"}
        if is_solved:
            wanted = self.solved.get("weakest") or wanted
        elif boards[poorest] >= BOARDS and share[barest] >= 0.8:
            return {"say": "checking"}  # by a calibration
        # Of cells that are equally bare the inner one is named.
        rows, columns = np.indices((ROWS, COLUMNS))
        rim = np.hypot(rows - (ROWS - 1) / 2.0, columns - (COLUMNS - 1) / 2.0)
        row, column = divmod(int(np.argmin(cells[wanted] + 0.01 * rim)), COLUMNS)
        hold = {"pair": wanted, "row": row, "column": column, "boards": boards[wanted]}
        other = self._find_partner(wanted)
        return {"say": "holdShared" if other else "hold"} | hold | {"other": other}

    def _find_partner(self, pair: str) -> str:
        """The pole with the fewest shots shared with a pair, of those tied to its own, or ""."""
        poles = {each.name: each.pole or each.name for each in self.rig.pairs}
        shared: Counter[str] = Counter()
        for one, other, count in self._count_shared_shots():
            for near, far in ((one, other), (other, one)):
                if poles[near] == poles[pair] != poles[far]:
                    shared[poles[far]] += count if near == pair else 0
        return min(sorted(shared), key=lambda pole: shared[pole], default="")

    def _count_boards(self) -> dict[str, int]:
        """How many boards count for each pair: those that calibrate it, and two without stripes."""
        lit = int(LIMITS["poses"].value - LIMITS["stripe_shots"].value)
        seen = Counter(view.pair for view in self.views)
        names = [pair.name for pair in self.rig.pairs]
        return {name: min(seen[name], len(self._calibrating(name)) + lit) for name in names}

    def _count_cells(self, pair: Pair) -> Indices:
        """How many boards have shown in each cell of a pair's picture (ROWS, COLUMNS)."""
        counts = np.zeros((ROWS, COLUMNS), np.int64)
        size = np.array([pair.camera.width, pair.camera.height])
        for view in self._calibrating(pair.name):
            column, row = (np.clip(view.pixels / size, 0.0, 0.999) * [COLUMNS, ROWS]).astype(int).T
            counts.ravel()[np.unique(row * COLUMNS + column)] += 1
        return counts

    def _calibrating(self, pair: str) -> list[BoardView]:
        """Boards that calibrate a pair: those on which it took its stripes, if it has any."""
        return [v for v in self.views if v.pair == pair and (pair, v.shot) not in self.lit]

    def _count_shared_shots(self) -> list[tuple[str, str, int]]:
        """Pairs of pairs, and how many shots they share."""
        shots = (sorted({v.pair for v in self.views if v.shot == shot}) for shot in self.missed)
        counts = Counter(two for names in shots for two in combinations(names, 2))
        return [(*two, count) for two, count in sorted(counts.items())]

    def _find_groups(self) -> list[list[str]]:
        """Pairs that shots tie together, the largest group first."""
        ties = ((first, second) for first, second, _ in self._count_shared_shots())
        groups = find_connected_groups([pair.name for pair in self.rig.pairs], ties)
        return sorted(map(sorted, groups), key=lambda one: (-len(one), one))
