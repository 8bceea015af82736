"""Check a calibration that was read: sizes, names, and numbers that real cameras can have.

A wrong number that loads gives a wrong body with a good verdict. So everything in a file is checked
against what any camera, pose and covariance must satisfy; a hash also shows whether it was changed.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from bodyscan.arrays import Array, Floats
from bodyscan.calibration.pair import PairCalibration
from bodyscan.geometry.camera import Camera
from bodyscan.geometry.lens_sheets import FRAME, LENS_SIGMAS, SCALE, LensSheets
from bodyscan.geometry.light_planes import LightPlanes, SmoothSheets
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.registration.rig_calibration import ObservedCorners, RigCalibration
from bodyscan.rig.pair import Pair

ORTHONORMAL = 1e-6  # rounding leaves 1e-15; at 2 m this is 2 um
SYMMETRIC, POSITIVE = 1e-6, -1e-6  # of a correlation, which is 1 at most; solves leave 1e-9

Fault = tuple[str, str]
"""Where, as in `pairs.p1.camera`, and what is wrong, in words that follow it."""

NOT_A_NUMBER = "holds what is not a number"


def find_faults(calibration: RigCalibration) -> Iterator[Fault]:
    """Everything in a calibration that no calibration can have."""
    yield from _find_name_faults(calibration)
    known = {pair.name: pair for pair in calibration.rig.pairs}
    for name, pair in calibration.pairs.items():
        where = f"pairs.{name}"
        if name not in known:
            yield where, f"is not a pair of rig {calibration.rig.name}"
            continue
        yield from find_camera_faults(pair.camera, known[name], f"{where}.camera")
        size = len(pair.camera.parameters)
        yield from find_covariance_faults(pair.camera_covariance, size, f"{name}/camera_covariance")
        yield from find_pose_faults(calibration.rig_from_camera[name], f"{where}.rig_from_camera")
        yield from _find_light_faults(pair, known[name])
    size = 6 * len(calibration.covariance.names)
    yield from find_covariance_faults(calibration.covariance.matrix, size, "placing_covariance")
    for (shot, board), pose in calibration.rig_from_board.items():
        yield from find_pose_faults(pose, f"boards: {board} in {shot}")
    for name, corners in calibration.observed.items():
        yield from _find_corner_faults(corners, len(calibration.rig_from_board), f"{name}/seen")


def find_camera_faults(camera: Camera, pair: Pair, where: str) -> Iterator[Fault]:
    """Faults of a camera, given the pair that the rig file describes."""
    size, described = (camera.width, camera.height), (pair.camera.width, pair.camera.height)
    if size != described:
        yield (
            where,
            f"is of {size[0]} x {size[1]} pixels, but its rig says {described[0]} x {described[1]}",
        )
        return
    for name, focal, length in zip(
        ("alpha", "beta"), (camera.alpha, camera.beta), size, strict=True
    ):
        # Fields of view of 150 and 1 degrees.
        if not length / 7.5 < focal < length / 0.0175:
            yield f"{where}.{name}", f"is not a focal length for {length} pixels (got {focal:g})"
            return
    # Cameras that skip every other line have a ratio of 2.
    if not 0.5 < camera.alpha / camera.beta < 2.0:
        yield where, f"has focal lengths too unlike (got {camera.alpha:g}, {camera.beta:g})"
    # Axes 6 degrees off a right angle; sensors are cut far better.
    if not abs(camera.gamma) < 0.1 * camera.alpha:
        yield f"{where}.gamma", f"is more skew than a sensor has (got {camera.gamma:g})"
    for name, value, length in zip(("u0", "v0"), (camera.u0, camera.v0), size, strict=True):
        # It may lie outside an image that was cropped from a larger one.
        if not -length < value < 2.0 * length:
            yield f"{where}.{name}", f"lies far outside of the image (got {value:g})"
    if not _is_finite(camera.lens.coefficients) or camera.folds:
        values = ", ".join(f"{value:g}" for value in camera.lens.coefficients)
        yield where, f"has a lens that folds its image over (got {values})"


def find_pose_faults(pose: RigidTransform, where: str) -> Iterator[Fault]:
    """Faults of a pose: it must be a rotation with a translation of plausible size."""
    rotation = pose.rotation
    if not _is_finite(rotation, pose.translation):
        yield where, NOT_A_NUMBER
    elif np.abs(rotation @ rotation.T - np.eye(3)).max() > ORTHONORMAL:
        yield where, "is not a rotation: its rows are not of length 1 and square to each other"
    elif np.linalg.det(rotation) < 0.0:
        yield where, "is not a rotation: it mirrors"
    elif np.abs(pose.translation).max() > 1e5:
        yield where, "lies more than 100 m away"


def find_covariance_faults(matrix: Array, size: int, where: str) -> Iterator[Fault]:
    """Faults of a covariance (size, size); all zero is allowed (nothing is uncertain)."""
    if not isinstance(matrix, np.ndarray) or matrix.shape != (size, size):
        yield where, f"is of shape {np.shape(matrix)}, but {size} x {size} is wanted"
    elif matrix.dtype.kind not in "fiu" or not _is_finite(matrix):
        yield where, NOT_A_NUMBER
    elif matrix.diagonal().min(initial=0.0) < 0.0:
        yield where, "holds a negative variance"
    else:
        sigmas = np.sqrt(matrix.diagonal().astype(np.float64))
        sigmas[sigmas == 0.0] = 1.0
        correlation = matrix / np.outer(sigmas, sigmas)
        if np.abs(correlation - correlation.T).max(initial=0.0) > SYMMETRIC:
            yield where, "is not symmetric"
        elif size and np.linalg.eigvalsh(correlation).min() < POSITIVE * size:
            yield where, "is not a covariance: it is not positive semidefinite"


def _find_name_faults(calibration: RigCalibration) -> Iterator[Fault]:
    rig, pairs = calibration.rig, set(calibration.pairs)
    order = calibration.covariance.names
    if not pairs:
        yield "pairs", "is empty"
    for name in sorted(pairs & set(calibration.failed)):
        yield f"failed.{name}", "is among the calibrated pairs as well"
    if len(set(order)) < len(order) or not pairs <= set(order) <= {p.name for p in rig.pairs}:
        yield "placing_covariance_order", f"does not name the pairs (got {', '.join(order)})"
    boards = {board.name for board in rig.boards}
    for shot, board in calibration.rig_from_board:
        if board not in boards:
            yield "boards", f"names no board of rig {rig.name} (got {board!r} in {shot!r})"


def _find_light_faults(pair: PairCalibration, described: Pair) -> Iterator[Fault]:
    code = described.projector
    if (pair.sheets is None) != (code is None):
        yield (
            f"pairs.{pair.name}.light",
            "and the rig's projector do not agree on whether there is one",
        )
        return
    crossing = code.crossing if code else None
    for what, light, expected in (
        ("light", pair.sheets, code),
        ("crossing", pair.crossing, crossing),
    ):
        where = f"pairs.{pair.name}.{what}"
        if light is None:
            continue
        if expected is None:
            yield where, "is of stripes that the rig's projector does not show"
        elif (light.direction, light.stripes) != (expected.direction, expected.stripes):
            yield (
                where,
                f"is of {light.stripes} {light.direction} stripes, but the rig's projector shows "
                f"{expected.stripes} {expected.direction}",
            )
        elif isinstance(light, LightPlanes):
            yield from _find_plane_faults(light, where)
        elif isinstance(light, SmoothSheets):
            yield from _find_smooth_faults(light, where)


def _find_plane_faults(light: LightPlanes, where: str) -> Iterator[Fault]:
    planes, covariance = light.coefficients, light.covariance
    if planes.shape != (light.stripes + 1, 4) or covariance.shape != (light.stripes + 1, 4, 4):
        yield where, f"has arrays of shapes {planes.shape} and {covariance.shape}"
        return
    measured = ~np.isnan(planes).all(axis=1)
    known, variances = planes[measured], covariance[measured]
    largest = np.abs(variances).max(axis=(1, 2))
    if not known.size:
        yield where, "has no plane at all"
    elif not _is_finite(known, variances):
        yield where, NOT_A_NUMBER
    elif np.abs(np.linalg.norm(known[:, :3], axis=1) - 1.0).max() > ORTHONORMAL:
        yield where, "has planes whose normals are not of length 1"
    elif np.abs(variances - variances.transpose(0, 2, 1)).max() > SYMMETRIC * largest.max():
        yield where, "has a covariance that is not symmetric"
    elif np.any(np.linalg.eigvalsh(variances)[:, 0] < POSITIVE * largest):
        yield where, "has a covariance that is not positive semidefinite"


def _find_smooth_faults(light: SmoothSheets, where: str) -> Iterator[Fault]:
    parameters, size = light.parameters, len(light.parameters)
    if isinstance(light, LensSheets):
        if not SCALE <= size <= SCALE + len(LENS_SIGMAS):
            yield where, f"has {size} parameters"
            return
        size += FRAME
    if parameters.ndim != 1 or light.middle.shape != (3,):
        yield where, f"has arrays of shapes {parameters.shape} and {light.middle.shape}"
    elif not _is_finite(parameters, light.middle):
        yield where, NOT_A_NUMBER
    else:
        yield from find_pose_faults(light.projector_from_camera, f"{where}: projector_from_camera")
        yield from find_covariance_faults(light.covariance, size, f"{where}: covariance")


def _find_corner_faults(corners: ObservedCorners, boards: int, where: str) -> Iterator[Fault]:
    target = corners.target
    shapes = (corners.pixels.shape, corners.residuals_px.shape, target.shape)
    if shapes != ((len(target), 2), (len(target), 2), (len(target),)):
        yield where, f"has arrays of shapes {', '.join(map(str, shapes))}"
    elif not _is_finite(corners.pixels, corners.residuals_px):
        yield where, NOT_A_NUMBER
    elif target.dtype.kind not in "iu" or np.any((target < 0) | (target >= boards)):
        yield where, "names boards that there are not"


def _is_finite(*arrays: Array | Floats) -> bool:
    return all(np.all(np.isfinite(array)) for array in arrays)
