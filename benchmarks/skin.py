"""Skin, hair and dark cloth: labels, coverage and errors (synthetic).

At half size, the woman alone, standing still; the rig is calibrated by `calibration_from_truth`.
Renderings are kept in bench/skin: two minutes each on an idle core.
"""

from __future__ import annotations

import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import open3d as o3d
from scipy.spatial import cKDTree

from benchmarks.full_size import PROJECT, run_commands
from benchmarks.true_calibration import calibration_from_truth
from bodyscan.arrays import Array, Indices, Mask
from bodyscan.captures.folder import open_scan
from bodyscan.evaluation.body import compute_sway_residual
from bodyscan.evaluation.surface import compute_signed_distances
from bodyscan.fusion.storage import Scan
from bodyscan.geometry.camera import camera_from_fields
from bodyscan.geometry.robust import estimate_robust_scale, rms
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.mesh.body import DARK_CLOTH, HAIR, REGION_NAMES, SKIN, compute_region_shares
from bodyscan.mesh.topology import compute_vertex_normals
from bodyscan.registration.rig_calibration import RigCalibration
from bodyscan.settings import ScanSettings
from bodyscan.simulation.body import mask_hair, mask_shorts
from bodyscan.workflows.evaluate import Truth, load_truth
from bodyscan.workflows.range_images import reconstruct_range_images
from bodyscan.workflows.scan_person import fuse

FOLDER = PROJECT / "bench" / "skin"
LONGER = 6
"""Ratio of the second exposure to the first."""
LOOKS: dict[str, Sequence[object]] = {
    "matt": ["--look", "matt"],
    "skin": ["--look", "skin"],
    "dressed": ["--look", "dressed"],
    "dressed-long": ["--look", "dressed", "--set", f"lighting.person_grey={230 * LONGER}"]
    + ["--set", "lighting.longest=100"],
}
REACH_MM, LIFT_MM = 4.0, 1.0
"""A place is covered by a point this near; hair is this rough, and does not hide itself."""
FLATTEST = 0.17  # cosine of 80 degrees: surfaces at a flatter angle are not measured


@dataclass(frozen=True, eq=False)
class Case:
    """A scan and the truth about its subject."""

    scan: Scan
    truth: Truth


def report() -> str:
    """The section of docs/results.md."""
    for name, look in LOOKS.items():
        _simulate(name, look)
    matt, skin, dressed = (_scanned(name) for name in ("matt", "skin", "dressed"))
    both = _with_two_exposures()
    cases = {"matt": matt, "skin": skin, "skin, hair and shorts": dressed}
    cases["the same, two exposures"] = both
    clothed = {"one": dressed, f"two, {LONGER} times apart": both}
    return f"""## Skin, hair and dark cloth (synthetic)

`rigs/three-pole-12.yaml` at half size, workshop devices, calibrated by its truth off by what boards
leave open; the woman stands still. The cloud against the truth:

| subject | bias, RMS, 95 % mm | error over sigma | verdict |
|---|---|---|---|
{chr(10).join(_light_row(name, case) for name, case in cases.items())}

Regions of points against the nearest vertex of the truth (3 mm apart), what of the surface that two
pairs see has a point within {REACH_MM:g} mm, and the errors of points that are truly of that region:

| exposures | region | precision | recall | covered | RMS mm | error over sigma |
|---|---|---|---|---|---|---|
{chr(10).join(row for name, case in clothed.items() for row in _region_rows(name, case))}

Of the matt subject {_shares(matt)}.
"""


def _simulate(name: str, look: Sequence[object]) -> None:
    made: list[object] = [PROJECT / "rigs" / "three-pole-12.yaml", "--out", FOLDER / name]
    made += ["--scale", 0.5, "--subject", PROJECT / "data" / "subjects" / "woman_average.ply"]
    made += ["--subject-preset", "mannequin", "--board-shots", 0, *look]
    run_commands({"simulate": [*made, "--set", "projection.smile_stripes=0"]}, FOLDER / name)


def _scanned(name: str) -> Case:
    calibration = calibration_from_truth(FOLDER / name)
    person = FOLDER / name / "captures" / "person"
    return Case(_scan(calibration, person), load_truth(FOLDER / name / "truth"))


def _with_two_exposures() -> Case:
    """A scan with two exposures of the same moment; the images differ only in exposure."""
    folder = FOLDER / "dressed-two"
    shutil.rmtree(folder, ignore_errors=True)
    for name, exposure in (("dressed", "short"), ("dressed-long", "long")):
        person = FOLDER / name / "captures" / "person"
        for image in person.glob("*/*/*.png"):
            to = folder / image.relative_to(person).with_name(f"{exposure}-{image.name}")
            to.parent.mkdir(parents=True, exist_ok=True)
            to.hardlink_to(image)
        shutil.copy(person / "captures.yaml", folder)
    calibration = calibration_from_truth(FOLDER / "dressed")
    files = {"exposures": ("short", "long"), "files": "{shot}/{pair}/{exposure}-{frame}.png"}
    rig = calibration.rig.model_copy(update=files)
    scan = _scan(replace(calibration, rig=rig), folder)
    return Case(scan, load_truth(FOLDER / "dressed" / "truth"))


def _scan(calibration: RigCalibration, person: Path) -> Scan:
    images = reconstruct_range_images(calibration, open_scan(calibration.rig, person))
    return fuse(calibration, images, ScanSettings())


def _light_row(name: str, case: Case) -> str:
    scan, off = case.scan, _errors(case)
    sigmas = estimate_robust_scale(off / scan.cloud.sigma_mm)
    size = f"{off.mean():.3f}, {rms(off):.3f}, {np.percentile(np.abs(off), 95):.3f}"
    return f"| {name} | {size} | {sigmas:.2f} | {scan.verdict.grade} |"


def _region_rows(name: str, case: Case) -> list[str]:
    (vertices, faces), off = _surface(case.truth), _errors(case)
    true = np.where(mask_shorts(vertices), DARK_CLOTH, SKIN)
    true[mask_hair(vertices)] = HAIR
    laid = _laid(case)
    of_points = true[cKDTree(vertices).query(laid)[1]]
    seen = _seen_by_two(vertices, faces, case.truth.facts["pairs"])
    near = np.isfinite(cKDTree(laid).query(vertices, distance_upper_bound=REACH_MM)[0])
    regions = case.scan.cloud.regions
    assert regions is not None
    rows = []
    for kind in (HAIR, DARK_CLOTH, SKIN):
        precision = np.mean(of_points[regions == kind] == kind)
        recall = np.mean(regions[of_points == kind] == kind)
        covered = np.mean(near[seen & (true == kind)])
        own = of_points == kind
        sigmas = estimate_robust_scale(off[own] / case.scan.cloud.sigma_mm[own])
        figures = f"{precision:.4f} | {recall:.4f} | {100.0 * covered:.1f} %"
        figures += f" | {rms(off[own]):.3f} | {sigmas:.2f}"
        rows.append(f"| {name} | {REGION_NAMES[kind]} | {figures} |")
    return rows


def _shares(case: Case) -> str:
    assert case.scan.cloud.regions is not None
    found = compute_region_shares(case.scan.cloud.regions)
    return ", ".join(f"{100.0 * part:.2f} % are {name}" for name, part in found.items())


def _surface(truth: Truth) -> tuple[Array, Indices]:
    assert truth.vertices is not None
    assert truth.faces is not None
    return truth.vertices, truth.faces


def _errors(case: Case) -> Array:
    """How far the cloud's points lie off the truth, (N,) mm."""
    return compute_signed_distances(_laid(case), *_surface(case.truth))


def _laid(case: Case) -> Array:
    """The cloud's points moved to where the truth stands."""
    vertices, _ = _surface(case.truth)
    rig_from_still, _ = compute_sway_residual(
        case.scan.rig_from_camera, case.truth.facts["pairs"], vertices
    )
    return rig_from_still.inverse().apply(case.scan.cloud.points)


def _seen_by_two(vertices: Array, faces: Indices, pairs: Mapping[str, Any]) -> Mask:
    """Vertices (V,) that the camera and projector of at least two pairs face."""
    normals = compute_vertex_normals(vertices, faces).astype(float)
    scene, count = o3d.t.geometry.RaycastingScene(), np.zeros(len(vertices), int)
    scene.add_triangles(vertices.astype(np.float32), faces.astype(np.uint32))
    start = vertices + LIFT_MM * normals
    for pair in pairs.values():
        at, camera = (
            RigidTransform.from_matrix(pair["rig_from_camera"]),
            camera_from_fields(pair["camera"]),
        )
        u, v = camera.project(at.inverse().apply(vertices)).T
        seen = (u > 0) & (u < camera.width - 1) & (v > 0) & (v < camera.height - 1)
        for eye in at.apply(np.array([np.zeros(3), pair["projector"]["centre"]])):
            way = eye - start
            facing = np.sum(way * normals, axis=1) > FLATTEST * np.linalg.norm(way, axis=1)
            rays = o3d.core.Tensor(np.concatenate([start, way], axis=1).astype(np.float32))
            seen &= facing & ~scene.test_occlusions(rays, tnear=0.0, tfar=1.0).numpy()
        count += seen
    return np.asarray(count >= 2)
