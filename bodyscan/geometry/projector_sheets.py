"""A projector that is described as a camera (as OpenCV's users calibrate it) as sheets of light.

A camera's pixel (u, v) has its centre at whole numbers, a stripe begins at them: the projector's
column u is s = (u + 1/2) / w, w its pixels a stripe, and its row v likewise.
"""

from __future__ import annotations

import numpy as np

from bodyscan.arrays import Array
from bodyscan.geometry.camera import Camera
from bodyscan.geometry.lens_sheets import CENTRE, FRAME, SCALE, LensSheets
from bodyscan.geometry.lenses import lens_from_opencv
from bodyscan.geometry.light_planes import Axis
from bodyscan.geometry.transforms import RigidTransform

DISTANCE = 5.0
"""In baselines, where a camera and a projector whose axes do not meet are taken to look."""


def sheets_of_projector(
    projector: Camera,
    projector_from_camera: RigidTransform,
    middle: Array,
    stripes: int,
    direction: Axis,
    sigma_px: float = 0.0,
) -> LensSheets:
    """The sheets of `stripes` that divide the projector's picture, as a camera sees them.

    projector: its picture's size is that of all stripes together.  middle: (3,) mm, camera frame,
    about what is looked at.  sigma_px: by how many of its pixels all sheets may be off together.
    Raises BadInput for a lens that OpenCV does not have.

    The stripes' coordinate needs one row of the matrix A, (fx, skew) or (0, fy): turned about its
    axis, so that this row is its y, a projector with OpenCV's lens is one with such a lens again.
    Its tangential part is r^2 q + 2 (q . x) x with q = (p2, p1), and q turns as x does.
    """
    row, centre, size = _across(projector, direction)
    focal = float(np.linalg.norm(row))
    across = row / focal
    along = np.array([across[1], -across[0]])
    turn = np.eye(3)
    turn[0, :2], turn[1, :2] = along, across
    width = size / stripes
    lens = np.zeros(8)
    coefficients = projector.lens.opencv()[: len(lens)]
    lens[: len(coefficients)] = coefficients
    tangential = lens[[3, 2]]
    lens[2], lens[3] = across @ tangential, along @ tangential
    terms = 0 if not lens.any() else 4 if not lens[4:].any() else 5 if not lens[5:].any() else 8
    parameters = np.array([focal / width, (centre + 0.5) / width, *lens[:terms]])
    covariance = np.zeros((FRAME + SCALE + terms,) * 2)
    covariance[CENTRE, CENTRE] = (sigma_px / width) ** 2
    frame = RigidTransform(turn, np.zeros(3)) @ projector_from_camera
    return LensSheets(frame, middle, stripes, direction, parameters, covariance)


def projector_of_sheets(sheets: LensSheets) -> tuple[Camera, RigidTransform]:
    """The way back: the projector as a camera with a pixel a stripe, and `projector_from_camera`.

    Across the stripes it is exact. Along them its picture is square, of square pixels, its axis in
    the middle: one direction of stripes says nothing of that.
    """
    focal, centre = sheets.parameters[:SCALE].tolist()
    terms = sheets.parameters[SCALE:]
    coefficients = np.zeros(max(len(terms), 5))
    coefficients[: len(terms)] = terms
    frame, size = sheets.projector_from_camera, sheets.stripes
    u0 = v0 = 0.5 * (size - 1.0)
    if sheets.direction == "vertical":
        turn = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
        frame = RigidTransform(turn, np.zeros(3)) @ frame
        coefficients[[2, 3]] = -coefficients[3], coefficients[2]
        u0 = centre - 0.5
    else:
        v0 = centre - 0.5
    return Camera(focal, focal, 0.0, u0, v0, lens_from_opencv(coefficients), size, size), frame


def looked_at(camera: Camera, projector: Camera, projector_from_camera: RigidTransform) -> Array:
    """(3,) mm, camera frame: on the ray through the middle of the camera's picture, where that of
    the projector's comes nearest to it."""
    camera_from_projector = projector_from_camera.inverse()
    ray = _middle_ray(camera)
    light = camera_from_projector.rotate(_middle_ray(projector))
    start = camera_from_projector.translation
    # depth * ray - (start + reach * light) is at right angles to both
    normal = np.array([[ray @ ray, -ray @ light], [ray @ light, -light @ light]])
    baseline = float(np.linalg.norm(start))
    depth, reach = np.full(2, np.nan)
    if abs(np.linalg.det(normal)) > 1e-6:
        depth, reach = np.linalg.solve(normal, np.array([ray @ start, light @ start]))
    meets = min(depth, reach) > 0.5 * baseline
    return np.asarray(ray * (depth if meets else DISTANCE * baseline), float)


def _across(projector: Camera, direction: Axis) -> tuple[Array, float, int]:
    """What of A makes the coordinate across the stripes, and the picture's size along it."""
    if direction == "vertical":
        return np.array([projector.alpha, projector.gamma]), projector.u0, projector.width
    return np.array([0.0, projector.beta]), projector.v0, projector.height


def _middle_ray(camera: Camera) -> Array:
    middle = 0.5 * np.array([camera.width - 1.0, camera.height - 1.0])
    ray: Array = camera.rays(middle)
    return ray / np.linalg.norm(ray)
