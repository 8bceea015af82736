"""Compare a scanned body with the simulated one: remaining sway, girths, stature, coverage."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import open3d as o3d

from bodyscan.arrays import Array, Indices, Mask
from bodyscan.evaluation.surface import find_covered_spots, sample_surface
from bodyscan.geometry.camera import camera_from_fields
from bodyscan.geometry.camera_tables import is_in_image
from bodyscan.geometry.robust import rms
from bodyscan.geometry.transforms import RigidTransform, fit_rigid_transform
from bodyscan.measurement.measurements import Measurements, measure
from bodyscan.mesh.body import BodyMesh

STEP_MM = 20.0
TORSO = (0.46, 0.80)  # of the stature: crotch to shoulders, where 1 mm of height is 9 of girth
WHOLE = 0.97  # of a girth measured, and not hair: what is filled is a declared guess


def compute_sway_residual(
    found: Mapping[str, RigidTransform], true_pairs: Mapping[str, Any], vertices: Array
) -> tuple[RigidTransform, float]:
    """What is left of calibration error and sway: `rig_from_still`, where the model has the true
    body, and the RMS over pairs and the body, along all axes, mm.

    found: rig_from_camera as the scan used it.
    true_pairs: `pairs` of truth.json.
    vertices: the true body.
    """
    body = vertices[:: max(1, len(vertices) // 500)]
    moved = []
    for name, pose in found.items():
        true = true_pairs[name]
        camera = RigidTransform.from_matrix(true["rig_from_camera"])
        swayed = RigidTransform.from_matrix(true["swayed_from_still"])
        moved.append((pose @ camera.inverse() @ swayed).apply(body))
    mean = np.mean(moved, axis=0)
    rms_mm = float(np.sqrt(np.mean(np.sum((np.array(moved) - mean) ** 2, axis=-1))))
    return fit_rigid_transform(body, mean), rms_mm


@dataclass(frozen=True)
class GirthErrors:
    """Tape girths of the trunk, mesh minus truth, in slices (`heights` many) where at least 97 % was
    measured and no arm touches, which makes a range: RMS, worst and its height; and the stature's."""

    heights: int
    rms_mm: float
    worst_mm: float
    worst_at_mm: float
    stature_mm: float


def measure_true_girths(vertices: Array, faces: Indices) -> Measurements:
    """Girths of the true trunk, every `STEP_MM`."""
    stature = float(vertices[:, 2].max())
    levels = np.arange(TORSO[0] * stature, TORSO[1] * stature, STEP_MM).tolist()
    count = len(vertices)
    normals, colours = np.zeros((count, 3), np.float32), np.zeros((count, 3), np.uint8)
    sigma_mm, filled = np.zeros(count, np.float32), np.zeros(len(faces), bool)
    return measure(BodyMesh(vertices, faces, normals, colours, sigma_mm, filled), levels)


def compute_girth_errors(
    mesh: BodyMesh, true: Measurements, *, mean_breath: bool = False
) -> GirthErrors:
    """Errors of a mesh in the frame of the truth, at mean breath or at the mesh's moment.

    true: see `measure_true_girths`.
    """
    ours = measure(mesh, [one.height_mm for one in true.slices], mean_breath=mean_breath)
    both = zip(ours.slices, true.slices, strict=True)
    errors = {}
    for one, other in both:
        found, wanted = one.find_girth("trunk"), other.find_girth("trunk")
        if found and wanted and found.measured_skin >= WHOLE and not found.touches:
            errors[one.height_mm] = found.tape_mm - wanted.tape_mm
    sizes = np.abs(list(errors.values())) if errors else np.array([np.nan])
    worst_at = list(errors)[int(np.argmax(sizes))] if errors else float("nan")
    stature_mm = ours.stature_mm - true.stature_mm
    return GirthErrors(len(errors), rms(sizes), float(sizes.max()), worst_at, stature_mm)


def measure_visible_coverage(
    points: Array, vertices: Array, faces: Indices, true_pairs: Mapping[str, Any]
) -> tuple[float, float]:
    """Measure the share of the truth that a camera and its projector see, and what covers of it.

    points: in the truth's frame; they cover what is within 1 mm along the normal.
    """
    spots, normals = sample_surface(vertices, faces, 60_000, seed=0)
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(vertices.astype(np.float32), faces.astype(np.uint32))
    visible = np.zeros(len(spots), bool)
    for pair in true_pairs.values():
        still_from_swayed = RigidTransform.from_matrix(pair["swayed_from_still"]).inverse()
        still_from_camera = still_from_swayed @ RigidTransform.from_matrix(pair["rig_from_camera"])
        camera = camera_from_fields(pair["camera"])
        inside = is_in_image(camera, still_from_camera.inverse().apply(spots))
        index = np.flatnonzero(inside & ~visible)
        for centre in (np.zeros(3), np.array(pair["projector"]["centre"])):
            eye = still_from_camera.apply(centre)
            index = index[_in_sight(scene, spots[index], normals[index], eye)]
        visible[index] = True
    covered = find_covered_spots(points, spots[visible], normals[visible])
    return float(visible.mean()), float(covered.mean())


def _in_sight(scene: Any, spots: Array, normals: Array, eye: Array) -> Mask:
    """Which spots face the eye with nothing in between, (N,)."""
    ray = eye - spots
    distance = np.linalg.norm(ray, axis=1)
    facing = np.sum(ray * normals, axis=1) > 0.17 * distance  # 80 degrees
    start = spots + 0.2 * normals  # clear of the surface itself
    rays = np.concatenate([start, eye - start], axis=1).astype(np.float32)
    hidden = scene.test_occlusions(o3d.core.Tensor(rays), tnear=0.0, tfar=1.0).numpy()
    return np.asarray(facing & ~hidden)
