"""The chapter's pinhole camera (Eq. 1), with its lens acting before the matrix A (Eq. 3-5)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np

from bodyscan.arrays import Array
from bodyscan.geometry.lenses import LENSES
from bodyscan.geometry.lenses.lens import Lens
from bodyscan.geometry.lenses.opencv import Radial

MATRIX = ("alpha", "beta", "gamma", "u0", "v0")
MATRIX_PRIOR_PX = (50.0, 50.0, 5.0, 50.0, 50.0)
"""Standard deviations of A's entries before the rig's own shots: at worst a pair's few boards'."""


class CameraPrior(NamedTuple):
    """Parameters (P,) of a camera and their sigmas (P,), known before any board was seen."""

    parameters: Array
    sigmas: Array


@dataclass(frozen=True)
class Camera:
    """Intrinsics in pixels: (u, v) = (column, row), whole numbers at pixel centres.

    Camera frame: x right, y down, z forward, mm.
    prior: given for a camera that was calibrated elsewhere; it has no effect on projection.
    """

    alpha: float
    beta: float
    gamma: float
    u0: float
    v0: float
    lens: Lens
    width: int
    height: int
    prior: CameraPrior | None = field(default=None, compare=False, repr=False)

    @property
    def matrix(self) -> Array:
        """The matrix A of Eq. 1, (3, 3)."""
        above = [self.alpha, self.gamma, self.u0], [0.0, self.beta, self.v0]
        return np.array([*above, [0.0, 0.0, 1.0]])

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Names of the P unknowns of a calibration: A's five, then the lens coefficients."""
        return (*MATRIX, *self.lens.names)

    @property
    def parameters(self) -> Array:
        """Values (P,) in the order of `parameter_names`."""
        return np.array([*(getattr(self, name) for name in MATRIX), *self.lens.coefficients])

    @property
    def prior_sigmas(self) -> Array:
        """Standard deviations (P,) of the parameters before any shot of the rig is used."""
        if self.prior is not None:
            return self.prior.sigmas
        return np.array([*MATRIX_PRIOR_PX, *self.lens.prior_sigmas])

    def retract(self, step: Array) -> Camera:
        """The camera after a step (P,) is added to its parameters."""
        moved = (self.parameters + step)[: len(MATRIX)].tolist()
        matrix = dict(zip(MATRIX, moved, strict=True))
        lens = self.lens.with_coefficients(self.lens.coefficients + step[len(MATRIX) :])
        return replace(self, **matrix, lens=lens)

    def project(self, points: Array) -> Array:
        """Project points (..., 3), camera frame, z > 0, to real image coordinates (..., 2), px."""
        normalized = points[..., :2] / points[..., 2:3]
        return self.pixels_from_normalized(self.lens.distort(normalized))

    def rays(self, pixels: Array) -> Array:
        """Directions (..., 3) with z = 1, camera frame, of real image coordinates (..., 2), px."""
        normalized = self.lens.undistort(self.normalized_from_pixels(pixels))
        return np.concatenate([normalized, np.ones_like(normalized[..., :1])], axis=-1)

    def rays_by_pixels(self, rays: Array) -> Array:
        """Derivatives (..., 2, 2), by pixel, of the (x, y) of rays (..., 3) whose z is 1."""
        by_ray = self.matrix[:2, :2] @ self.lens.by_point(rays[..., :2])
        (a, b), (c, d) = np.moveaxis(by_ray, (-2, -1), (0, 1))
        inverse = np.stack([d, -b, -c, a], axis=-1) / (a * d - b * c)[..., None]
        return inverse.reshape(*rays.shape[:-1], 2, 2)

    def pixel_rays(self) -> Array:
        """Rays (height, width, 3) through the pixel centres."""
        u, v = np.meshgrid(np.arange(self.width, dtype=float), np.arange(self.height, dtype=float))
        return self.rays(np.stack([u, v], axis=-1))

    @property
    def folds(self) -> bool:
        """Whether the lens folds over more than half of the picture: a slip, not a lens."""
        return self.ray_share() < 0.5

    def ray_share(self) -> float:
        """Share of the picture that rays pass through: less than 1 where the lens folds within it, less
        than 75 degrees from its axis: the black around a fisheye's picture is no fold."""
        if self.lens.fold_radius > 3.7:
            return 1.0
        across = (np.arange(9) + 0.5) / 9.0
        pixels = np.stack(np.meshgrid(across * self.width, across * self.height), axis=-1)
        with np.errstate(all="ignore"):
            return float(np.isfinite(self.rays(pixels)).all(axis=-1).mean())

    def jacobians(self, points: Array) -> tuple[Array, Array]:
        """d(pixels)/d(parameters) (N, 2, P) and d(pixels)/d(points) (N, 2, 3), points (N, 3) mm."""
        z = points[:, 2]
        ideal = points[:, :2] / z[:, None]
        real, a = self.lens.distort(ideal), self.matrix[:2, :2]
        by_parameter = np.zeros((len(points), 2, len(self.parameter_names)))
        by_parameter[:, 0, 0], by_parameter[:, 1, 1] = real[:, 0], real[:, 1]
        by_parameter[:, 0, 2] = real[:, 1]
        by_parameter[:, 0, 3] = by_parameter[:, 1, 4] = 1.0
        by_x, by_y = np.moveaxis(self.lens.by_coefficients(ideal), 1, 0)
        by_parameter[:, 0, len(MATRIX) :] = self.alpha * by_x + self.gamma * by_y
        by_parameter[:, 1, len(MATRIX) :] = self.beta * by_y
        perspective = np.zeros((len(points), 2, 3))
        perspective[:, 0, 0] = perspective[:, 1, 1] = 1.0 / z
        perspective[:, :, 2] = -ideal / z[:, None]
        return by_parameter, a @ self.lens.by_point(ideal) @ perspective

    def pixels_from_normalized(self, normalized: Array) -> Array:
        """Apply A (Eq. 1): normalised coordinates (..., 2) to px (..., 2)."""
        x, y = normalized[..., 0], normalized[..., 1]
        u = self.alpha * x + self.gamma * y + self.u0
        return np.stack([u, self.beta * y + self.v0], axis=-1)

    def normalized_from_pixels(self, pixels: Array) -> Array:
        """Invert A (Eq. 5; Eq. 11 and 12 over z): px (..., 2) to normalised coordinates (..., 2)."""
        y = (pixels[..., 1] - self.v0) / self.beta
        x = (pixels[..., 0] - self.u0 - self.gamma * y) / self.alpha
        return np.stack([x, y], axis=-1)


SIZE = ("width", "height")


def describe_camera(camera: Camera) -> dict[str, Any]:
    """alpha, beta, gamma, u0, v0, the kind of lens, its coefficients by name, width and height."""
    matrix = {name: getattr(camera, name) for name in (*MATRIX, *SIZE)}
    lens = {name: getattr(camera.lens, name) for name in camera.lens.names}
    kind = {} if camera.lens.kind == Radial.kind else {"lens": camera.lens.kind}
    return matrix | lens | kind


def camera_from_fields(content: Mapping[str, Any]) -> Camera:
    """The camera whose fields `describe_camera` returned.

    Raises ValueError for an unknown lens, a missing or surplus name, or a value that is not finite.
    """
    numbers = dict(content)
    kind = numbers.pop("lens", Radial.kind)
    if kind not in LENSES:
        raise ValueError(f"a lens {kind!r} is unknown, there are {', '.join(LENSES)}")
    lens = LENSES[kind]()
    expected = {*MATRIX, *lens.names, *SIZE}
    if numbers.keys() != expected:
        odd = sorted(numbers.keys() ^ expected)
        raise ValueError(f"a camera with a {kind} lens lacks or does not have {', '.join(odd)}")
    for name, value in numbers.items():
        is_number = isinstance(value, int | float) and not isinstance(value, bool)
        if not is_number or not math.isfinite(value):
            raise ValueError(f"{name} of a camera is {value!r}, not a number")
    coefficients = {name: numbers.pop(name) for name in lens.names}
    return Camera(lens=type(lens)(**coefficients), **numbers)
