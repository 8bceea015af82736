"""What stands in the light: triangle meshes with an albedo, and the rays cast at them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import open3d as o3d
from numpy.typing import NDArray

from bodyscan.arrays import Array, Floats, Indices, Mask
from bodyscan.geometry.transforms import RigidTransform

Tensor = o3d.core.Tensor


Print = Callable[[Floats], Floats]
"""Something printed on a surface: albedo (N,) at positions (N, 2) on it."""


@dataclass(frozen=True, eq=False)
class Surface:
    """A triangle mesh that scatters light evenly (Lambert), visible from either side."""

    vertices: Array  # (N, 3) mm
    triangles: NDArray[np.integer]  # (T, 3) int
    albedo: float | Array = 0.5  # one, or (N,) one for each vertex
    # printed, print_xy: a print, and each vertex's position on it, (N, 2); it overrides the albedo.
    printed: Print | None = None
    print_xy: Array | None = None
    normals: Array | None = None  # (N, 3) unit, if the surface is to be shaded smoothly
    # Nothing can come between it and the projector, so shadows need not be tested.
    open_to_light: bool = False
    encloses: bool = False  # everything is on one side of it, so it casts no shadow
    # (N,) how far each vertex is skin that lets light in, 0 to 1; None if nothing is.
    skin: Array | None = None

    def transform(self, a_from_b: RigidTransform) -> Surface:
        """Apply a rigid transform."""
        normals = None if self.normals is None else a_from_b.rotate(self.normals)
        return replace(self, vertices=a_from_b.apply(self.vertices), normals=normals)


@dataclass(frozen=True, eq=False)
class Hits:
    """Where rays met the scene."""

    depth: Floats  # (N,), infinite where they met nothing
    points: Floats
    normals: Floats  # (N, 3), of any length, to either side
    albedo: Floats  # (N,) of what has no print; `Scene.print_on` writes that of prints
    surface: NDArray[np.uint32]  # (N,) number of the surface, one past the last if none
    skin: Floats  # (N,) as `Surface.skin`
    facets: Floats  # (N, 3) normals of the triangles, of any length
    print_xy: Floats  # (N, 2) position on the surface's print, if it has one


class Scene:
    """Surfaces in one pair's camera frame, ready for rays from its optical centre."""

    def __init__(self, surfaces: Sequence[Surface]) -> None:
        self.surfaces = tuple(surfaces)
        self._shadowable = np.array([not surface.open_to_light for surface in surfaces] + [False])
        standing = [surface for surface in surfaces if not surface.encloses]
        self._ball = _find_bounding_ball(standing)
        # Open3D holds Python's lock while it casts: threads of Python would take turns.
        self._rays = o3d.t.geometry.RaycastingScene(nthreads=2)
        self._varied = [_list_varied(surface) for surface in self.surfaces]
        for surface in self.surfaces:
            self._rays.add_triangles(
                Tensor(surface.vertices.astype(np.float32)),
                Tensor(surface.triangles.astype(np.uint32)),
            )

    def cast(self, directions: Floats) -> Hits:
        """Cast rays from the origin along directions (N, 3) with z = 1."""
        rays = np.zeros((len(directions), 6), np.float32)
        rays[:, 3:] = directions
        answer = self._rays.cast_rays(Tensor.from_numpy(rays), nthreads=2)
        found: dict[str, NDArray[Any]] = {key: value.numpy() for key, value in answer.items()}
        depth, facets = found["t_hit"], found["primitive_normals"]
        normals, print_xy = facets.copy(), np.zeros((len(depth), 2), np.float32)
        surface = np.minimum(found["geometry_ids"], len(self.surfaces))
        albedo, skin = np.zeros((len(depth), 1), np.float32), np.zeros((len(depth), 1), np.float32)
        for number, varied in enumerate(self._varied):
            chosen = np.flatnonzero(surface == number)
            hit, uv = found["primitive_ids"][chosen], found["primitive_uvs"][chosen]
            corners = self.surfaces[number].triangles.take(hit, axis=0)
            for name, values in (
                ("albedo", albedo), ("normals", normals), ("skin", skin), ("print_xy", print_xy)
            ):  # fmt: skip
                if name in varied:
                    values[chosen] = _interpolate(varied[name], corners, uv)
        points = directions * np.where(np.isfinite(depth), depth, np.float32(0.0))[:, None]
        return Hits(depth, points, normals, albedo[:, 0], surface, skin[:, 0], facets, print_xy)

    def print_on(self, surface: Floats, across: Floats, down: Floats, albedo: Floats) -> None:
        """Write the prints' albedo wherever the surface is a printed one."""
        for number, one in enumerate(self.surfaces):
            if one.printed is not None:
                on = surface == number
                albedo[on] = one.printed(np.stack([across[on], down[on]], axis=1))

    def is_shadowed(self, points: Floats, towards: Floats, surface: NDArray[np.uint32]) -> Mask:
        """Test whether something is between points (N, 3) on surfaces and the source of their light.

        towards: (N, 3) from each point to the source.
        """
        middle, radius = self._ball
        arm = points - middle.astype(np.float32)
        aside = dot(arm, arm) - dot(arm, towards) ** 2 / dot(towards, towards)  # squared
        chosen = np.flatnonzero(self._shadowable[surface] & (aside < radius**2))
        blocked = np.zeros(len(points), bool)
        if chosen.size:
            rays = np.empty((chosen.size, 6), np.float32)
            rays[:, :3] = points.take(chosen, axis=0)
            rays[:, 3:] = towards.take(chosen, axis=0)
            # What is nearer than 0.3 mm casts no shadow.
            near = 0.3 / float(np.abs(rays[:, 3:]).max())
            answer = self._rays.test_occlusions(
                Tensor.from_numpy(rays), tnear=near, tfar=0.95, nthreads=2
            )
            blocked[chosen] = answer.numpy()
        return blocked


def _find_bounding_ball(surfaces: Iterable[Surface]) -> tuple[Array, float]:
    """Bound everything that can cast a shadow by a ball (middle, radius)."""
    corners = [[one.vertices.min(axis=0), one.vertices.max(axis=0)] for one in surfaces]
    if not corners:
        return np.zeros(3), 0.0
    low, high = np.min(corners, axis=(0, 1)), np.max(corners, axis=(0, 1))
    return (low + high) / 2.0, float(np.linalg.norm(high - low)) / 2.0


def dot(a: Floats, b: Floats) -> Floats:
    """Compute dot products (N,) of rows (N, 3), faster than einsum on such short rows."""
    return a[:, 0] * b[:, 0] + a[:, 1] * b[:, 1] + a[:, 2] * b[:, 2]


def _list_varied(surface: Surface) -> dict[str, Floats]:
    """List what varies over a surface, at its vertices, (N, k)."""
    varied = {
        "albedo": np.broadcast_to(surface.albedo, len(surface.vertices)),
        "normals": surface.normals,
        "skin": surface.skin,
        "print_xy": None if surface.printed is None else surface.print_xy,
    }
    return {
        name: values.reshape(len(values), -1).astype(np.float32)
        for name, values in varied.items()
        if values is not None
    }


def _interpolate(values: Floats, corners: NDArray[np.integer], uv: Floats) -> Floats:
    """Interpolate (N, k) at barycentric coordinates uv (N, 2) of triangles with corners (N, 3)."""
    first, second, third = (values.take(vertices, axis=0) for vertices in corners.T)
    return first + uv[:, :1] * (second - first) + uv[:, 1:] * (third - first)


def build_grid_surface(
    corner: Array, across: Array, down: Array, steps: tuple[int, int] = (1, 1), **more: Any
) -> Surface:
    """Build a flat patch from a corner and two sides (3,), cut in steps; print_xy from 0 to 1."""
    columns, rows = steps
    x, y = np.meshgrid(np.linspace(0, 1, columns + 1), np.linspace(0, 1, rows + 1))
    print_xy = np.stack([x.ravel(), y.ravel()], axis=1)
    vertices = corner + print_xy @ np.stack([across, down])
    return Surface(vertices, list_grid_triangles(columns, rows), print_xy=print_xy, **more)


def list_grid_triangles(columns: int, rows: int) -> Indices:
    """List two triangles for each cell of a grid of (rows + 1) x (columns + 1) vertices."""
    first = (np.arange(rows)[:, None] * (columns + 1) + np.arange(columns)).ravel()
    below = first + columns + 1
    upper = np.stack([first, first + 1, below], axis=1)
    lower = np.stack([first + 1, below + 1, below], axis=1)
    return np.concatenate([upper, lower])
