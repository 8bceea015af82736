"""Light sheets that change smoothly with s: what bowed sheets and a projector's lens share.

A model says how far a point lies off the sheet at s, as a smooth function of both, with its
derivatives: what a fit needs. Depths along rays are found by compiled functions of each model.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np

from bodyscan.arrays import Array
from bodyscan.geometry.light_planes import Axis, RayDepths, towards_camera
from bodyscan.geometry.transforms import RigidTransform

Sheets = TypeVar("Sheets", bound="SmoothSheets")


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

    def measure(self, rays: Array, s: Array) -> RayDepths:
        """Intersect rays (..., 3) with z = 1, camera frame, with the sheets at s (...)."""
        shape = rays.shape[:-1]
        found = np.empty((3, int(np.prod(shape))))
        flat = np.ascontiguousarray(rays.reshape(-1, 3)), np.broadcast_to(s, shape).ravel()
        self._measure(*flat, found)
        return RayDepths(*found.reshape(3, *shape))

    @abstractmethod
    def _measure(self, rays: Array, s: Array, found: Array) -> None:
        """Fill `found` (3, N) with depth, dz/ds and variance of rays (N, 3) at s (N,)."""

    def tangent_planes(self, s: Array) -> Array:
        """Planes (..., 4) of Eq. 6 that touch the sheets at s (...) in the middle of the
        projector's image, at the boards' distance; (a, b, c) a unit vector, d >= 0."""
        camera_from_projector = self.projector_from_camera.inverse()
        s = np.asarray(s, float)
        position = np.zeros((*s.shape, 3))
        position[..., 2] = self.distance_mm
        across = camera_from_projector.rotation[:, 1]
        sheet = self.at(s)
        for _ in range(5):
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
