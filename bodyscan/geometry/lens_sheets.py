"""A projector with a centre and a lens: the chapter's pinhole rival, extended by distortion.

In the projector's frame x = X/Z along the stripes, y = Y/Z across them, r^2 = x^2 + y^2 and

    s = c + f (y (1 + k1 r^2 + k2 r^4 + k3 r^6) / (1 + k4 r^2 + k5 r^4 + k6 r^6)
               + p1 (r^2 + 2 y^2) + 2 p2 x y),

which is OpenCV's lens (Brown 1966, or rational) for the one coordinate that stripes carry. Fits to
boards use k1, k2, p1, p2; the others occur in projectors calibrated elsewhere. Without k and p this
is the 2 x 4 matrix of Bolles 1981, which leaves the centre's position along the stripes unknown.

Compiled functions take frame, projector_from_camera (3, 4), and lens: f, c, k1, k2, p1, p2, k3 to k6.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from bodyscan.arrays import Array
from bodyscan.compiled import compiled
from bodyscan.geometry.light_planes import Axis, Offset, SmoothSheets
from bodyscan.geometry.transforms import RigidTransform, make_cross_matrix

FRAME, SCALE = 6, 2
CENTRE = FRAME + 1
"""Index of c among the freedoms."""
LENS_SIGMAS = (0.3, 0.3, 0.03, 0.03, 0.3, 0.3, 0.3, 0.3)
"""Standard deviations of k1, k2, p1, p2, k3, k4, k5, k6 before any data."""
ASIDE = 0.3
"""Standard deviation of the boards' middle along the stripes, as a share of its distance."""


@dataclass(frozen=True, eq=False)
class LensSheets(SmoothSheets):
    """A projector's light sheets.

    parameters: f, c (stripes), then as many of k1, k2, p1, p2, k3, k4, k5, k6 as the lens has.

    The freedoms of a fit are a small motion of the projector's frame (rotation vector, translation
    in mm, applied on its left), then the parameters.
    """

    kind: ClassVar[str] = "lens"

    @staticmethod
    def from_matrix(matrix: Array, middle: Array, stripes: int, direction: Axis) -> LensSheets:
        """A projector without a lens: s = (row 0 . X) / (row 1 . X), matrix (2, 4), X homogeneous,
        camera frame. It leaves the centre's place along the stripes open: opposite `middle`."""
        frame, scale = _compute_frame_and_scale(matrix[0], matrix[1], 0.0)
        opposite = frame.translation - [frame.apply(middle)[0], 0.0, 0.0]
        frame, size = RigidTransform(frame.rotation, opposite), FRAME + SCALE
        unknown = np.full((size, size), np.nan)
        return LensSheets(frame, middle, stripes, direction, scale, unknown)

    @property
    def only_centre_uncertain(self) -> bool:
        """Whether only c is uncertain, which moves all sheets together: true of a projector
        calibrated elsewhere and not fitted to boards, for which no place is far from boards."""
        others = np.delete(np.delete(self.covariance, CENTRE, 0), CENTRE, 1)
        return not others.any()

    def with_lens(self, terms: int) -> LensSheets:
        """The same projector with that many of k1, k2, p1, p2, ...; new ones start at 0."""
        parameters = np.append(self.parameters, np.zeros(len(LENS_SIGMAS)))[: SCALE + terms]
        covariance = np.full((FRAME + SCALE + terms,) * 2, np.nan)
        return replace(self, parameters=parameters, covariance=covariance)

    def rotate_to(self, centre: float) -> LensSheets:
        """Rotate about the line along its stripes so that its axis passes through s = centre."""
        focal, now = self.parameters[:SCALE]
        turn = np.array([np.arctan((centre - now) / focal), 0.0, 0.0])
        frame = RigidTransform.from_rotation_vector(turn, np.zeros(3)) @ self.projector_from_camera
        parameters = np.append([focal, centre], self.parameters[SCALE:])
        return replace(self, projector_from_camera=frame, parameters=parameters)

    def linearize_prior(self) -> tuple[Array, Array]:
        lens = self.parameters[SCALE:]
        x, y, z = self.projector_from_camera.apply(self.middle)
        sigmas = np.array(LENS_SIGMAS[: len(lens)])
        jacobian = np.zeros((1 + len(lens), FRAME + len(self.parameters)))
        jacobian[0, [1, 2, 3]] = np.array([z, -y, 1.0]) / (ASIDE * z)
        jacobian[1:, FRAME + SCALE :] = np.diag(1.0 / sigmas)
        return np.append(x / (ASIDE * z), lens / sigmas), jacobian

    def retract(self, step: Array) -> LensSheets:
        """Apply a step in the 2 x 4 matrix of the projector without its lens: there the valley in
        which frame, f and c compensate for one another is straight."""
        rows = self.projector_from_camera.matrix[:3]
        turn = make_cross_matrix(step[:3]) @ rows
        turn[:, 3] += step[3:FRAME]
        (focal, centre), (more_focal, more_centre) = self.parameters[:SCALE], step[FRAME:][:SCALE]
        above = (focal + more_focal) * rows[1] + (centre + more_centre) * rows[2]
        above += focal * turn[1] + centre * turn[2]
        frame, scale = _compute_frame_and_scale(above, rows[2] + turn[2], rows[0, 3] + turn[0, 3])
        lens = self.parameters[SCALE:] + step[FRAME + SCALE :]
        return replace(self, projector_from_camera=frame, parameters=np.append(scale, lens))

    def evaluate(self, s: Array) -> Array:
        return s

    def stripe(self, points: Array) -> Array:
        """s (...) of points (..., 3), camera frame."""
        return self.offset(points, np.zeros(points.shape[:-1])).value

    def offset(self, points: Array, sheet: Array, *, parameters: bool = False) -> Offset:
        found = np.empty((*points.shape[:-1], 5 + len(self.covariance) * parameters))
        flat = np.ascontiguousarray(points.reshape(-1, 3), np.float64)
        _measure_points(*self._compiled_parameters, flat, found.reshape(-1, found.shape[-1]))
        by_parameter = found[..., 5:] if parameters else None
        return Offset(found[..., 0] - sheet, found[..., 1:4], found[..., 4], by_parameter)

    @property
    def _compiled_parameters(self) -> tuple[Array, Array]:
        """The frame and the lens of compiled functions."""
        lens = np.append(self.parameters, np.zeros(len(LENS_SIGMAS)))  # terms it lacks are 0
        return np.ascontiguousarray(self.projector_from_camera.matrix[:3]), lens

    def _intersect(self, rays: Array, s: Array, found: Array) -> None:
        covariance = self.covariance[np.triu_indices(len(self.covariance))]
        camera = *self._compiled_parameters, covariance, self.distance_mm, self.stripes
        measure_rays(*camera, rays, s, found)


def _compute_frame_and_scale(above: Array, below: Array, x: float) -> tuple[RigidTransform, Array]:
    """projector_from_camera and (f, c) of s = (above . X) / (below . X); x: of its translation."""
    above, below = above / np.linalg.norm(below[:3]), below / np.linalg.norm(below[:3])
    axis, centre = below[:3], float(above[:3] @ below[:3])
    down = above[:3] - centre * axis
    focal = float(np.linalg.norm(down))
    down = down / focal
    (a, b, c), (p, q, r) = down, axis
    along = [b * r - c * q, c * p - a * r, a * q - b * p]  # np.cross is slow on single vectors
    rotation = np.array([along, down, axis])
    translation = np.array([x, (above[3] - centre * below[3]) / focal, below[3]])
    return RigidTransform(rotation, translation), np.array([focal, centre])


Vector = tuple[float, float, float]

EXACT, CONVERGED = 1e-7, 1e-6  # relative: the next step would be about the square of the last


@compiled
def measure_rays(
    frame: Array,
    lens: Array,
    covariance: Array,
    distance: float,
    stripes: int,
    rays: Array,
    s: Array,
    found: Array,
) -> None:
    """Fill `found` (3, N) with depth z, dz/ds and the variance of z for rays (N, 3) at s (N,).

    NaN where a ray meets no sheet.
    covariance: of the P freedoms of a fit, its upper triangle row by row.
    distance: of the boards, mm.
    """
    jacobian = np.empty(int(np.sqrt(2 * len(covariance))))
    last, variance = (np.inf, np.inf, np.inf), np.nan
    for n in range(len(s)):
        found[0, n] = found[1, n] = found[2, n] = np.nan
        x, y = rays[n, 0], rays[n, 1]
        depth = _depth(frame, lens, distance, x, y, s[n])
        if not (depth > 0.0 and 0.0 <= s[n] <= stripes):
            continue
        point = _to_projector(frame, x * depth, y * depth, depth)
        image = _distort(lens, point[0], point[1])
        per_stripe = point[2] / _slope_times_reach(frame, point, image, x, y)
        # The variance of s is smooth over the projector's image: points within 0.2 degrees and 0.3 %
        # of their distance share it, to 2 % of sigma.
        aside = max(abs(point[0] - last[0]), abs(point[1] - last[1]))
        if not max(aside, abs(point[2] / last[2] - 1.0)) < 3e-3:
            _by_freedom(lens, point, image, jacobian)
            last, variance = point, variance_along(covariance, jacobian)
        found[0, n], found[1, n], found[2, n] = depth, per_stripe, variance * per_stripe**2


@compiled
def _measure_points(frame: Array, lens: Array, points: Array, found: Array) -> None:
    """Fill `found` (N, 5 or 5 + P) with s, its derivatives by the point, and the reach, of points
    (N, 3), and the derivatives by the freedoms."""
    for n in range(len(points)):
        point = _to_projector(frame, points[n, 0], points[n, 1], points[n, 2])
        image = _distort(lens, point[0], point[1])
        (x, y, reach), (slide, by_x, by_y), row = point, image, found[n]
        row[0], row[4], by_z = lens[0] * slide + lens[1], reach, -(by_x * x + by_y * y)
        for k in range(3):
            row[1 + k] = (by_x * frame[0, k] + by_y * frame[1, k] + by_z * frame[2, k]) / reach
        if len(row) > 5:
            _by_freedom(lens, point, image, row[5:])


@compiled
def variance_along(upper: Array, by: Array) -> float:
    """by^T C by, given the upper triangle of C row by row."""
    total, first, size = 0.0, 0, len(by)
    for i in range(size):
        row = 0.5 * upper[first] * by[i]
        for j in range(i + 1, size):
            row += upper[first + j - i] * by[j]
        total += 2.0 * row * by[i]
        first += size - i
    return total


@compiled
def _depth(frame: Array, lens: Array, distance: float, x: float, y: float, s: float) -> float:
    """Depth z where the ray (x, y, 1) meets the sheet at s; NaN where there is none.

    Newton's method on the offset times the reach, linear along a ray without a lens, from where that
    ray would meet the sheet, or `distance` (mm) if nowhere. NaN also beyond the fold of the lens.
    """
    forward = frame[2, 0] * x + frame[2, 1] * y + frame[2, 2]
    across, slope = frame[1, 0] * x + frame[1, 1] * y + frame[1, 2], (s - lens[1]) / lens[0]
    depth = (slope * frame[2, 3] - frame[1, 3]) / (across - slope * forward)
    if not 0.0 < depth < np.inf:
        depth = (distance - frame[2, 3]) / forward
    step = reach = rise = np.nan
    for _ in range(5):
        point = _to_projector(frame, x * depth, y * depth, depth)
        image = _distort(lens, point[0], point[1])
        reach, rise, residual = point[2], image[2], lens[0] * image[0] + lens[1] - s
        slope_reach = _slope_times_reach(frame, point, image, x, y)
        step = residual * reach / (slope_reach + residual * forward)
        depth -= step
        if not abs(step) > EXACT * abs(depth):
            break
    return depth if abs(step) < CONVERGED * depth and reach > 0.0 and rise > 0.0 else np.nan


@compiled
def _to_projector(frame: Array, x: float, y: float, z: float) -> Vector:
    """X/Z, Y/Z and Z, in the projector's frame, of a point in the camera's."""
    reach = frame[2, 0] * x + frame[2, 1] * y + frame[2, 2] * z + frame[2, 3]
    return (
        (frame[0, 0] * x + frame[0, 1] * y + frame[0, 2] * z + frame[0, 3]) / reach,
        (frame[1, 0] * x + frame[1, 1] * y + frame[1, 2] * z + frame[1, 3]) / reach,
        reach,
    )


@compiled
def _distort(lens: Array, x: float, y: float) -> Vector:
    """(s - c) / f at x = X/Z, y = Y/Z, and the derivatives of s by x and by y."""
    focal, p1, p2 = lens[0], lens[4], lens[5]
    r2 = x * x + y * y
    radial, slope, _ = _radial(lens, r2)
    by_x = focal * (2.0 * x * (y * slope + p1) + 2.0 * p2 * y)
    by_y = focal * (radial + 2.0 * y * y * slope + 6.0 * p1 * y + 2.0 * p2 * x)
    return y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y, by_x, by_y


@compiled
def _radial(lens: Array, r2: float) -> Vector:
    """The lens's radial factor at r2, its derivative by r2, and 1 / (1 + k4 r2 + ...)."""
    k1, k2, k3 = lens[2], lens[3], lens[6]
    above, rise = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3)), k1 + r2 * (2.0 * k2 + 3.0 * r2 * k3)
    k4, k5, k6 = lens[7], lens[8], lens[9]
    if k4 == 0.0 and k5 == 0.0 and k6 == 0.0:  # true of nearly all: no division
        return above, rise, 1.0
    share = 1.0 / (1.0 + r2 * (k4 + r2 * (k5 + r2 * k6)))
    radial = above * share
    return radial, (rise - radial * (k4 + r2 * (2.0 * k5 + 3.0 * r2 * k6))) * share, share


@compiled
def _slope_times_reach(frame: Array, point: Vector, image: Vector, x: float, y: float) -> float:
    """ds/dz along the ray (x, y, 1), times the reach."""
    forward = frame[2, 0] * x + frame[2, 1] * y + frame[2, 2]
    along = frame[0, 0] * x + frame[0, 1] * y + frame[0, 2] - point[0] * forward
    across = frame[1, 0] * x + frame[1, 1] * y + frame[1, 2] - point[1] * forward
    return image[1] * along + image[2] * across


@compiled
def _by_freedom(lens: Array, point: Vector, image: Vector, jacobian: Array) -> None:
    """Fill ds (P,) by a small motion of the frame, f, c, and as many of k1, k2, p1, ... as fit."""
    (x, y, reach), (slide, by_x, by_y) = point, image
    by_z, r2 = -(by_x * x + by_y * y), x * x + y * y
    jacobian[0], jacobian[1] = y * by_z - by_y, by_x - x * by_z
    jacobian[2], jacobian[3] = x * by_y - y * by_x, by_x / reach
    jacobian[4], jacobian[5] = by_y / reach, by_z / reach
    jacobian[6], jacobian[7] = slide, 1.0
    radial, _, share = _radial(lens, r2)
    r4, above, below = r2 * r2, y * share, -y * radial * share
    terms = (above * r2, above * r4, r2 + 2.0 * y * y, 2.0 * x * y, above * r2 * r4)
    for k in range(min(len(jacobian) - 8, 5)):
        jacobian[8 + k] = lens[0] * terms[k]
    for k in range(13, len(jacobian)):
        jacobian[k] = lens[0] * below * r2 ** (k - 12)
