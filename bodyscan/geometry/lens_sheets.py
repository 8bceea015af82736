"""A projector with a centre and a lens: the chapter's pinhole rival, grown up.

In the projector's frame x = X/Z along the stripes, y = Y/Z across them, r^2 = x^2 + y^2 and

    s = c + f (y (1 + k1 r^2 + k2 r^4) + p1 (r^2 + 2 y^2) + 2 p2 x y),

OpenCV's lens (Brown 1966) for the one coordinate that stripes carry. Without k and p this is the
2 x 4 matrix of Bolles 1981, and where the centre lies along the stripes is then unknown.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from bodyscan.geometry.light_planes import Axis
from bodyscan.geometry.smooth_sheets import Offset, SmoothSheets
from bodyscan.geometry.transforms import RigidTransform, skew

Array = NDArray[np.float64]

FRAME, SCALE = 6, 2
LENS_SPREAD = (0.3, 0.3, 0.03, 0.03)
"""Standard deviations of k1, k2, p1, p2 before any data."""
ASIDE = 0.3
"""Standard deviation of where the boards' middle lies along the stripes, in distances."""


@dataclass(frozen=True, eq=False)
class LensSheets(SmoothSheets):
    """parameters: f, c (stripes), then as many of k1, k2, p1, p2 as the lens has.

    The freedoms of a fit: a small motion of the projector's frame (rotation vector, translation in
    mm, put before it), then the parameters.
    """

    @staticmethod
    def pinhole(matrix: Array, middle: Array, stripes: int, direction: Axis) -> LensSheets:
        """Without a lens, s = (row 0 . X) / (row 1 . X) with matrix (2, 4), X homogeneous, camera
        frame. Where the centre lies along the stripes it does not say: opposite the middle."""
        frame, scale = _frame_and_scale(matrix[0], matrix[1], 0.0)
        opposite = frame.translation - [frame.apply(middle)[0], 0.0, 0.0]
        frame, size = RigidTransform(frame.rotation, opposite), FRAME + SCALE
        unknown = np.full((size, size), np.nan)
        return LensSheets(frame, middle, stripes, direction, scale, unknown)

    @property
    def kind(self) -> str:
        return "lens"

    def with_lens(self, terms: int) -> LensSheets:
        """With that many of k1, k2, p1, p2; those that are new start at 0."""
        parameters = np.zeros(SCALE + terms)
        kept = min(len(parameters), len(self.parameters))
        parameters[:kept] = self.parameters[:kept]
        size = FRAME + len(parameters)
        return replace(self, parameters=parameters, covariance=np.full((size, size), np.nan))

    def turned(self, centre: float) -> LensSheets:
        """Turned about the line along its stripes, so that its axis passes through s = centre."""
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
        """The step is taken in the 2 x 4 matrix of the projector without its lens: there the
        valley in which frame, f and c make up for one another is straight."""
        rows = self.projector_from_camera.matrix[:3]
        turn = skew(step[:3]) @ rows
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
        seen = self.projector_from_camera.apply(points)
        x, y, reach = seen[..., 0] / seen[..., 2], seen[..., 1] / seen[..., 2], seen[..., 2]
        focal, centre = self.parameters[:SCALE]
        k1, k2, p1, p2 = np.append(self.parameters[SCALE:], np.zeros(4))[:4]
        r2 = x**2 + y**2
        radial, slope = 1.0 + r2 * (k1 + r2 * k2), k1 + 2.0 * k2 * r2
        slide = y * radial + p1 * (r2 + 2.0 * y**2) + 2.0 * p2 * x * y
        by_x = focal * (2.0 * x * (y * slope + p1) + 2.0 * p2 * y)
        by_y = focal * (radial + 2.0 * y**2 * slope + 6.0 * p1 * y + 2.0 * p2 * x)
        by_seen = np.stack([by_x, by_y, -(by_x * x + by_y * y)], axis=-1) / reach[..., None]
        jacobian = None
        if parameters:
            lens = [y * r2, y * r2**2, r2 + 2.0 * y**2, 2.0 * x * y][: len(self.parameters) - SCALE]
            columns = [slide, np.ones_like(slide), *(focal * term for term in lens)]
            jacobian = np.concatenate(
                [np.cross(seen, by_seen), by_seen, np.stack(columns, axis=-1)], axis=-1
            )
        return Offset(
            focal * slide + centre - sheet,
            by_seen @ self.projector_from_camera.rotation,
            np.full_like(slide, -1.0),
            reach,
            jacobian,
        )


def _frame_and_scale(above: Array, below: Array, x: float) -> tuple[RigidTransform, Array]:
    """projector_from_camera and (f, c) of s = (above . X) / (below . X); x: of its translation."""
    above, below = above / np.linalg.norm(below[:3]), below / np.linalg.norm(below[:3])
    axis, centre = below[:3], float(above[:3] @ below[:3])
    down = above[:3] - centre * axis
    focal = float(np.linalg.norm(down))
    down = down / focal
    rotation = np.stack([np.cross(down, axis), down, axis])
    translation = np.array([x, (above[3] - centre * below[3]) / focal, below[3]])
    return RigidTransform(rotation, translation), np.array([focal, centre])
