"""Other programs run on our corners, each in a separate process (see rig_rivals.py)."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from bodyscan.arrays import Array
from bodyscan.boards.board_layout import compute_corner_points
from bodyscan.calibration.board_views import LocatedView, PlanarView
from bodyscan.calibration.camera import calibrate_camera
from bodyscan.geometry.camera import Camera
from bodyscan.geometry.lenses import lens_from_opencv
from bodyscan.geometry.lenses.lens import Lens
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.rig.board import Board

RIVALS = {
    "opencv-multiview": "OpenCV 5 `calibrateMultiview`, boards seen whole",
    "opencv-multiview-partly": "OpenCV 5 `calibrateMultiview`, in part too",
    "aniposelib": "aniposelib",
    "aniposelib-lenses-kept": "aniposelib, lenses kept",
    "caliscope": "caliscope",
    "stereo-chain": "pairwise stereo, chained",
}
LIMIT_S = 300


@dataclass(frozen=True, eq=False)
class RivalFound:
    """Poses in the frame of the first camera (by name), cameras as the rival leaves them, and
    seconds (wall-clock, processor)."""

    placings: dict[str, RigidTransform]
    cameras: dict[str, Camera]
    seconds: float
    cpu: float


def run_rival(
    method: str, board: Board, views: Sequence[LocatedView], cameras: Mapping[str, Camera]
) -> RivalFound | str:
    """A rival's result on one board's views, started from `cameras`, or why it has none.

    RIVALS_PYTHON: Pythons to try in turn, separated as in PATH; this one if it is not set.
    """
    names = sorted(cameras)
    pythons = os.environ.get("RIVALS_PYTHON", sys.executable).split(os.pathsep)
    with tempfile.TemporaryDirectory() as folder:
        source, target = Path(folder) / "corners.npz", Path(folder) / "found.npz"
        np.savez(source, **_corners(board, views, cameras, names))
        for python in pythons:
            failed = _run([python, method, str(source), str(target)])
            if failed is None or "No module named" not in failed:
                break
        if failed is not None:
            missing = "No module named" in failed
            return "not installed (RIVALS_PYTHON names a Python that has it)" if missing else failed
        with np.load(target) as stored:
            found = {name: stored[name] for name in stored.files}
    if not np.all(np.isfinite(found["camera_from_first"])):
        return "diverges"
    return RivalFound(
        {
            name: RigidTransform.from_matrix(matrix).inverse()
            for name, matrix in zip(names, found["camera_from_first"], strict=True)
        },
        {
            name: _camera(cameras[name], matrix, lens)
            for name, matrix, lens in zip(names, found["matrices"], found["lenses"], strict=True)
        },
        *(float(s) for s in found["seconds"]),
    )


def with_lens(
    lens: Lens, views: Sequence[LocatedView], cameras: Mapping[str, Camera]
) -> dict[str, Camera]:
    """Each camera calibrated by itself from its views, with a lens that rivals have."""
    return {
        name: calibrate_camera(
            [PlanarView(v.shot, v.points, v.pixels) for v in views if v.pair == name],
            camera.width,
            camera.height,
            lens,
        ).camera
        for name, camera in cameras.items()
    }


def shear(camera: Camera, pixels: Array) -> Array:
    """Shear px (N, 2) by -gamma/beta to what a camera without skew would see."""
    return pixels - camera.gamma / camera.beta * np.outer(pixels[:, 1] - camera.v0, [1.0, 0.0])


def without_skew(views: Sequence[LocatedView], cameras: Mapping[str, Camera]) -> list[LocatedView]:
    """Views as seen by cameras without skew, which the rivals assume."""
    return [replace(v, pixels=shear(cameras[v.pair], v.pixels)) for v in views]


def _run(line: list[str]) -> str | None:
    python, *arguments = line
    script = str(Path(__file__).with_name("rig_rivals.py"))
    try:
        done = subprocess.run(
            [python, script, *arguments],
            capture_output=True,
            text=True,
            timeout=LIMIT_S,
            check=False,
        )
    except subprocess.TimeoutExpired:
        return f"not done after {LIMIT_S} s"
    if not done.returncode:
        return None
    return "fails: " + (done.stderr.strip().splitlines() or ["no reason given"])[-1][:120]


def _camera(ours: Camera, matrix: Array, lens: Array) -> Camera:
    return replace(
        ours,
        alpha=matrix[0, 0],
        beta=matrix[1, 1],
        gamma=0.0,
        u0=matrix[0, 2],
        v0=matrix[1, 2],
        lens=lens_from_opencv(np.pad(lens, (0, max(0, 5 - len(lens))))),  # radial gives four
    )


def _corners(
    board: Board, views: Sequence[LocatedView], cameras: Mapping[str, Camera], names: Sequence[str]
) -> dict[str, Any]:
    """Input of rig_rivals.py."""
    points = compute_corner_points(board)
    number = {tuple(point): k for k, point in enumerate(np.round(points, 4).tolist())}
    shots = sorted({view.shot for view in views})
    pixels = np.full((len(names), len(shots), len(points), 2), np.nan)
    for view in without_skew(views, cameras):
        chosen = [number[tuple(point)] for point in (np.round(view.points, 4) + 0.0).tolist()]
        pixels[names.index(view.pair), shots.index(view.shot), chosen] = view.pixels
    own = [cameras[name] for name in names]
    lenses = np.zeros((len(own), max(len(camera.lens.opencv()) for camera in own)))
    for row, camera in zip(lenses, own, strict=True):  # OpenCV takes missing coefficients for 0
        row[: len(camera.lens.opencv())] = camera.lens.opencv()
    return {
        "pixels": pixels,
        "points": points,
        "grid": np.array([board.columns, board.rows, board.square_mm]),
        "size": np.array([own[0].width, own[0].height]),
        "matrices": np.array([c.matrix * [[1, 0, 1], [1, 1, 1], [1, 1, 1]] for c in own]),
        "lenses": lenses,
    }
