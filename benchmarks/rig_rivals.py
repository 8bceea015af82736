"""Other programs on the same corners: `python rig_rivals.py METHOD corners.npz found.npz`.

Run as a separate script by whichever Python has the rival installed; needs numpy, scipy and OpenCV.
corners.npz: pixels (C, F, N, 2), NaN where not seen; points (N, 3) mm; size (2,); grid (squares
across, down, mm per square); matrices (C, 3, 3) and lenses (C, 4 to 8), each camera calibrated by
itself. found.npz: `camera_from_first` (C, 4, 4), `matrices` and `lenses` as the rival leaves them,
`seconds` (wall, CPU).
"""

from __future__ import annotations

import contextlib
import io
import sys
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.sparse.csgraph import breadth_first_order, minimum_spanning_tree

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Corners = dict[str, Any]
Found = tuple[Array, Array, Array]
"""camera_from_first (C, 4, 4), matrices (C, 3, 3), lenses (C, 8)."""

FEWEST = 8
RADIAL = cv2.CALIB_FIX_K3 | cv2.CALIB_ZERO_TANGENT_DIST
"""Terms fixed for a lens that was given without them."""


def opencv_multiview(corners: Corners, *, partly: bool = False) -> Found:
    """OpenCV 5's calibrateMultiview, on boards seen whole.

    partly: also boards seen in part, with their other corners marked as its manual says. Metres: it
        considers points in millimetres to be collinear.
    """
    pixels, points = _faces_apart(corners)
    seen = np.isfinite(pixels[..., 0])
    mask = seen.sum(axis=2) >= (FEWEST if partly else seen.shape[2])
    used = mask.any(axis=0)
    pixels, seen, mask, points = pixels[:, used], seen[:, used], mask[:, used], points[used]
    count = len(mask)
    marked = np.where(seen[..., None], pixels, -1.0).astype(np.float32)
    terms = 0 if corners["lenses"][:, 2:].any() else RADIAL
    _, matrices, lenses, rotations, shifts = cv2.calibrateMultiview(
        list((points / 1000.0).astype(np.float32)),
        [list(marked[k]) for k in range(count)],
        [tuple(int(v) for v in corners["size"])] * count,
        mask.astype(np.uint8),
        np.full((count, 1), cv2.CALIB_MODEL_PINHOLE, np.uint8),
        list(corners["matrices"]),
        list(corners["lenses"]),
        None,
        None,
        flagsForIntrinsics=np.full((count, 1), cv2.CALIB_USE_INTRINSIC_GUESS | terms, np.int32),
        flags=cv2.CALIB_USE_INTRINSIC_GUESS,
    )
    vectors = [np.asarray(r, float) for r in rotations]
    turns = [cv2.Rodrigues(r)[0] if r.size == 3 else r.reshape(3, 3) for r in vectors]
    placings = _stacked(np.array(turns), 1000.0 * np.array(shifts, float).reshape(count, 3))
    return placings, np.array(matrices, float), _padded(lenses)


def stereo_chain(corners: Corners) -> Found:
    """cv2.stereoCalibrate along the tree of links with most corners in common."""
    pixels, seen = _seen(corners)
    common = np.einsum("afn,bfn->ab", seen.astype(float), seen.astype(float))
    tree = minimum_spanning_tree(-np.triu(common, 1))
    order, before = breadth_first_order(tree, 0, directed=False)
    found = np.tile(np.eye(4), (len(pixels), 1, 1))
    # Without that flag the terms of a lens's denominator are taken to be zero.
    rational = cv2.CALIB_RATIONAL_MODEL if corners["lenses"][:, 5:].any() else 0
    for name in order[1:]:
        first = before[name]
        both = seen[first] & seen[name]
        frames = [f for f in range(len(both)) if both[f].sum() >= FEWEST]
        *_, rotation, shift, _, _ = cv2.stereoCalibrate(
            [corners["points"][both[f]].astype(np.float32) for f in frames],
            [pixels[first, f][both[f]].astype(np.float32) for f in frames],
            [pixels[name, f][both[f]].astype(np.float32) for f in frames],
            corners["matrices"][first],
            corners["lenses"][first],
            corners["matrices"][name],
            corners["lenses"][name],
            tuple(int(v) for v in corners["size"]),
            flags=cv2.CALIB_FIX_INTRINSIC | rational,
            criteria=(cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 200, 1e-9),
        )
        found[name] = _stacked(rotation[None], shift.reshape(1, 3))[0] @ found[first]
    return found, corners["matrices"], corners["lenses"]


def aniposelib(corners: Corners, *, lenses_kept: bool = False) -> Found:
    """aniposelib: its tree of poses, then its bundle adjustment with the board as constraint.

    It refines one focal length, k1 and k2 (without extra_dist it sets k2 to zero), or no lens.
    """
    # Not a dependency of the project: see RIVALS_PYTHON in rig.py.
    from aniposelib.cameras import Camera, CameraGroup  # type: ignore[import-not-found]
    from aniposelib.utils import get_initial_extrinsics  # type: ignore[import-not-found]

    pixels, seen = _seen(corners)
    count, frames, per_frame = seen.shape
    rows = []
    for f in range(frames):
        row: dict[int, Array] = {}
        for k in np.flatnonzero(seen[:, f].sum(axis=1) >= FEWEST):
            chosen = seen[k, f]
            _, turn, shift = cv2.solvePnP(
                corners["points"][chosen],
                pixels[k, f][chosen],
                corners["matrices"][k],
                corners["lenses"][k],
            )
            row[int(k)] = _stacked(cv2.Rodrigues(turn)[0][None], shift.reshape(1, 3))[0]
        rows.append(row)
    rtvecs = np.full((count, frames, 6), np.nan)
    for f, row in enumerate(rows):
        for number, pose in row.items():
            rtvecs[number, f] = [*cv2.Rodrigues(pose[:3, :3])[0].ravel(), *pose[:3, 3]]
    cameras = [
        Camera(
            matrix=corners["matrices"][k],
            dist=corners["lenses"][k],
            size=tuple(int(v) for v in corners["size"]),
            name=str(k),
            extra_dist=True,
        )
        for k in range(count)
    ]
    group = CameraGroup(cameras)
    turns, shifts = get_initial_extrinsics(rtvecs, group.get_names())
    group.set_rotations(turns)
    group.set_translations(shifts)
    image_points = np.where(seen[..., None], pixels, np.nan).reshape(count, -1, 2)
    extra = {
        "objp": np.tile(corners["points"], (frames, 1)),
        "ids": np.repeat(np.arange(frames), per_frame),
        "rvecs": np.repeat(rtvecs[:, :, :3], per_frame, axis=1),
        "tvecs": np.repeat(rtvecs[:, :, 3:], per_frame, axis=1),
    }
    twice = seen.reshape(count, -1).sum(axis=0) >= 2
    extra = {k: v[:, twice] if v.ndim == 3 else v[twice] for k, v in extra.items()}
    group.bundle_adjust_iter(
        image_points[:, twice], extra, only_extrinsics=lenses_kept, verbose=False
    )
    matrices = [cv2.Rodrigues(np.asarray(c.get_rotation(), float))[0] for c in group.cameras]
    places = np.array([np.ravel(c.get_translation()) for c in group.cameras])
    camera_from_world = _stacked(np.array(matrices), places)
    return (
        camera_from_world @ np.linalg.inv(camera_from_world[0]),
        np.array([c.get_camera_matrix() for c in group.cameras], float),
        _padded([c.get_distortions() for c in group.cameras]),
    )


def caliscope(corners: Corners) -> Found:
    """caliscope's whole pipeline: pairwise poses, bundle adjustment with the board's distances as
    constraints, outlier removal, once more. Metres; each face of a board is a separate frame."""
    from caliscope.api import (  # type: ignore[import-not-found]
        CameraArray,
        CameraData,
        Charuco,
        ConstraintSet,
        ImagePoints,
        calibrate_extrinsics,
    )
    from pandas import DataFrame  # type: ignore[import-untyped]

    pixels, points = _faces_apart(corners)
    seen = np.isfinite(pixels[..., 0])
    columns, rows, square = corners["grid"]
    board = Charuco.from_squares(
        columns=int(columns), rows=int(rows), square_size_cm=float(square) / 10.0
    )
    # Its constraints name corners as OpenCV's board does: row by row.
    across, down = (np.round((p - p.min()) / square).astype(int) for p in points.T[:2])
    names = (down * (int(columns) - 1) + across).T
    camera, frame, corner = np.nonzero(seen)
    table = DataFrame(
        {
            "sync_index": frame,
            "cam_id": camera,
            "object_id": 0,
            "keypoint_id": names[frame, corner],
            **{f"img_loc_{axis}": pixels[seen][:, k] for k, axis in enumerate("xy")},
            **{f"obj_loc_{a}": points[frame, corner, k] / 1e3 for k, a in enumerate("xyz")},
        }
    )
    cameras = {
        k: CameraData(
            cam_id=k,
            size=tuple(int(v) for v in corners["size"]),
            matrix=corners["matrices"][k],
            distortions=corners["lenses"][k],
        )
        for k in range(len(seen))
    }
    constraints = ConstraintSet.from_charuco(board)
    run = calibrate_extrinsics(ImagePoints(table), CameraArray(cameras), constraints)
    found = [run.capture_volume.camera_array.cameras[k] for k in range(len(seen))]
    camera_from_world = _stacked(
        np.array([c.rotation for c in found], float),
        1000.0 * np.array([np.ravel(c.translation) for c in found], float),
    )
    return (
        camera_from_world @ np.linalg.inv(camera_from_world[0]),
        np.array([c.matrix for c in found], float),
        _padded([c.distortions for c in found]),
    )


METHODS: dict[str, Callable[[Corners], Found]] = {
    "opencv-multiview": opencv_multiview,
    "opencv-multiview-partly": partial(opencv_multiview, partly=True),
    "stereo-chain": stereo_chain,
    "aniposelib": aniposelib,
    "aniposelib-lenses-kept": partial(aniposelib, lenses_kept=True),
    "caliscope": caliscope,
}


def _faces_apart(corners: Corners) -> tuple[Array, Array]:
    """Pixels (C, G, M, 2) and points (G, M, 3), z = 0, mm:
    each face of each frame as a flat board."""
    pixels, points = np.asarray(corners["pixels"], float), np.asarray(corners["points"], float)
    faces = 1 + int(np.ptp(points[:, 2]) > 0)
    frames = pixels.shape[1]
    flat = points.reshape(faces, -1, 3) * [1.0, 1.0, 0.0]
    return np.concatenate(np.split(pixels, faces, axis=2), axis=1), np.repeat(flat, frames, axis=0)


def _seen(corners: Corners) -> tuple[Array, Mask]:
    pixels = np.asarray(corners["pixels"], float)
    return pixels, np.isfinite(pixels[..., 0])


def _padded(lenses: Any) -> Array:
    """Coefficients (C, 8), padded with zeros as OpenCV assumes for missing ones."""
    found = np.zeros((len(lenses), 8))
    for row, lens in zip(found, lenses, strict=True):
        own = np.ravel(np.asarray(lens, float))[:8]
        row[: len(own)] = own
    return found


def _stacked(rotations: Array, shifts: Array) -> Array:
    found = np.tile(np.eye(4), (len(rotations), 1, 1))
    found[:, :3, :3], found[:, :3, 3] = rotations, shifts
    return found


def main() -> None:
    method, source, target = sys.argv[1:]
    with np.load(source) as stored:
        corners = {name: stored[name] for name in stored.files}
    # aniposelib draws its samples from numpy's own generator.
    np.random.seed(0)  # noqa: NPY002
    wall, cpu = time.perf_counter(), time.process_time()
    with contextlib.redirect_stdout(io.StringIO()):
        placings, matrices, lenses = METHODS[method](corners)
    seconds = np.array([time.perf_counter() - wall, time.process_time() - cpu])
    np.savez(target, camera_from_first=placings, matrices=matrices, lenses=lenses, seconds=seconds)


if __name__ == "__main__":
    main()
