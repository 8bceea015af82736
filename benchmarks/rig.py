"""The rig's solve against the truth and against other programs, on corners found in rendered images."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.board_images import SeenRig, see_boards
from bodyscan.calibration.rig import calibrate_cameras, locate_views
from bodyscan.capture.boards import corner_points
from bodyscan.capture.rig import Board, Rig
from bodyscan.capture.rig_file import load_rig
from bodyscan.geometry.camera import Camera
from bodyscan.geometry.transforms import RigidTransform, rigid_fit
from bodyscan.registration.located_view import LocatedView
from bodyscan.registration.rig_solve import PlacedRig, place_rig
from bodyscan.registration.uncertainty import position_sigma

Array = NDArray[np.float64]

PROJECT = Path(__file__).parents[1]
SHOTS = 40
STORED = PROJECT / "bench" / "rig-corners"
CASES = (
    ("three-pole-12", "ChArUco", (0, 1, 2)),
    ("three-pole-12", "plain", (0, 1)),
    ("four-pole-16", "ChArUco", (0,)),
    ("four-pole-16", "plain", (0,)),
)
"""Rig, board, seeds: one seed takes minutes to render."""
PLAIN_SQUARE_MM = 45.0
"""A plain board must be seen whole: one of 9 x 7 squares of 70 mm hardly fits into the pictures."""
RIVALS = {
    "opencv-multiview": "OpenCV 5 `calibrateMultiview`",
    "aniposelib": "aniposelib",
    "stereo-chain": "pairwise stereo, chained",
}
RIVAL_LIMIT_S = 300
DIVERGED_MM = 20.0


@dataclass(frozen=True)
class Scored:
    """Errors of one solve; with `aligned`, after the one motion that brings all centres nearest to
    the truth, as far as programs without a rig frame can be judged."""

    centres_mm: float
    rotations_deg: float
    seconds: float
    cpu: float


def report() -> str:
    """The section of docs/results.md."""
    solves, compared = [], []
    for name, kind, seeds in CASES:
        rig = load_rig(PROJECT / "rigs" / f"{name}.yaml")
        own = with_plain_board(rig) if kind == "plain" else rig
        runs = [
            _run(see_boards(own, seed=s, shots=SHOTS, stored=STORED / f"{name}-{kind}-{s}.npz"))
            for s in seeds
        ]
        solves.append(_solve_row(f"{name}, {kind}", runs))
        compared += _rival_rows(f"{name}, {kind}", *runs[0])
    return f"""## The rig from shared boards alone (synthetic)

{SHOTS} shots and one of the board on the floor, 1280 x 1024, two-faced boards (ChArUco as in `rigs/`;
plain: 9 x 7 squares of {PLAIN_SQUARE_MM:g} mm), corners as detected in rendered images (flat board, the
simulator's cameras, blur and noise; without stripes). Errors in the rig frame as the floor board fixes
it, nothing aligned; spread: RMS over pairs, axes and seeds of error over reported sigma. Seconds: wall,
CPU.

| rig, board | views of each seed | centres RMS mm | rotations RMS degrees | spread | solve s |
|---|---|---|---|---|---|
{chr(10).join(solves)}

Others on the same corners of the first seed, each camera calibrated by itself before by us; which end
of a plain board is which is told to them. Here all are carried by one motion onto the true camera
centres, since they know no rig frame. Ratios to ours in brackets.

| rig, board | | centres RMS mm | rotations RMS degrees | s wall | s CPU |
|---|---|---|---|---|---|
{chr(10).join(compared)}
"""


def with_plain_board(rig: Rig) -> Rig:
    """The rig with a plain checkerboard in place of its ChArUco board."""
    board = rig.boards[0]
    plain = Board(
        name=board.name,
        columns=board.columns,
        rows=board.rows,
        square_mm=PLAIN_SQUARE_MM,
        margin_mm=board.margin_mm,
        faces=board.faces,
        thickness_mm=board.thickness_mm,
    )
    return rig.model_copy(update={"boards": (plain,)})


def _run(seen: SeenRig) -> tuple[SeenRig, PlacedRig, dict[str, Camera], Scored]:
    boards = {board.name: board for board in seen.rig.boards}
    calibrated, _ = calibrate_cameras(seen.rig, seen.views, boards)
    located = locate_views(seen.views, calibrated, boards, [])
    cameras = {name: found.camera for name, found in calibrated.items()}
    wall, cpu = time.perf_counter(), time.process_time()
    placed = place_rig(seen.rig, located, cameras)
    seconds = time.perf_counter() - wall, time.process_time() - cpu
    return seen, placed, cameras, _score(seen, placed.rig_from_camera, *seconds)


def _score(
    seen: SeenRig, placings: dict[str, RigidTransform], seconds: float, cpu: float
) -> Scored:
    pairs = [(placings[name], seen.pairs[name].rig_from_camera) for name in placings]
    centres = [np.sum((found.translation - true.translation) ** 2) for found, true in pairs]
    turns = [(found.inverse() @ true).angle ** 2 for found, true in pairs]
    return Scored(
        float(np.sqrt(np.mean(centres))),
        float(np.degrees(np.sqrt(np.mean(turns)))),
        seconds,
        cpu,
    )


def _aligned(seen: SeenRig, placings: dict[str, RigidTransform], scored: Scored) -> Scored:
    names = sorted(placings)
    motion = rigid_fit(
        np.array([placings[name].translation for name in names]),
        np.array([seen.pairs[name].rig_from_camera.translation for name in names]),
    )
    moved = {name: motion @ placings[name] for name in names}
    return _score(seen, moved, scored.seconds, scored.cpu)


def _solve_row(
    title: str, runs: Sequence[tuple[SeenRig, PlacedRig, dict[str, Camera], Scored]]
) -> str:
    normalized = np.concatenate([_normalized(seen, placed) for seen, placed, _, _ in runs])
    scores = [scored for *_, scored in runs]
    centres = np.sqrt(np.mean([s.centres_mm**2 for s in scores]))
    turns = np.sqrt(np.mean([s.rotations_deg**2 for s in scores]))
    views = ", ".join(str(len(placed.views)) for _, placed, _, _ in runs)
    return (
        f"| {title} | {views} | {centres:.3f} | {turns:.4f} | "
        f"{np.sqrt(np.mean(normalized**2)):.2f} | "
        f"{np.mean([s.seconds for s in scores]):.1f}, {np.mean([s.cpu for s in scores]):.1f} |"
    )


def _normalized(seen: SeenRig, placed: PlacedRig) -> Array:
    """Error over sigma of every coordinate of every centre."""
    return np.concatenate(
        [
            (found.translation - seen.pairs[name].rig_from_camera.translation)
            / position_sigma(placed.covariance, name, found.translation)
            for name, found in placed.rig_from_camera.items()
        ]
    )


def _rival_rows(
    title: str, seen: SeenRig, placed: PlacedRig, cameras: dict[str, Camera], scored: Scored
) -> list[str]:
    ours = _aligned(seen, placed.rig_from_camera, scored)
    rows = [
        f"| {title} | ours | {ours.centres_mm:.3f} | {ours.rotations_deg:.4f} | "
        f"{ours.seconds:.1f} | {ours.cpu:.1f} |"
    ]
    for method, label in RIVALS.items():
        found = _rival(method, seen, placed.views, cameras)
        if isinstance(found, str):
            rows.append(f"| | {label} | {found} | | | |")
            continue
        their = _aligned(seen, *found)
        if their.centres_mm > DIVERGED_MM:
            rows.append(f"| | {label} | diverges ({their.centres_mm:.0f} mm off) | | | |")
            continue
        rows.append(
            f"| | {label} | {their.centres_mm:.3f} ({their.centres_mm / ours.centres_mm:.1f}) | "
            f"{their.rotations_deg:.4f} ({their.rotations_deg / ours.rotations_deg:.1f}) | "
            f"{their.seconds:.1f} ({their.seconds / ours.seconds:.1f}) | "
            f"{their.cpu:.1f} ({their.cpu / ours.cpu:.1f}) |"
        )
    return rows


def _rival(
    method: str, seen: SeenRig, views: Sequence[LocatedView], cameras: dict[str, Camera]
) -> tuple[dict[str, RigidTransform], Scored] | str:
    """Placings in the first camera's frame and the time taken, or why there are none."""
    names = sorted(cameras)
    python = os.environ.get("RIVALS_PYTHON", sys.executable)
    with tempfile.TemporaryDirectory() as folder:
        source, target = Path(folder) / "corners.npz", Path(folder) / "found.npz"
        corners: dict[str, Any] = dict(_corners(seen.rig.boards[0], views, cameras, names))
        np.savez(source, **corners)
        line = [python, str(Path(__file__).with_name("rig_rivals.py")), method]
        try:
            done = subprocess.run(
                [*line, str(source), str(target)],
                capture_output=True,
                text=True,
                timeout=RIVAL_LIMIT_S,
                check=False,
            )
        except subprocess.TimeoutExpired:
            return f"not done after {RIVAL_LIMIT_S} s"
        if "No module named" in done.stderr:
            return "not installed (RIVALS_PYTHON names a Python that has it)"
        if done.returncode:
            return "fails: " + (done.stderr.strip().splitlines() or ["no reason given"])[-1][:120]
        with np.load(target) as stored:
            matrices, seconds = stored["camera_from_first"], stored["seconds"]
    if not np.all(np.isfinite(matrices)):
        return "diverges"
    placings = {
        name: RigidTransform.from_matrix(matrix).inverse()
        for name, matrix in zip(names, matrices, strict=True)
    }
    return placings, Scored(0.0, 0.0, float(seconds[0]), float(seconds[1]))


def _corners(
    board: Board, views: Sequence[LocatedView], cameras: dict[str, Camera], names: list[str]
) -> dict[str, Array]:
    points = corner_points(board)
    number = {tuple(point): k for k, point in enumerate(np.round(points, 4).tolist())}
    shots = sorted({view.shot for view in views})
    pixels = np.full((len(names), len(shots), len(points), 2), np.nan)
    for view in views:
        # Their cameras have no skew either.
        straight = cameras[view.pair].without_skew(view.pixels)
        chosen = [number[tuple(point)] for point in (np.round(view.points, 4) + 0.0).tolist()]
        pixels[names.index(view.pair), shots.index(view.shot), chosen] = straight
    own = [cameras[name] for name in names]
    return {
        "pixels": pixels,
        "points": points,
        "size": np.array([own[0].width, own[0].height]),
        "matrices": np.array([c.matrix * [[1, 0, 1], [1, 1, 1], [1, 1, 1]] for c in own]),
        "lenses": np.array([[c.k1, c.k2, 0.0, 0.0, 0.0] for c in own]),
    }
