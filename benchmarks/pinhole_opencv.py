"""A projector as a 2 x 4 matrix (Bolles 1981), calibrated with a camera by OpenCV."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from benchmarks.rivals import shear
from bodyscan.arrays import Array
from bodyscan.geometry.camera import Camera


def fit_pinhole_opencv(
    camera: Camera,
    boards: Sequence[Array],
    pixels: Sequence[Array],
    rows: Sequence[Array],
    start: Array,
    *,
    rounds: int = 5,
) -> Array:
    """`cv2.stereoCalibrate` of camera and projector on board corners.

    boards: (N, 3) corners of each board, mm.
    pixels: (N, 2) in the camera, px.
    rows: (N,) stripe coordinate at each corner.

    Stripes of one direction leave the other projector coordinate unknown: it is imputed from the
    current model (starting with `start`) for a few rounds. Source: missing data by alternating
    imputation and fit, as in expectation maximisation.
    """
    camera_matrix = camera.matrix
    camera_matrix[0, 1] = 0.0
    lens = camera.lens.opencv()
    seen = [shear(camera, p).astype(np.float32) for p in pixels]
    objects = [b.astype(np.float32) for b in boards]
    matrix, rotation, translation = _as_camera(start)
    poses = [
        cv2.solvePnP(o, p, camera_matrix, lens)[1:3] for o, p in zip(objects, seen, strict=True)
    ]
    places = [(cv2.Rodrigues(r)[0] @ o.T + t).T for o, (r, t) in zip(objects, poses, strict=True)]
    size = (2 * int(abs(matrix[0, 2])) + 1, 2 * int(abs(matrix[1, 2])) + 1)
    flags = (
        cv2.CALIB_USE_INTRINSIC_GUESS
        | cv2.CALIB_FIX_ASPECT_RATIO
        | cv2.CALIB_ZERO_TANGENT_DIST
        | cv2.CALIB_FIX_K1
        | cv2.CALIB_FIX_K2
        | cv2.CALIB_FIX_K3
    )
    # Without that flag the terms of a lens's denominator are taken to be zero.
    rational = cv2.CALIB_RATIONAL_MODEL if np.any(lens.ravel()[5:]) else 0
    for _ in range(rounds):
        imputed = []
        for place, row in zip(places, rows, strict=True):
            x = place @ rotation.T + translation.ravel()
            column = matrix[0, 0] * x[:, 0] / x[:, 2] + matrix[0, 2]
            imputed.append(np.column_stack([column, row]).astype(np.float32))
        _, matrix, *_ = cv2.calibrateCamera(
            objects, imputed, size, matrix.copy(), np.zeros(5), flags=flags
        )
        solved = cv2.stereoCalibrate(
            objects,
            seen,
            imputed,
            camera_matrix,
            lens,
            matrix.copy(),
            np.zeros(5),
            size,
            flags=cv2.CALIB_FIX_INTRINSIC | rational,
        )
        rotation, translation = solved[5], solved[6]
    whole = matrix @ np.column_stack([rotation, translation])
    return np.asarray(whole[1:] / np.linalg.norm(whole[2, :3]))


def _as_camera(model: Array) -> tuple[Array, Array, Array]:
    """A full pinhole whose rows are the model: equal focal lengths, centred columns."""
    axis = model[1, :3]
    centre = float(model[0, :3] @ axis)
    down = model[0, :3] - centre * axis
    focal = float(np.linalg.norm(down))
    down /= focal
    rotation = np.stack([np.cross(down, axis), down, axis])
    depth = model[1, 3]
    translation = np.array([0.0, (model[0, 3] - centre * depth) / focal, depth])
    matrix = np.array([[focal, 0.0, 500.0], [0.0, focal, centre], [0.0, 0.0, 1.0]])
    return matrix, rotation, translation[:, None]
