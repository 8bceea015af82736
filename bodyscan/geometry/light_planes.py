"""The interface of light sheets; the chapter's model, one free plane per stripe (Eq. 6); and what
models have in common whose sheets change smoothly with s (bowed sheets and a projector's lens).

A smooth model says how far a point lies off the sheet at s, as a smooth function of both, with its
derivatives: what a fit needs. Depths along rays are found by compiled functions of each model.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, ClassVar, Literal, NamedTuple, Protocol, TypeVar

import numpy as np

from bodyscan.arrays import Array, Indices, Mask
from bodyscan.geometry.transforms import RigidTransform

Axis = Literal["horizontal", "vertical"]


class RayDepths(NamedTuple):
    """Depths along rays; NaN where a ray meets no sheet, or no depth can be trusted."""

    depth: Array  # z (...) mm
    per_stripe: Array  # dz/ds (...), mm per stripe
    variance_mm2: Array  # (...) of the depth, due to the uncertainty of the sheets alone


class LightSheets(Protocol):
    """What triangulation needs from a projector, whatever its model.

    kind: `planes`, `bowed` or `lens`: see `light_sheets.sheets_from_arrays`.
    direction: which way the stripes run in the image.
    """

    kind: ClassVar[str]

    @property
    def direction(self) -> Axis: ...

    @property
    def stripes(self) -> int: ...

    def intersect(self, rays: Array, s: Array) -> RayDepths:
        """Intersect rays (..., 3) with z = 1, camera frame, with the sheets at real s (...)."""
        ...

    def tangent_planes(self, s: Array) -> Array:
        """Planes (..., 4) of Eq. 6 that touch the sheets at s (...): unit (a, b, c), d >= 0."""
        ...


def orient_towards_camera(planes: Array) -> Array:
    """Planes (..., 4) with the sign that makes d >= 0."""
    return planes * np.where(planes[..., 3:] < 0.0, -1.0, 1.0)


@dataclass(frozen=True, eq=False)
class LightPlanes:
    """One plane per boundary, each independent of its neighbours."""

    kind: ClassVar[str] = "planes"

    # (S + 1, 4), row i is (a, b, c, d) of the plane at s = i: ax + by + cz + d = 0, camera frame,
    # mm, (a, b, c) a unit vector, d >= 0. A row of NaN: the stripe is not calibrated.
    coefficients: Array
    covariance: Array  # (S + 1, 4, 4) of the coefficients
    direction: Axis  # which way the stripes run in the image

    @staticmethod
    def from_planes(planes: Array, direction: Axis) -> LightPlanes:
        """Normalize planes (S + 1, 4) of any length and sign; their covariance is unknown."""
        unit = planes / np.linalg.norm(planes[:, :3], axis=1, keepdims=True)
        return LightPlanes(
            orient_towards_camera(unit), np.full((len(planes), 4, 4), np.nan), direction
        )

    @property
    def stripes(self) -> int:
        return len(self.coefficients) - 1

    @property
    def calibrated(self) -> Mask:
        """Which boundaries have a plane, (S + 1,)."""
        return np.isfinite(self.coefficients[:, 0])

    def tangent_planes(self, s: Array) -> Array:
        """Planes (..., 4) at real s (...), interpolated linearly; NaN beside a missing one."""
        below, share = self._locate(s)
        share = share[..., None]
        # At a whole s only its own plane is needed, not the neighbour's.
        lower = np.where(share < 1.0, self.coefficients[below], 0.0)
        upper = np.where(share > 0.0, self.coefficients[below + 1], 0.0)
        return (1.0 - share) * lower + share * upper

    def intersect(self, rays: Array, s: Array) -> RayDepths:
        """z by Eq. 13, -d / (a x/z + b y/z + c), and dz/ds from the two planes around s; at the last
        plane, from the two before it.

        Neighbouring planes come from the same boards, so their errors are treated as one.
        """
        below, share = self._locate(s)
        planes = self.tangent_planes(s)
        facing = np.sum(planes[..., :3] * rays, axis=-1)
        depth = -planes[..., 3] / np.where(facing == 0.0, np.nan, facing)
        depth = np.where(depth > 0.0, depth, np.nan)
        step = self.coefficients[below + 1] - self.coefficients[below]
        before = self.coefficients[below] - self.coefficients[np.maximum(below - 1, 0)]
        alone = np.isnan(step[..., :1]) & (share[..., None] == 0.0) & (below[..., None] > 0)
        step = np.where(alone, before, step)
        per_stripe = -(depth * np.sum(step[..., :3] * rays, axis=-1) + step[..., 3]) / facing
        point = np.concatenate([rays * depth[..., None], np.ones_like(depth)[..., None]], axis=-1)
        lower, upper = (
            np.sqrt(np.einsum("...i,...ij,...j->...", point, self.covariance[row], point))
            for row in (below, below + 1)
        )
        lower, upper = np.where(share < 1.0, lower, 0.0), np.where(share > 0.0, upper, 0.0)
        variance = (((1.0 - share) * lower + share * upper) / facing) ** 2
        return RayDepths(depth, per_stripe, variance)

    def _locate(self, s: Array) -> tuple[Indices, Array]:
        """Index of the plane below s, and the fraction of the interval from it to s."""
        last = len(self.coefficients) - 2
        below = np.clip(np.nan_to_num(np.floor(s), nan=0.0).astype(np.int64), 0, last)
        return below, np.where(np.isfinite(s), s - below, np.nan)


def compute_baseline_angle_tilt(planes: Array, direction: Axis) -> tuple[Array, Array, Array]:
    """Eq. 7-9: baseline (mm), projection angle and tilt angle (radians) of planes (N, 4).

    The equations divide by a, which is 0 for horizontal stripes; for those x and y are exchanged.
    """
    a, b, c, d = np.moveaxis(planes, -1, 0)
    if direction == "horizontal":
        a, b = b, a
    return d / a, np.arctan(-c / a), np.arctan(-b / a)


Sheets = TypeVar("Sheets", bound="SmoothSheets")


@dataclass(frozen=True, eq=False)
class Offset:
    """How far points (..., 3) lie off their sheets, in the model's own unit."""

    value: Array  # (...)
    by_point: Array  # (..., 3), derivatives by the point, camera frame
    reach: Array  # (...), the points' distance from the projector along its axis, mm
    by_parameter: Array | None = None  # (..., P), only when requested


@dataclass(frozen=True, eq=False)
class SmoothSheets(ABC):
    """Light sheets that are smooth in s."""

    kind: ClassVar[str]

    # A frame roughly at the projector, z the way it shines, x along the stripes, y across them.
    projector_from_camera: RigidTransform
    # (3,) mm, camera frame, the middle of the boards; the search for a depth starts there.
    middle: Array
    stripes: int
    direction: Axis
    parameters: Array  # (Q,), see the model
    covariance: Array  # (P, P) of the freedoms that `retract` takes

    @abstractmethod
    def linearize_prior(self) -> tuple[Array, Array]:
        """Compute the prior's residuals (R,) in standard deviations, and their Jacobian (R, P)."""

    @abstractmethod
    def retract(self: Sheets, step: Array) -> Sheets:
        """Return the sheets after a step (P,)."""

    @property
    def distance_mm(self) -> float:
        """Distance of the boards along the projector's z axis."""
        return float(self.projector_from_camera.apply(self.middle)[2])

    @abstractmethod
    def evaluate(self, s: Array) -> Any:
        """Evaluate the sheets at s (...), as `offset` needs them."""

    @abstractmethod
    def offset(self, points: Array, sheet: Any, *, parameters: bool = False) -> Offset:
        """Offset of points (..., 3), camera frame, from the sheets `evaluate(s)`."""

    def intersect(self, rays: Array, s: Array) -> RayDepths:
        """Intersect rays (..., 3) with z = 1, camera frame, with the sheets at s (...)."""
        shape = rays.shape[:-1]
        found = np.empty((3, int(np.prod(shape))))
        flat = np.ascontiguousarray(rays.reshape(-1, 3)), np.broadcast_to(s, shape).ravel()
        self._intersect(*flat, found)
        return RayDepths(*found.reshape(3, *shape))

    @abstractmethod
    def _intersect(self, rays: Array, s: Array, found: Array) -> None:
        """Fill `found` (3, N) with depth, dz/ds and variance of rays (N, 3) at s (N,)."""

    def tangent_planes(self, s: Array) -> Array:
        """Planes (..., 4) of Eq. 6 that touch the sheets at s (...) in the middle of the
        projector's image, at the boards' distance; (a, b, c) a unit vector, d >= 0."""
        camera_from_projector = self.projector_from_camera.inverse()
        s = np.asarray(s, float)
        position = np.zeros((*s.shape, 3))
        position[..., 2] = self.distance_mm
        across = camera_from_projector.rotation[:, 1]
        sheet = self.evaluate(s)
        for _ in range(5):
            offset = self.offset(camera_from_projector.apply(position), sheet)
            position[..., 1] -= offset.value / (offset.by_point @ across)
        points = camera_from_projector.apply(position)
        normals = self.offset(points, sheet).by_point
        normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
        planes = np.concatenate([normals, -np.sum(normals * points, -1, keepdims=True)], axis=-1)
        return orient_towards_camera(planes)
