"""Range images of a person who sways, breathes and moves arms and head while pairs take turns.

The body at every moment is known. Nothing is rendered: depths are cast from a deformed mesh.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import open3d as o3d
from open3d.pybind.t.geometry import RaycastingScene
from ray_cast_scan import BODY, Truth, load_body, nominal_camera, nominal_placings, scene_of
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import dijkstra

from bodyscan.arrays import Array, Bytes, Mask
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.geometry.uncertainty import PoseCovariance
from bodyscan.reconstruction.range_image import RangeImage
from bodyscan.rig.pair import Pair
from bodyscan.rig.rig import Rig

PAIR_MS = 183.0  # 22 frames at 120 a second
PERIOD_S = 3.5


@dataclass(frozen=True)
class Motion:
    """sway_mm_s: RMS speed at the head.  breath_mm: from the least to the most, at chest and belly.
    arms_deg, head_deg: amplitude of their turns."""

    sway_mm_s: float = 7.0
    breath_mm: float = 4.0
    arms_deg: float = 0.5
    head_deg: float = 0.25

    def times(self, factor: float) -> Motion:
        return Motion(*(factor * getattr(self, name) for name in self.__annotations__))


STANDING = Motion()
STILL = STANDING.times(0.0)


@dataclass(frozen=True, eq=False)
class Living:
    """A body that moves. at: its vertices (V, 3) mm at a time, rig frame."""

    still: Truth
    motion: Motion
    seed: int

    @cached_property
    def stature_mm(self) -> float:
        return float(self.still.vertices[:, 2].max())

    @cached_property
    def arms(self) -> tuple[Array, Array]:
        """How much of each vertex (V,) goes with the left and with the right arm."""
        vertices, faces = self.still.vertices, self.still.faces
        a = np.concatenate([faces[:, 0], faces[:, 1], faces[:, 2]])
        b = np.concatenate([faces[:, 1], faces[:, 2], faces[:, 0]])
        length = np.linalg.norm(vertices[a] - vertices[b], axis=1)
        edges = coo_matrix((length, (a, b)), shape=(len(vertices),) * 2).tocsr()
        tips = [int(np.argmax(vertices[:, 1])), int(np.argmin(vertices[:, 1]))]
        away = dijkstra(edges, directed=False, indices=tips) / self.stature_mm
        return tuple(_step((0.44 - away) / 0.12))

    @cached_property
    def head(self) -> Array:
        return _step((self.still.vertices[:, 2] / self.stature_mm - 0.84) / 0.06)

    @cached_property
    def breathing(self) -> Array:
        """(V, 3): where each vertex goes with a breath of 1 mm."""
        x, y, z = (self.still.vertices / self.stature_mm).T
        trunk = 1.0 - np.maximum(*self.arms)
        chest = np.exp(-0.5 * ((z - 0.72) / 0.06) ** 2)
        belly = 0.8 * np.exp(-0.5 * ((z - 0.60) / 0.05) ** 2)
        away = np.stack([x + 0.02, y, np.zeros_like(x)], axis=1)
        away /= np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-9)
        front = _step(0.4 + 0.6 * away[:, 0])
        return (trunk * (chest + belly) * front)[:, None] * away

    @cached_property
    def phase(self) -> float:
        return float(np.random.default_rng(self.seed).uniform(0.0, 2.0 * np.pi))

    def at(self, seconds: float | None) -> Truth:
        """None: in the mean of its breath and stance."""
        if seconds is None:
            return self.still
        m, height, rng = self.motion, self.stature_mm, np.random.default_rng(self.seed + 1000)
        vertices = self.still.vertices.copy()
        breath = 0.5 * m.breath_mm * np.sin(2.0 * np.pi * seconds / PERIOD_S + self.phase)
        vertices += breath * self.breathing
        for side, weight in zip((1.0, -1.0), self.arms, strict=True):
            turn = np.radians(m.arms_deg) * np.array([_wave(rng, seconds)[0] for _ in range(3)])
            joint = height * np.array([0.0, 0.115 * side, 0.80])
            vertices += weight[:, None] * np.cross(turn, vertices - joint)
        turn = np.radians(m.head_deg) * np.array([_wave(rng, seconds)[0] for _ in range(3)])
        joint = height * np.array([0.0, 0.0, 0.87])
        vertices += self.head[:, None] * np.cross(turn, vertices - joint)
        # An inverted pendulum about the ankles, and a little turn about the upright axis; feet stand.
        lean = []
        for _ in range(2):
            rms = np.sqrt(
                np.mean([_wave(np.random.default_rng(s), 0.0)[1] ** 2 for s in range(99)])
            )
            lean.append(m.sway_mm_s / np.sqrt(2.0) / rms / height * _wave(rng, seconds)[0])
        angle = np.array([lean[0], lean[1], 0.5 * lean[0]])
        ankles = np.array([0.0, 0.0, 0.04 * height])
        lean_to = RigidTransform.from_rotation_vector(angle, np.zeros(3)).apply(vertices - ankles)
        above = _step((self.still.vertices[:, 2:] / height - 0.03) / 0.02)
        vertices = vertices + above * (lean_to + ankles - vertices)
        return replace(self.still, vertices=vertices)


@dataclass(frozen=True, eq=False)
class LivingScan:
    """exact: the range images without noise."""

    body: Living
    images: list[RangeImage]
    exact: list[RangeImage]
    rig_from_camera: dict[str, RigidTransform]
    seconds: Mapping[str, float]

    @property
    def middle_s(self) -> float:
        return 0.5 * (min(self.seconds.values()) + max(self.seconds.values()))


def cast_living(
    rig: Rig, motion: Motion = STANDING, *, seed: int = 1, scale: float = 0.25, noise_mm: float = 0.1,
    facing_deg: float = 0.0, subject: str = BODY.stem, subdivisions: int = 1,
) -> LivingScan:  # fmt: skip
    """The rig's pairs one after another, in its order."""
    turn = RigidTransform.from_rotation_vector([0.0, 0.0, np.radians(facing_deg)], np.zeros(3))
    still = load_body(BODY.with_stem(subject), subdivisions)
    living, poses = Living(still, motion, seed), nominal_placings(rig)
    rng = np.random.default_rng(seed)
    images: list[RangeImage] = []
    exact: list[RangeImage] = []
    seconds: dict[str, float] = {}
    for number, pair in enumerate(rig.pairs):
        seconds[pair.name] = 1e-3 * PAIR_MS * (number + 0.5)
        now = living.at(seconds[pair.name])
        camera = nominal_camera(round(scale * pair.camera.width), round(scale * pair.camera.height))
        placed = replace(now, vertices=turn.apply(now.vertices))
        found = _cast(placed, pair, camera.pixel_rays(), poses[pair.name])
        for noise, images_of in ((noise_mm, images), (0.0, exact)):
            rays, depth, normals, grey = found
            noisy = depth + rng.normal(0.0, noise, depth.shape) / np.linalg.norm(rays, axis=-1)
            sigma = np.where(np.isfinite(depth), noise_mm, np.nan).astype(np.float32)
            points = (rays * noisy[..., None]).astype(np.float32)
            images_of.append(
                RangeImage(pair.name, camera, points, normals.astype(np.float32), sigma, grey)
            )
    # In the body's own frame, so that facing_deg turns the rig about the person.
    poses = {name: turn.inverse() @ pose for name, pose in poses.items()}
    return LivingScan(living, images, exact, poses, seconds)


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


def _cast(
    truth: Truth, pair: Pair, rays: Array, pose: RigidTransform
) -> tuple[Array, Array, Array, Bytes]:
    """rays, depths z (NaN where there is nothing lit), normals, camera frame, and grey levels."""
    scene = scene_of(truth)
    mesh = o3d.geometry.TriangleMesh(
        o3d.utility.Vector3dVector(truth.vertices), o3d.utility.Vector3iVector(truth.faces)
    )
    smooth = np.asarray(mesh.compute_vertex_normals().vertex_normals)
    depth, face, uv = _hits(scene, pose.translation, pose.rotate(rays))
    seen = np.isfinite(depth)
    corners = smooth[truth.faces[np.where(seen, face, 0)]]
    share = np.stack([1.0 - uv.sum(axis=-1), uv[..., 0], uv[..., 1]], axis=-1)
    normals = np.einsum("...k,...kc->...c", share, corners) @ pose.rotation
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    hit = pose.apply(rays * np.where(seen, depth, 0.0)[..., None])
    assert pair.projector_nominal is not None
    lamp = np.array(pair.projector_nominal.position_mm)
    lit = _hits(scene, lamp, hit - lamp)[0] > 1.0 - 1e-3
    cosine = -np.sum(normals * rays, axis=-1) / np.linalg.norm(rays, axis=-1)
    valid: Mask = seen & lit & (cosine > 0.17)
    grey = np.where(valid, 40 + 200 * np.clip(cosine, 0.0, 1.0), 0).astype(np.uint8)
    normals = np.where(valid[..., None], normals, np.nan)
    return rays, np.where(valid, depth, np.nan), normals, grey


def _hits(scene: RaycastingScene, origin: Array, ways: Array) -> tuple[Array, Array, Array]:
    rays = np.concatenate([np.broadcast_to(origin, ways.shape), ways], axis=-1)
    cast = scene.cast_rays(rays.astype(np.float32))
    return (
        cast["t_hit"].numpy().astype(float),
        cast["primitive_ids"].numpy(),
        cast["primitive_uvs"].numpy().astype(float),
    )


def _wave(rng: np.random.Generator, seconds: float) -> tuple[float, float]:
    """A smooth random walk of standard deviation 0.7, and its speed per second."""
    value = speed = 0.0
    for hertz in (0.2, 0.45, 0.8):
        pulse, phase = 2.0 * np.pi * hertz, rng.uniform(0.0, 2.0 * np.pi)
        value += 0.2 / hertz * np.sin(pulse * seconds + phase) / 1.1
        speed += 0.2 / hertz * pulse * np.cos(pulse * seconds + phase) / 1.1
    return value, speed


def _step(share: Array) -> Array:
    share = np.clip(share, 0.0, 1.0)
    return share * share * (3.0 - 2.0 * share)


def boards(scan: LivingScan) -> PoseCovariance:
    """Pairs known to 0.03 mm and 0.002 degrees about the body's middle, each by itself."""
    carry = np.eye(6)
    carry[3:, :3] = [[0.0, 900.0, 0.0], [-900.0, 0.0, 0.0], [0.0, 0.0, 0.0]]
    own = carry @ np.diag([np.radians(0.002) ** 2] * 3 + [0.03**2] * 3) @ carry.T
    names = tuple(scan.rig_from_camera)
    return PoseCovariance(names, np.kron(np.eye(len(names)), own).astype(float))


def images_of(scan: LivingScan, *, timed: bool = True) -> list[RangeImage]:
    return [
        replace(image, time_ms=1e3 * scan.seconds[image.pair] if timed else None)
        for image in scan.images
    ]
