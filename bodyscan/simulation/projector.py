"""Projectors as they are built: a laser sheet on a rotating mirror, or a lens.

Written for the simulator alone: calibration never sees these models, only their light. All vectors
are in the frame of the pair's camera, mm. Points (..., 3) keep their float type.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bodyscan.arrays import Array

Reals = NDArray[Any]


@dataclass(frozen=True, eq=False)
class MirrorProjector:
    """A laser's fan of light, reflected by a mirror whose surface lies off its rotation axis.

    The fan's plane contains `laser` (its apex), is normal to `sheet`, and its middle ray runs along
    `aim`. The mirror's normal at angle theta is cos(theta) zero + sin(theta) (axis x zero); its
    surface lies `offset_mm` from `centre` along that normal. Stripe coordinate s is swept at mirror
    angle first_angle + s / stripes * sweep_angle. Each stripe is a plane; with an offset, or a
    sheet tilted against the axis, the planes have no line in common.
    """

    stripes: int
    axis: Array
    centre: Array
    zero: Array
    offset_mm: float
    laser: Array
    sheet: Array
    aim: Array
    first_angle: float
    sweep_angle: float
    fan: float = 1.0  # tangent of half the fan's opening
    smile_stripes: float = 0.0  # deviation of s at a fan's ends

    def angle(self, points: Reals) -> Reals:
        """Compute the mirror angle at which the sheet passes through points (..., 3), radians.

        The mirrored point P' = P - 2 (n.q - e) n, q = P - centre, lies on the laser's own sheet:
        m.(P' - laser) = 0. With n.q and n.m in cos and sin of theta this reads
        A cos 2theta + B sin 2theta = K + 2 e n.m, solved for theta with the small last term taken
        from the step before (its error shrinks by offset / distance each time).
        """
        zero, side = self._normals
        m1, m2, m3 = (float(self.sheet @ v) for v in (zero, side, self.axis))
        q1, q2, q3 = (_measure_along(points, v, self.centre) for v in (zero, side, self.axis))
        constant = q3 * m3 + float(self.sheet @ (self.centre - self.laser))
        a, b = q1 * m1 - q2 * m2, q1 * m2 + q2 * m1
        radius, phase = np.hypot(a, b), np.arctan2(b, a)
        branch = -1.0 if m2 < 0 else 1.0
        theta, turn = np.zeros_like(radius), radius.dtype.type(2.0 * np.pi)
        for _ in range(4 if points.dtype == np.float32 else 12):
            lever = 2.0 * self.offset_mm * (m1 * np.cos(theta) + m2 * np.sin(theta))
            ratio = np.clip((constant + lever) / radius, -1.0, 1.0)
            angle = phase - branch * np.arccos(ratio)
            theta = 0.5 * (angle - turn * np.round(angle / turn))
        return theta

    def stripe(self, points: Reals) -> Reals:
        """Compute s (...) of the light that reaches points; NaN where none does."""
        theta = self.angle(points)
        s = (theta - self.first_angle) * (self.stripes / self.sweep_angle)
        fan_tangent = self.fan_tangent(points, theta) / self.fan
        if self.smile_stripes:
            s = s + self.smile_stripes * fan_tangent**2
        return np.where(np.abs(fan_tangent) <= 1.0, s, np.nan).astype(points.dtype)

    def fan_tangent(self, points: Reals, theta: Reals) -> Reals:
        """Compute the tangent of the angle between a point's ray and the fan's middle ray.

        It is computed after the point is mirrored back to the laser's side: (P' - laser) against
        `aim` and the sheet's other direction. Infinite behind the projector.
        """
        cos, sin = np.cos(theta), np.sin(theta)
        zero, side = self._normals
        edge = np.cross(self.sheet, self.aim)
        height = cos * _measure_along(points, zero, self.centre) + sin * _measure_along(
            points, side, self.centre
        )
        height = height - self.offset_mm

        def mirrored(axis: Array) -> Reals:
            tilt = cos * float(zero @ axis) + sin * float(side @ axis)
            return _measure_along(points, axis, self.laser) - 2.0 * height * tilt

        forward = mirrored(self.aim)
        lit = (forward > 0) & (height > 0)
        return np.divide(mirrored(edge), forward, out=np.full_like(forward, np.inf), where=lit)

    def source(self, s: Reals) -> Reals:
        """Compute the point (..., 3) from which the light of s seems to come."""
        theta = self.first_angle + s * (self.sweep_angle / self.stripes)
        cos, sin = np.cos(theta), np.sin(theta)
        zero, side = self._normals
        arm = self.laser - self.centre
        twice = 2.0 * (cos * float(zero @ arm) + sin * float(side @ arm) - self.offset_mm)
        c, d = twice * cos, twice * sin
        parts = [float(self.laser[i]) - c * float(zero[i]) - d * float(side[i]) for i in range(3)]
        return np.stack(parts, axis=-1)

    def plane(self, s: Reals) -> Reals:
        """Compute planes (..., 4) of Eq. 6 at s, without smile: a, b, c (unit normal), d."""
        theta = self.first_angle + np.asarray(s, float) * (self.sweep_angle / self.stripes)
        zero, side = self._normals
        normal = np.cos(theta)[..., None] * zero + np.sin(theta)[..., None] * side
        mirrored = self.sheet - 2.0 * (normal @ self.sheet)[..., None] * normal
        d = -np.einsum("...i,...i->...", mirrored, self.source(np.asarray(s, float)))
        return np.concatenate([mirrored, d[..., None]], axis=-1)

    @property
    def _normals(self) -> tuple[Array, Array]:
        """The mirror's normal at angle 0, and a quarter turn further."""
        return self.zero, np.cross(self.axis, self.zero)


@dataclass(frozen=True, eq=False)
class PinholeProjector:
    """A projector with a lens: all light from one point, its stripes straight only on the slide.

    rotation: (3, 3), projector axes as rows; row 0 runs along the stripes, row 1 across them.
    first, last: stripe coordinates 0 and S, across the slide.
    half: the slide ends at +-`half` along the stripes.

    The slide's coordinates are normalised, and moved by the lens as in Eq. 3-4.
    """

    stripes: int
    rotation: Array
    centre: Array
    first: float
    last: float
    half: float = 1.0
    k1: float = 0.0
    k2: float = 0.0
    smile_stripes: float = 0.0

    def slide(self, points: Reals) -> tuple[Reals, Reals]:
        """Compute slide coordinates (along, across) of points; NaN behind the projector."""
        x, y, z = (_measure_along(points, row, self.centre) for row in self.rotation)
        front = np.where(z > 0, z, np.nan).astype(points.dtype)
        x, y = x / front, y / front
        square = x**2 + y**2
        grow = 1.0 + self.k1 * square + self.k2 * square**2
        return x * grow, y * grow

    def stripe(self, points: Reals) -> Reals:
        along, across = self.slide(points)
        s = (across - self.first) * (self.stripes / (self.last - self.first))
        s = s + self.smile_stripes * (along / self.half) ** 2
        return np.where(np.abs(along) <= self.half, s, np.nan).astype(points.dtype)

    def source(self, s: Reals) -> Reals:
        return np.broadcast_to(self.centre.astype(s.dtype), (*s.shape, 3))


Projector = MirrorProjector | PinholeProjector


def _measure_along(points: Reals, vector: Array, origin: Array) -> Reals:
    """Compute the distance of points (..., 3) from the origin along a vector."""
    x, y, z = (points[..., i] * float(vector[i]) for i in range(3))
    return x + y + z - float(vector @ origin)
