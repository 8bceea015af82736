"""Range images of a body with known truth, by ray casting: what the fusion tests work on."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import open3d as o3d
import yaml
from open3d.pybind.t.geometry import RaycastingScene
from ring import looking_at

from bodyscan.arrays import Array, Mask
from bodyscan.geometry.camera import Camera
from bodyscan.geometry.lenses.opencv import Radial
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.reconstruction.range_image import RangeImage
from bodyscan.rig.pair import NominalPose, Pair
from bodyscan.rig.rig import Rig

ROOT = Path(__file__).parents[2]
BODY = ROOT / "data" / "subjects" / "woman_average.ply"


@dataclass(frozen=True, eq=False)
class Truth:
    """The surface that was scanned: vertices (V, 3) mm, rig frame, and faces (F, 3)."""

    vertices: np.ndarray
    faces: np.ndarray


@dataclass(frozen=True, eq=False)
class Scan:
    """Range images with noise, where their cameras stand, and the truth."""

    range_images: list[RangeImage]
    rig_from_camera: dict[str, RigidTransform]
    truth: Truth


def load_rig(name: str = "three-pole-12") -> Rig:
    return Rig.model_validate(yaml.safe_load((ROOT / "rigs" / f"{name}.yaml").read_text()))


@cache
def load_body(path: Path = BODY, subdivisions: int = 2) -> Truth:
    """A subject's file (metres, facing -y), Loop-subdivided, facing x in mm."""
    mesh = o3d.io.read_triangle_mesh(str(path)).subdivide_loop(subdivisions)
    x, y, z = 1000.0 * np.asarray(mesh.vertices).T
    return Truth(np.stack([-y, x, z], axis=-1), np.asarray(mesh.triangles).astype(np.int64))


def scene_of(truth: Truth) -> o3d.t.geometry.RaycastingScene:
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(truth.vertices.astype(np.float32), truth.faces.astype(np.uint32))
    return scene


def cast_rays(scene: RaycastingScene, origin: Array, ways: Array) -> dict[str, np.ndarray]:
    """What Open3D tells of rays from one origin (3,) along `ways` (..., 3)."""
    rays = np.concatenate([np.broadcast_to(origin, ways.shape), ways], axis=-1)
    found = scene.cast_rays(rays.astype(np.float32))
    return {name: values.numpy() for name, values in found.items()}


def is_lit(scene: RaycastingScene, pair: Pair, points: Array) -> Mask:
    """Whether nothing stands between points (..., 3) and a pair's projector."""
    assert pair.projector_nominal is not None
    lamp = np.array(pair.projector_nominal.position_mm)
    return np.asarray(cast_rays(scene, lamp, points - lamp)["t_hit"] > 1.0 - 1e-3)


def looking(placing: NominalPose) -> RigidTransform:
    """rig_from_camera of a camera that stands upright at a placing."""
    return looking_at(list(placing.position_mm), list(placing.look_at_mm))


def nominal_placings(rig: Rig) -> dict[str, RigidTransform]:
    """rig_from_camera of every pair whose placing the rig file gives."""
    return {pair.name: looking(pair.nominal) for pair in rig.pairs if pair.nominal}


def nominal_camera(width: int, height: int) -> Camera:
    """Sees about 1 m x 0.8 m at 1.3 m, with a little barrel distortion."""
    focal = 1.33 * width
    u0, v0 = width / 2 + 3.3, height / 2 - 2.1
    return Camera(focal, 1.002 * focal, 0.4, u0, v0, Radial(-0.09, 0.06), width, height)


def cast_scan(
    truth: Truth,
    rig: Rig,
    *,
    scale: float = 1.0,
    noise_mm: float = 0.3,
    flying: float = 0.01,
    seed: int = 1,
    floor: bool = True,
) -> Scan:
    """What the rig's pairs would measure from their nominal placings. A pixel counts only if its point
    is also lit from the projector's placing. `flying` is the fraction of pixels that silhouettes turn
    into points somewhere between front and back."""
    scene = scene_of(truth)
    if floor:
        square = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], np.float32) * 2500
        scene.add_triangles(square, np.array([[0, 1, 2], [0, 2, 3]], np.uint32))
    rng = np.random.default_rng(seed)
    poses = nominal_placings(rig)
    images = []
    for pair in rig.pairs:
        camera = nominal_camera(round(scale * pair.camera.width), round(scale * pair.camera.height))
        images.append(_cast(scene, pair, camera, poses[pair.name], noise_mm, flying, rng))
    return Scan(images, poses, truth)


def _cast(
    scene: RaycastingScene,
    pair: Pair,
    camera: Camera,
    pose: RigidTransform,
    noise_mm: float,
    flying: float,
    rng: np.random.Generator,
) -> RangeImage:
    rays = camera.pixel_rays()
    cast = cast_rays(scene, pose.translation, pose.rotate(rays))
    depth, normals = cast["t_hit"].astype(float), cast["primitive_normals"] @ pose.rotation
    seen = np.isfinite(depth)
    depth[~seen] = 0.0
    lit = is_lit(scene, pair, pose.apply(rays * depth[..., None]))
    valid = seen & (np.sum(normals * rays, axis=-1) < 0) & lit
    length = np.linalg.norm(rays, axis=-1)
    depth = depth + rng.normal(0.0, noise_mm, depth.shape) / length
    depth = _mix_silhouettes(depth, valid, flying, rng)
    shade = -np.sum(normals * rays, axis=-1) / length
    points = np.where(valid[..., None], rays * depth[..., None], np.nan).astype(np.float32)
    return RangeImage(
        pair.name,
        camera,
        points,
        np.where(valid[..., None], normals, np.nan).astype(np.float32),
        np.where(valid, noise_mm, np.nan).astype(np.float32),
        np.where(valid, 40 + 200 * np.clip(shade, 0, 1), 0).astype(np.uint8),
    )


def _mix_silhouettes(depth: Array, valid: Mask, flying: float, rng: np.random.Generator) -> Array:
    """Pixels next to a jump in depth land anywhere between the two sides."""
    near = np.where(valid, depth, 1e9).astype(np.float32)
    far = np.where(valid, depth, -1e9).astype(np.float32)
    kernel = np.ones((3, 3), np.uint8)
    low, high = cv2.erode(near, kernel), cv2.dilate(far, kernel)
    rim = valid & ((high - low > 15.0) | (cv2.erode(valid.astype(np.uint8), kernel) == 0))
    chosen = rim & (rng.random(depth.shape) < flying * valid.sum() / max(rim.sum(), 1))
    reach = np.where(high - low > 15.0, np.minimum(high - low, 300.0), 60.0)
    return np.where(chosen, low + reach * rng.random(depth.shape), depth)
