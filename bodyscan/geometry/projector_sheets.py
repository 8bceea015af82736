"""Light sheets of a projector that is described as a camera, as OpenCV's users calibrate it.

A camera's pixel (u, v) has its centre at whole numbers, while a stripe begins at them: the
projector's column u is s = (u + 1/2) / w with w its pixels per stripe, and likewise its row v.
"""

from __future__ import annotations

import numpy as np

from bodyscan.arrays import Array
from bodyscan.geometry.camera import Camera
from bodyscan.geometry.lens_sheets import CENTRE, FRAME, SCALE, LensSheets
from bodyscan.geometry.lenses import lens_from_opencv
from bodyscan.geometry.light_planes import Axis
from bodyscan.geometry.transforms import RigidTransform


def sheets_from_projector(
    projector: Camera,
    projector_from_camera: RigidTransform,
    middle: Array,
    stripes: int,
    direction: Axis,
    sigma_px: float = 0.0,
) -> LensSheets:
    """The sheets of `stripes` stripes that divide the projector's image, in the camera's frame.

    projector: its image size is that of all stripes together.
    middle: (3,) mm, camera frame, roughly what is looked at.
    sigma_px: by how many projector pixels all sheets may be off together.

    Raises BadInput for a lens that OpenCV does not have.

    The stripe coordinate needs one row of A, (fx, skew) or (0, fy). Rotated about its axis so that
    this row becomes y, a projector with OpenCV's lens again has such a lens: its tangential part is
    r^2 q + 2 (q . x) x with q = (p2, p1), and q rotates as x does.
    """
    row, centre, size = _across_stripes(projector, direction)
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


def projector_from_sheets(sheets: LensSheets) -> tuple[Camera, RigidTransform]:
    """The inverse: the projector as a camera with one pixel per stripe, and
    `projector_from_camera`.

    Exact across the stripes. One direction of stripes carries no information along them, so the
    image is assumed to be square, with square pixels and its axis in the middle.
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


def intersect_central_rays(
    camera: Camera, projector: Camera, projector_from_camera: RigidTransform
) -> Array:
    """The point (3,) mm, camera frame, on the ray through the middle of the camera's image that is
    nearest to the ray through the middle of the projector's."""
    camera_from_projector = projector_from_camera.inverse()
    ray = _middle_ray(camera)
    light = camera_from_projector.rotate(_middle_ray(projector))
    start = camera_from_projector.translation
    # depth * ray - (start + reach * light) is perpendicular to both
    normal = np.array([[ray @ ray, -ray @ light], [ray @ light, -light @ light]])
    baseline = float(np.linalg.norm(start))
    depth, reach = np.full(2, np.nan)
    if abs(np.linalg.det(normal)) > 1e-6:
        depth, reach = np.linalg.solve(normal, np.array([ray @ start, light @ start]))
    meets = min(depth, reach) > 0.5 * baseline
    # If the axes do not meet, the view is assumed to be five baselines away.
    return np.asarray(ray * (depth if meets else 5.0 * baseline), float)


def _across_stripes(projector: Camera, direction: Axis) -> tuple[Array, float, int]:
    """The row of A that gives the coordinate across the stripes, its centre, and the image size
    there."""
    if direction == "vertical":
        return np.array([projector.alpha, projector.gamma]), projector.u0, projector.width
    return np.array([0.0, projector.beta]), projector.v0, projector.height


def _middle_ray(camera: Camera) -> Array:
    middle = 0.5 * np.array([camera.width - 1.0, camera.height - 1.0])
    ray: Array = camera.rays(middle)
    return ray / np.linalg.norm(ray)
