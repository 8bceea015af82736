"""A projector with a centre and a lens: the chapter's pinhole rival, extended by distortion.

In the projector's frame x = X/Z along the stripes, y = Y/Z across them, r^2 = x^2 + y^2 and

    s = c + f (y (1 + k1 r^2 + k2 r^4 + k3 r^6) / (1 + k4 r^2 + k5 r^4 + k6 r^6)
               + p1 (r^2 + 2 y^2) + 2 p2 x y),

which is OpenCV's lens (Brown 1966, or rational) for the one coordinate that stripes carry. Our fits
use k1, k2, p1, p2; the others occur in projectors calibrated elsewhere. Without k and p this is the
2 x 4 matrix of Bolles 1981, which leaves the centre's place along the stripes unknown.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from bodyscan.arrays import Array
from bodyscan.geometry.lens_points import measure_rays, stripes_of_points
from bodyscan.geometry.light_planes import Axis
from bodyscan.geometry.smooth_sheets import Offset, SmoothSheets
from bodyscan.geometry.transforms import RigidTransform, cross_matrix

FRAME, SCALE = 6, 2
CENTRE = FRAME + 1
"""Index of c among the freedoms."""
LENS_SPREAD = (0.3, 0.3, 0.03, 0.03, 0.3, 0.3, 0.3, 0.3)
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

    @staticmethod
    def from_matrix(matrix: Array, middle: Array, stripes: int, direction: Axis) -> LensSheets:
        """A projector without a lens: s = (row 0 . X) / (row 1 . X), matrix (2, 4), X homogeneous,
        camera frame. The matrix leaves the centre's place along the stripes open: it is put
        opposite `middle`."""
        frame, scale = _frame_and_scale(matrix[0], matrix[1], 0.0)
        opposite = frame.translation - [frame.apply(middle)[0], 0.0, 0.0]
        frame, size = RigidTransform(frame.rotation, opposite), FRAME + SCALE
        unknown = np.full((size, size), np.nan)
        return LensSheets(frame, middle, stripes, direction, scale, unknown)

    @property
    def kind(self) -> str:
        return "lens"

    @property
    def only_centre_uncertain(self) -> bool:
        """Whether only c is uncertain, which moves all sheets together: true of a projector
        calibrated elsewhere and not fitted to boards, so that no place far from boards would be a
        guess."""
        others = np.delete(np.delete(self.covariance, CENTRE, 0), CENTRE, 1)
        return not others.any()

    def with_lens(self, terms: int) -> LensSheets:
        """The same projector with that many of k1, k2, p1, p2, ...; new ones start at 0."""
        parameters = np.zeros(SCALE + terms)
        kept = min(len(parameters), len(self.parameters))
        parameters[:kept] = self.parameters[:kept]
        size = FRAME + len(parameters)
        return replace(self, parameters=parameters, covariance=np.full((size, size), np.nan))

    def rotate_to(self, centre: float) -> LensSheets:
        """Rotate about the line along its stripes so that its axis passes through s = centre."""
        focal, now = self.parameters[:SCALE]
        turn = np.array([np.arctan((centre - now) / focal), 0.0, 0.0])
        frame = RigidTransform.from_rotation_vector(turn, np.zeros(3)) @ self.projector_from_camera
        parameters = np.append([focal, centre], self.parameters[SCALE:])
        return replace(self, projector_from_camera=frame, parameters=parameters)

    def prior(self) -> tuple[Array, Array]:
        lens = self.parameters[SCALE:]
        x, y, z = self.projector_from_camera.apply(self.middle)
        spread = np.array(LENS_SPREAD[: len(lens)])
        jacobian = np.zeros((1 + len(lens), FRAME + len(self.parameters)))
        jacobian[0, [1, 2, 3]] = np.array([z, -y, 1.0]) / (ASIDE * z)
        jacobian[1:, FRAME + SCALE :] = np.diag(1.0 / spread)
        return np.append(x / (ASIDE * z), lens / spread), jacobian

    def retract(self, step: Array) -> LensSheets:
        """Apply a step in the 2 x 4 matrix of the projector without its lens: there the valley in
        which frame, f and c compensate for one another is straight."""
        rows = self.projector_from_camera.matrix[:3]
        turn = cross_matrix(step[:3]) @ rows
        turn[:, 3] += step[3:FRAME]
        (focal, centre), (more_focal, more_centre) = self.parameters[:SCALE], step[FRAME:][:SCALE]
        above = (focal + more_focal) * rows[1] + (centre + more_centre) * rows[2]
        above += focal * turn[1] + centre * turn[2]
        frame, scale = _frame_and_scale(above, rows[2] + turn[2], rows[0, 3] + turn[0, 3])
        lens = self.parameters[SCALE:] + step[FRAME + SCALE :]
        return replace(self, projector_from_camera=frame, parameters=np.append(scale, lens))

    def at(self, s: Array) -> Array:
        return s

    def stripe(self, points: Array) -> Array:
        """s (...) of points (..., 3), camera frame."""
        return self.offset(points, np.zeros(points.shape[:-1])).value

    def offset(self, points: Array, sheet: Array, *, parameters: bool = False) -> Offset:
        shape, size = points.shape[:-1], len(self.covariance) if parameters else 0
        flat = np.ascontiguousarray(points.reshape(-1, 3))
        stripe, reach = np.empty(len(flat)), np.empty(len(flat))
        by_point, by_freedom = np.empty((len(flat), 3)), np.empty((len(flat), size))
        stripes_of_points(*self._frame_and_lens(), flat, stripe, by_point, reach, by_freedom)
        return Offset(
            stripe.reshape(shape) - sheet,
            by_point.reshape(*shape, 3),
            np.full(shape, -1.0),
            reach.reshape(shape),
            by_freedom.reshape(*shape, size) if parameters else None,
        )

    def measure(self, rays: Array, s: Array) -> tuple[Array, Array, Array]:
        """`depth`, `depth_per_stripe` and `variance_mm2` (N,) of rays (N, 3) at s (N,) in one
        pass."""
        found = np.empty((3, len(s)))
        flat, covariance = np.ascontiguousarray(rays), np.ascontiguousarray(self.covariance)
        frame, lens = self._frame_and_lens()
        measure_rays(frame, lens, covariance, self.distance_mm, self.stripes, flat, s, found)
        return found[0], found[1], found[2]

    def _frame_and_lens(self) -> tuple[Array, Array]:
        """projector_from_camera (3, 4), and f, c, k1, ..., k6 (10,) with 0 for missing
        coefficients."""
        lens = np.zeros(SCALE + len(LENS_SPREAD))
        lens[: len(self.parameters)] = self.parameters
        return np.ascontiguousarray(self.projector_from_camera.matrix[:3]), lens


def _frame_and_scale(above: Array, below: Array, x: float) -> tuple[RigidTransform, Array]:
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
