"""The rig's solve against the truth and against other programs, on corners from rendered images."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.board_images import SeenRig, see_boards
from benchmarks.rivals import RIVALS, run_rival, with_lens
from bodyscan.arrays import Array, Mask
from bodyscan.geometry.camera import Camera
from bodyscan.geometry.lenses.opencv import Radial
from bodyscan.geometry.transforms import RigidTransform, fit_rigid_transform
from bodyscan.geometry.uncertainty import compute_position_sigma
from bodyscan.registration.rig_solve import RigSolution, solve_rig
from bodyscan.rig.board import Board
from bodyscan.rig.rig import Rig, load_rig
from bodyscan.simulation.layout import TruePair
from bodyscan.workflows.find_boards import calibrate_cameras, locate_views

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
"""A plain board must be seen whole: one of 9 x 7 squares of 70 mm hardly fits into the images."""
DIVERGED_MM = 20.0
BODY_RADIUS_MM, BODY_HEIGHT_MM = 200.0, 1800.0
BODY_STEP_MM = 25.0
STEEPEST_COSINE = 0.5
"""A pair measures a surface tilted up to 60 degrees away from its camera."""


@dataclass(frozen=True)
class Scored:
    """Errors of one solve; with `aligned`, after the rigid motion that brings all centres nearest
    to the truth, since programs without a rig frame can only be judged up to that."""

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
CPU; views: of each seed.

| rig, board | views | centres RMS mm | rotations RMS degrees | spread | solve s | two pairs |
|---|---|---|---|---|---|---|
{chr(10).join(solves)}

"Two pairs": the same surface point measured by two pairs, median difference in mm, from placings alone:
points every {BODY_STEP_MM:g} mm on a cylinder of the body's size (radius {BODY_RADIUS_MM:g} mm, height
{BODY_HEIGHT_MM:g} mm) about the rig's axis, for any two cameras that both see the point at less than
{np.degrees(np.arccos(STEEPEST_COSINE)):.0f} degrees from its normal; the point as it truly lies in
each camera, carried into the rig frame by the two estimated placings, and how far these two are apart.
Nothing hides a point; errors of lenses (which partly make up for those of the placings) and of the
light are not in it.

Others on the same corners of the first seed, each camera calibrated by itself before by us with k1 and
k2, which is the lens that these cameras have; which end
of a plain board is which is told to them. Here all are carried by one motion onto the true camera
centres, since they know no rig frame. Ratios to ours in brackets. By default aniposelib refines the
lenses too, with one focal length a camera, which these cameras do not have; "lenses kept": it does not.
OpenCV and caliscope get each face of a board as a flat board of its own.

| rig, board | | centres RMS mm | rotations RMS degrees | s wall | s CPU |
|---|---|---|---|---|---|
{chr(10).join(compared)}
"""


def with_plain_board(rig: Rig) -> Rig:
    """The rig with a plain checkerboard instead of its ChArUco board."""
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


def _run(seen: SeenRig) -> tuple[SeenRig, RigSolution, dict[str, Camera], Scored]:
    calibrated = calibrate_cameras(seen.rig, seen.views).value
    located = locate_views(seen.rig, seen.views, calibrated).value
    cameras = {name: found.camera for name, found in calibrated.items()}
    wall, cpu = time.perf_counter(), time.process_time()
    placed = solve_rig(seen.rig, located, cameras).value
    seconds = time.perf_counter() - wall, time.process_time() - cpu
    return (
        seen,
        placed,
        with_lens(Radial(), placed.views, cameras),
        _score(seen, placed.rig_from_camera, *seconds),
    )


def _score(
    seen: SeenRig, placings: dict[str, RigidTransform], seconds: float, cpu: float
) -> Scored:
    pairs = [(placings[name], seen.pairs[name].rig_from_camera) for name in placings]
    centres = [np.sum((found.translation - true.translation) ** 2) for found, true in pairs]
    turns = [(found.inverse() @ true).angle ** 2 for found, true in pairs]
    return Scored(
        float(np.sqrt(np.mean(centres))), float(np.degrees(np.sqrt(np.mean(turns)))), seconds, cpu
    )


def _aligned(seen: SeenRig, placings: dict[str, RigidTransform], scored: Scored) -> Scored:
    names = sorted(placings)
    motion = fit_rigid_transform(
        np.array([placings[name].translation for name in names]),
        np.array([seen.pairs[name].rig_from_camera.translation for name in names]),
    )
    moved = {name: motion @ placings[name] for name in names}
    return _score(seen, moved, scored.seconds, scored.cpu)


def _solve_row(
    title: str, runs: Sequence[tuple[SeenRig, RigSolution, dict[str, Camera], Scored]]
) -> str:
    normalized = np.concatenate([_normalized(seen, placed) for seen, placed, _, _ in runs])
    scores = [scored for *_, scored in runs]
    centres = np.sqrt(np.mean([s.centres_mm**2 for s in scores]))
    turns = np.sqrt(np.mean([s.rotations_deg**2 for s in scores]))
    views = ", ".join(str(len(placed.views)) for _, placed, _, _ in runs)
    return (
        f"| {title} | {views} | {centres:.3f} | {turns:.4f} | "
        f"{np.sqrt(np.mean(normalized**2)):.2f} | "
        f"{np.mean([s.seconds for s in scores]):.1f}, {np.mean([s.cpu for s in scores]):.1f} | "
        f"{np.median(np.concatenate([_two_pairs(seen, p) for seen, p, _, _ in runs])):.3f} |"
    )


def _two_pairs(seen: SeenRig, placed: RigSolution) -> Array:
    """Distance (M,) mm between two cameras' estimates of one point on a body-sized cylinder, for
    every point and any two cameras that see it."""
    angles = np.arange(0.0, 2.0 * np.pi, BODY_STEP_MM / BODY_RADIUS_MM)
    heights = np.arange(0.0, BODY_HEIGHT_MM, BODY_STEP_MM)
    angle, height = (grid.ravel() for grid in np.meshgrid(angles, heights))
    normals = np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], axis=-1)
    points = BODY_RADIUS_MM * normals + height[:, None] * [0.0, 0.0, 1.0]
    put, visible = [], []
    for name, found in placed.rig_from_camera.items():
        true = seen.pairs[name]
        put.append((found @ true.rig_from_camera.inverse()).apply(points))
        visible.append(_sees(true, points, normals))
    apart = [
        np.linalg.norm(put[a] - put[b], axis=1)[visible[a] & visible[b]]
        for a in range(len(put))
        for b in range(a)
    ]
    return np.concatenate(apart)


def _sees(pair: TruePair, points: Array, normals: Array) -> Mask:
    """Which points (N, 3) with normals (N, 3) face the camera and lie in its image."""
    towards = pair.rig_from_camera.translation - points
    cosine = np.sum(towards * normals, axis=1) / np.linalg.norm(towards, axis=1)
    in_camera = pair.rig_from_camera.inverse().apply(points)
    before = in_camera[:, 2] > 1.0
    pixels = np.full((len(points), 2), np.nan)
    pixels[before] = pair.camera.image(in_camera[before])
    size = [pair.camera.width - 1, pair.camera.height - 1]
    # A lens's polynomial folds points far outside its image back into it.
    farthest = np.abs(pair.camera.directions(np.array([[0.0, 0.0], size]))).max()
    beside = np.abs(in_camera[:, :2]).max(axis=1) > farthest * in_camera[:, 2]
    within = np.all((pixels >= 0) & (pixels <= size), axis=1)
    return np.asarray(before & ~beside & within & (cosine > STEEPEST_COSINE))


def _normalized(seen: SeenRig, placed: RigSolution) -> Array:
    """Error over sigma of every coordinate of every centre."""
    return np.concatenate(
        [
            (found.translation - seen.pairs[name].rig_from_camera.translation)
            / compute_position_sigma(placed.covariance, name, found.translation)
            for name, found in placed.rig_from_camera.items()
        ]
    )


def _rival_rows(
    title: str, seen: SeenRig, placed: RigSolution, cameras: dict[str, Camera], scored: Scored
) -> list[str]:
    ours = _aligned(seen, placed.rig_from_camera, scored)
    rows = [
        f"| {title} | ours | {ours.centres_mm:.3f} | {ours.rotations_deg:.4f} | "
        f"{ours.seconds:.1f} | {ours.cpu:.1f} |"
    ]
    for method, label in RIVALS.items():
        found = run_rival(method, seen.rig.boards[0], placed.views, cameras)
        if isinstance(found, str):
            rows.append(f"| | {label} | {found} | | | |")
            continue
        their = _aligned(seen, found.placings, Scored(0.0, 0.0, found.seconds, found.cpu))
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
