"""The rival: a projector as a 2 x 4 matrix (Bolles 1981), by least squares and by OpenCV."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from bodyscan.geometry.camera import Camera
from bodyscan.geometry.lens_sheets import LensSheets
from bodyscan.geometry.light_planes import Axis, LightPlanes

Array = NDArray[np.float64]

MOST_POINTS = 20000


@dataclass(frozen=True, eq=False)
class PinholeProjector:
    """matrix: (2, 4) with s ~ (row 0 . X) / (row 1 . X), X homogeneous in the camera frame, mm.

    Scaled so that the first three numbers of row 1 are a unit vector, the projector's axis.
    """

    matrix: Array

    def stripe(self, points: Array) -> Array:
        """s (...,) of points (..., 3)."""
        above, below = np.moveaxis(points @ self.matrix[:, :3].T + self.matrix[:, 3], -1, 0)
        return above / below

    def sheets(self, points: Array, stripes: int, direction: Axis) -> LensSheets:
        """The same model as a projector without lens that shines at points (N, 3) on boards."""
        return LensSheets.pinhole(self.matrix, points.mean(axis=0), stripes, direction)

    def planes(self, stripes: int, direction: Axis) -> LightPlanes:
        """The same model as light planes: all share one line, the projector's centre lies on it."""
        s = np.arange(stripes + 1.0)[:, None]
        planes = self.matrix[0] - s * self.matrix[1]
        planes /= np.linalg.norm(planes[:, :3], axis=1, keepdims=True)
        planes *= np.where(planes[:, 3:] < 0.0, -1.0, 1.0)
        return LightPlanes(planes, np.full((stripes + 1, 4, 4), np.nan), direction)


def fit_pinhole(points: Array, s: Array) -> PinholeProjector:
    """From points (N, 3) on boards, camera frame, and their stripe coordinates (N,); robust.

    Linear start, then least squares on s with a Cauchy loss, on at most MOST_POINTS of them.
    """
    every = -(-len(points) // MOST_POINTS)
    points, s = points[::every], s[::every]
    centre, size = points.mean(axis=0), points.std()
    scaled = np.column_stack([(points - centre) / size, np.ones(len(points))])
    middle, half = float(np.mean(s)), float(np.std(s))
    t = (s - middle) / half
    _, vectors = np.linalg.eigh(_moments(np.concatenate([scaled, -t[:, None] * scaled], axis=1)))
    start = vectors[:, 0] / np.linalg.norm(vectors[4:7, 0])

    def residuals(flat: Array) -> Array:
        return (scaled @ flat[:4]) / (scaled @ flat[4:]) - t

    spread = 1.4826 * float(np.median(np.abs(residuals(start)))) + 1e-9
    solved = least_squares(residuals, start, loss="cauchy", f_scale=3.0 * spread).x.reshape(2, 4)
    solved[0] = solved[0] * half + middle * solved[1]
    solved[:, :3] /= size
    solved[:, 3] -= solved[:, :3] @ centre
    solved /= np.linalg.norm(solved[1, :3])
    return PinholeProjector(solved * np.sign(np.sum(points[0] * solved[1, :3]) + solved[1, 3]))


def fit_pinhole_opencv(
    camera: Camera,
    boards: Sequence[Array],
    pixels: Sequence[Array],
    rows: Sequence[Array],
    start: PinholeProjector,
    *,
    rounds: int = 5,
) -> PinholeProjector:
    """`cv2.stereoCalibrate` of camera and projector on board corners.

    boards: (N, 3) corners of each board, mm.  pixels: (N, 2) in the camera, px.  rows: (N,) stripe
    coordinate at each corner.  Stripes of one direction leave the other projector coordinate
    unknown: it is imputed from the model found so far (starting with `start`), a few rounds.
    Source: missing data by alternating imputation and fit, as in expectation maximisation.
    """
    camera_matrix = camera.matrix
    camera_matrix[0, 1] = 0.0
    lens = camera.lens.opencv()
    seen = [camera.without_skew(p).astype(np.float32) for p in pixels]
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
            flags=cv2.CALIB_FIX_INTRINSIC,
        )
        rotation, translation = solved[5], solved[6]
    whole = matrix @ np.column_stack([rotation, translation])
    return PinholeProjector(whole[1:] / np.linalg.norm(whole[2, :3]))


def _as_camera(model: PinholeProjector) -> tuple[Array, Array, Array]:
    """A full pinhole whose rows are the model: same focal length both ways, columns centred."""
    axis = model.matrix[1, :3]
    centre = float(model.matrix[0, :3] @ axis)
    down = model.matrix[0, :3] - centre * axis
    focal = float(np.linalg.norm(down))
    down /= focal
    rotation = np.stack([np.cross(down, axis), down, axis])
    depth = model.matrix[1, 3]
    translation = np.array([0.0, (model.matrix[0, 3] - centre * depth) / focal, depth])
    matrix = np.array([[focal, 0.0, 500.0], [0.0, focal, centre], [0.0, 0.0, 1.0]])
    return matrix, rotation, translation[:, None]


def _moments(rows: Array) -> Array:
    return rows.T @ rows
