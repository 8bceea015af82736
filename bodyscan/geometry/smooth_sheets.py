"""Light sheets that change smoothly with s: what bowed sheets and a projector's lens share.

A model says how far a point lies off the sheet at s, as a smooth function of both. Everything else
follows from that function's derivatives: the depth along a ray (by Newton's method), its change
with s, its variance, and the fit itself.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np

from bodyscan.arrays import Array
from bodyscan.geometry.light_planes import Axis, towards_camera
from bodyscan.geometry.transforms import RigidTransform

Sheets = TypeVar("Sheets", bound="SmoothSheets")

NEWTON_STEPS = 5
CHUNK = 1 << 17


@dataclass(frozen=True, eq=False)
class Offset:
    """How far points (..., 3) lie off their sheets, in the model's own unit.

    value: (...).
    by_point: (..., 3), derivatives by the point, camera frame.
    by_stripe: (...), derivatives by s.
    reach: (...), the points' distance from the projector along its axis, mm.
    by_parameter: (..., P), only when requested.
    """

    value: Array
    by_point: Array
    by_stripe: Array
    reach: Array
    by_parameter: Array | None = None


@dataclass(frozen=True, eq=False)
class SmoothSheets(ABC):
    """Light sheets that are smooth in s.

    projector_from_camera: a frame roughly at the projector, z the direction it shines, x along the
        stripes, y across them.
    middle: (3,) mm, camera frame, the middle of the boards; the search for a depth starts there.
    parameters: (Q,), see the model.
    covariance: (P, P) of the freedoms that `retract` takes.
    """

    projector_from_camera: RigidTransform
    middle: Array
    stripes: int
    direction: Axis
    parameters: Array
    covariance: Array

    @property
    @abstractmethod
    def kind(self) -> str:
        """Name of the model in files."""

    @abstractmethod
    def prior(self) -> tuple[Array, Array]:
        """Prior knowledge: residuals (R,) in standard deviations, and their Jacobian (R, P)."""

    @abstractmethod
    def retract(self: Sheets, step: Array) -> Sheets:
        """The sheets after a step (P,)."""

    @property
    def distance_mm(self) -> float:
        """Distance of the boards along the projector's z axis."""
        return float(self.projector_from_camera.apply(self.middle)[2])

    @abstractmethod
    def at(self, s: Array) -> Any:
        """Everything about the sheets at s (...) that `offset` needs."""

    @abstractmethod
    def offset(self, points: Array, sheet: Any, *, parameters: bool = False) -> Offset:
        """How far points (..., 3), camera frame, lie off the sheets `at(s)`."""

    def depth(self, rays: Array, s: Array) -> Array:
        """z (...) mm where rays (..., 3) with z = 1 meet the sheets at s (...); else NaN.

        Newton's method on the offset times the reach, which for planes is linear along a ray.
        """
        flat_rays, flat_s = rays.reshape(-1, 3), np.broadcast_to(s, rays.shape[:-1]).ravel()
        depth = np.empty(len(flat_s))
        for start in range(0, len(flat_s), CHUNK):
            part = slice(start, start + CHUNK)
            depth[part] = self._depth(flat_rays[part], flat_s[part])
        return depth.reshape(rays.shape[:-1])

    def depth_per_stripe(self, rays: Array, s: Array, depth: Array | None = None) -> Array:
        """dz/ds (...), mm per stripe."""
        depth = self.depth(rays, s) if depth is None else depth
        offset = self.offset(rays * depth[..., None], self.at(s))
        return -offset.by_stripe / np.sum(offset.by_point * rays, axis=-1)

    def variance_mm2(self, rays: Array, s: Array, depth: Array | None = None) -> Array:
        """Variance of z (...), mm^2, from the covariance of the fit."""
        depth = self.depth(rays, s) if depth is None else depth
        shape, rays = depth.shape, rays.reshape(-1, 3)
        points, s = rays * depth.reshape(-1, 1), np.broadcast_to(s, shape).ravel()
        variance = np.empty(len(points))
        for start in range(0, len(points), CHUNK):
            part = slice(start, start + CHUNK)
            offset = self.offset(points[part], self.at(s[part]), parameters=True)
            jacobian = offset.by_parameter
            assert jacobian is not None
            sheet_variance = np.sum((jacobian @ self.covariance) * jacobian, axis=-1)
            variance[part] = sheet_variance / np.sum(offset.by_point * rays[part], axis=-1) ** 2
        return variance.reshape(shape)

    def tangent_planes(self, s: Array) -> Array:
        """Planes (..., 4) of Eq. 6 that touch the sheets at s (...) in the middle of the
        projector's image, at the boards' distance; (a, b, c) a unit vector, d >= 0."""
        camera_from_projector = self.projector_from_camera.inverse()
        s = np.asarray(s, float)
        position = np.zeros((*s.shape, 3))
        position[..., 2] = self.distance_mm
        across = camera_from_projector.rotation[:, 1]
        sheet = self.at(s)
        for _ in range(NEWTON_STEPS):
            offset = self.offset(camera_from_projector.apply(position), sheet)
            position[..., 1] -= offset.value / (offset.by_point @ across)
        points = camera_from_projector.apply(position)
        normals = self.offset(points, sheet).by_point
        normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
        planes = np.concatenate([normals, -np.sum(normals * points, -1, keepdims=True)], axis=-1)
        return towards_camera(planes)

    def with_covariance(self: Sheets, covariance: Array) -> Sheets:
        """The same sheets with another covariance (P, P)."""
        return replace(self, covariance=covariance)

    def _depth(self, rays: Array, s: Array) -> Array:
        forward = rays @ self.projector_from_camera.rotation[2]
        depth = (self.distance_mm - self.projector_from_camera.translation[2]) / forward
        sheet = self.at(s)
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            for _ in range(NEWTON_STEPS):
                offset = self.offset(rays * depth[:, None], sheet)
                slope = np.sum(offset.by_point * rays, axis=-1) * offset.reach
                step = offset.value * offset.reach / (slope + offset.value * forward)
                depth = depth - step
                if not np.any(np.abs(step) > 1e-11 * np.abs(depth)):
                    break
            good = (np.abs(step) < 1e-6 * depth) & (offset.reach > 0.0)
            return np.where(good & (s >= 0.0) & (s <= self.stripes), depth, np.nan)
