"""Range images of a person who sways, breathes and moves arms and head while pairs take turns.

The body at every moment is known. Nothing is rendered: depths are cast from a deformed mesh.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, replace

import numpy as np
import open3d as o3d
from ray_cast_scan import (
    BODY,
    Truth,
    cast_rays,
    is_lit,
    load_body,
    nominal_camera,
    nominal_placings,
    scene_of,
)

from bodyscan.arrays import Array
from bodyscan.geometry.camera import Camera
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.geometry.uncertainty import PoseCovariance
from bodyscan.reconstruction.range_image import RangeImage
from bodyscan.rig.pair import Pair
from bodyscan.rig.rig import Rig
from bodyscan.simulation.living import LivingBody, animate
from bodyscan.simulation.scene import Surface
from bodyscan.simulation.settings import Person

PAIR_MS = 183.0  # 22 frames at 120 a second


STANDING = Person(sway_mm_s=7.0, breath_mm=4.0, arms_deg=0.5, head_deg=0.25)
STILL = Person()


@dataclass(frozen=True, eq=False)
class LivingScan:
    """exact: the range images without noise."""

    body: LivingBody
    images: list[RangeImage]
    exact: list[RangeImage]
    rig_from_camera: dict[str, RigidTransform]
    seconds: dict[str, float]

    @property
    def middle_s(self) -> float:
        return 0.5 * (min(self.seconds.values()) + max(self.seconds.values()))

    def at(self, seconds: float, *, breathing: bool = True) -> Truth:
        """The body at a time, or as it would be at mean breath then."""
        vertices = self.body.vertices(1e3 * seconds, breathing=breathing)
        return Truth(vertices, self.body.rest.triangles)


def cast_living(
    rig: Rig, person: Person = STANDING, *, seed: int = 1, scale: float = 0.25, poles: int = 1
) -> LivingScan:
    """The rig's pairs one after another, in its order, so many poles at once; noise of 0.1 mm."""
    rng = np.random.default_rng(seed)
    still = load_body(BODY, 1)
    body = animate(Surface(still.vertices, still.faces), person, rng)
    scan = LivingScan(body, [], [], nominal_placings(rig), {})
    for number, pair in enumerate(rig.pairs):
        scan.seconds[pair.name] = 1e-3 * PAIR_MS * (number % (len(rig.pairs) // poles) + 0.5)
        camera = nominal_camera(round(scale * pair.camera.width), round(scale * pair.camera.height))
        pose = scan.rig_from_camera[pair.name]
        exact = _cast(scan.at(scan.seconds[pair.name]), pair, camera, pose)
        noise = rng.normal(0.0, 0.1, exact.sigma_mm.shape)
        length = np.linalg.norm(exact.points, axis=-1)
        noisy = exact.points * (1.0 + noise / length)[..., None]
        scan.exact.append(exact)
        scan.images.append(replace(exact, points=noisy.astype(np.float32)))
    return scan


def errors_mm(truth: Truth, points: Array) -> Array:
    """(N,) distances of points (N, 3) to the body, laid rigidly onto it."""
    scene, placed = scene_of(truth), points
    for _ in range(4):
        near = scene.compute_closest_points(placed.astype(np.float32))
        off = placed - near["points"].numpy().astype(float)
        normals = near["primitive_normals"].numpy().astype(float)
        distance = np.sum(off * normals, axis=1)
        arms = np.hstack([1e-3 * np.cross(placed, normals), normals])
        motion = np.linalg.lstsq(arms, -distance)[0] * np.repeat([1e-3, 1.0], 3)
        placed = RigidTransform.from_rotation_vector(motion[:3], motion[3:]).apply(placed)
    return np.asarray(distance)


def _cast(truth: Truth, pair: Pair, camera: Camera, pose: RigidTransform) -> RangeImage:
    """What a pair measures, without noise; its normals are smooth."""
    scene, rays = scene_of(truth), camera.pixel_rays()
    mesh = o3d.geometry.TriangleMesh(
        o3d.utility.Vector3dVector(truth.vertices), o3d.utility.Vector3iVector(truth.faces)
    )
    smooth = np.asarray(mesh.compute_vertex_normals().vertex_normals)
    cast = cast_rays(scene, pose.translation, pose.rotate(rays))
    depth, uv = cast["t_hit"].astype(float), cast["primitive_uvs"].astype(float)
    seen = np.isfinite(depth)
    corners = smooth[truth.faces[np.where(seen, cast["primitive_ids"], 0)]]
    share = np.stack([1.0 - uv.sum(axis=-1), uv[..., 0], uv[..., 1]], axis=-1)
    normals = np.einsum("...k,...kc->...c", share, corners) @ pose.rotation
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    lit = is_lit(scene, pair, pose.apply(rays * np.where(seen, depth, 0.0)[..., None]))
    cosine = -np.sum(normals * rays, axis=-1) / np.linalg.norm(rays, axis=-1)
    valid = seen & lit & (cosine > 0.17)
    return RangeImage(
        pair.name,
        camera,
        np.where(valid[..., None], rays * depth[..., None], np.nan).astype(np.float32),
        np.where(valid[..., None], normals, np.nan).astype(np.float32),
        np.where(valid, 0.1, np.nan).astype(np.float32),
        np.where(valid, 40 + 200 * np.clip(cosine, 0.0, 1.0), 0).astype(np.uint8),
    )


def known_to(names: Collection[str], mm: float, deg: float) -> PoseCovariance:
    """Independent errors of the pairs, about the body's middle."""
    carry = np.eye(6)
    carry[3:, :3] = [[0.0, 900.0, 0.0], [-900.0, 0.0, 0.0], [0.0, 0.0, 0.0]]
    own = carry @ np.diag([np.radians(deg) ** 2] * 3 + [mm**2] * 3) @ carry.T
    return PoseCovariance(tuple(names), np.kron(np.eye(len(names)), own).astype(float))


def boards(scan: LivingScan) -> PoseCovariance:
    return known_to(scan.rig_from_camera, 0.03, 0.002)


def images_of(scan: LivingScan, *, timed: bool = True) -> list[RangeImage]:
    return [
        replace(image, time_ms=1e3 * scan.seconds[image.pair] if timed else None)
        for image in scan.images
    ]
