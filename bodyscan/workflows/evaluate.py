"""Compare a simulated workspace's calibration, cloud and mesh with the truth beside it."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import open3d as o3d

from bodyscan.arrays import Array, Floats, Indices
from bodyscan.errors import BadInput
from bodyscan.evaluation.body import (
    GirthErrors,
    compute_girth_errors,
    compute_sway_residual,
    measure_true_girths,
    measure_visible_coverage,
)
from bodyscan.evaluation.surface import (
    Deviation,
    compute_signed_distances,
    fit_to_surface,
    normalize_errors,
    summarize_deviation,
)
from bodyscan.export.scan import transform_mesh
from bodyscan.fusion.storage import StoredScan, load_scan
from bodyscan.geometry.robust import compute_rms_length, rms
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.geometry.uncertainty import compute_position_sigma
from bodyscan.mesh.body import BodyMesh
from bodyscan.mesh.topology import compute_topology
from bodyscan.optional import optional
from bodyscan.registration.rig_calibration import RigCalibration
from bodyscan.registration.storage import load_calibration

BodyAt = Callable[[float], Array]


@dataclass(frozen=True, eq=False)
class RigDeviation:
    """Errors of each pair against the truth, in the rig frame as defined, without any alignment."""

    names: tuple[str, ...]
    centres_mm: Array  # errors of the camera centres, (P, 3)
    rotations_deg: Array  # (P,)
    sigmas_mm: Array  # reported sigmas of the centres, (P, 3)


@dataclass(frozen=True, eq=False)
class Truth:
    """The simulator's truth."""

    facts: dict[str, Any]  # content of truth.json
    # vertices, faces: the subject's surface, mm, rig frame; for a moving subject, at mid-scan.
    vertices: Array | None
    faces: Indices | None
    at_mean_breath: Array | None = None  # vertices of a moving subject at mean breath


def load_truth(folder: Path) -> Truth:
    """Read `truth/`. Raises BadInput if there is none, as for real captures."""
    try:
        facts = json.loads((folder / "truth.json").read_text("utf-8"))
    except (OSError, ValueError) as error:
        raise BadInput(
            f"truth.json cannot be read: {error}",
            where=str(folder),
            remedy="only workspaces made by `bodyscan simulate` can be compared with the truth",
        ) from error
    surface = folder / "subject.ply"
    if not surface.exists():
        return Truth(facts, None, None)
    mesh = o3d.io.read_triangle_mesh(str(surface))
    faces = np.asarray(mesh.triangles).astype(np.int64)
    path, mean_breath = folder / "subject-mean-breath.ply", None
    if path.exists():
        mean_breath = np.asarray(o3d.io.read_triangle_mesh(str(path)).vertices)
    return Truth(facts, np.asarray(mesh.vertices), faces, mean_breath)


def compare_rig(calibration: RigCalibration, truth: Truth) -> RigDeviation:
    """Compare camera poses with the truth. Raises BadInput for a rig the truth does not know."""
    names = tuple(sorted(calibration.rig_from_camera))
    unknown = [name for name in names if name not in truth.facts["pairs"]]
    if unknown:
        raise BadInput(
            f"the truth has no pair {', '.join(unknown)}",
            where=f"calibration of rig {calibration.rig.name}",
            remedy="calibrate the rig file that `bodyscan simulate` wrote into this workspace",
        )
    centres, rotations, sigmas = [], [], []
    for name in names:
        found = calibration.rig_from_camera[name]
        true = RigidTransform.from_matrix(truth.facts["pairs"][name]["rig_from_camera"])
        centres.append(found.translation - true.translation)
        rotations.append(np.degrees((found.inverse() @ true).angle))
        sigmas.append(compute_position_sigma(calibration.covariance, name, found.translation))
    return RigDeviation(names, np.array(centres), np.array(rotations), np.array(sigmas))


def evaluate_workspace(workspace: Path, body_at: BodyAt | None = None) -> str:
    """Compare a workspace with its truth; return a text of all figures.

    body_at: vertices of a moving subject's true surface at a moment, ms since the scan began; a
        scan that lacks some pairs stands for another moment than mid-scan.

    Raises BadInput without a truth, CalibrationFileError, ResultError; a figure that cannot be
    computed is a line that says so.
    """
    truth = load_truth(workspace / "truth")
    calibration = load_calibration(workspace / "calibration")
    rig = compare_rig(calibration, truth)
    lines = [
        "against the truth (synthetic):",
        f"  camera centres          {compute_rms_length(rig.centres_mm):.3f} mm RMS, rotations "
        f"{rms(rig.rotations_deg):.4f} degrees RMS, {len(rig.names)} pairs",
    ]
    folder = workspace / "scan"
    if not (folder / "scan.json").exists() or truth.vertices is None or truth.faces is None:
        return "\n".join([*lines, "  no scan to compare yet"])
    stored = load_scan(folder)
    moment_ms = (stored.facts.get("person") or {}).get("moment_ms")
    if body_at is not None and moment_ms is not None:
        truth = replace(truth, vertices=body_at(moment_ms))
    lines += _scan_lines(stored, calibration, truth)
    return "\n".join(lines)


def _scan_lines(stored: StoredScan, calibration: RigCalibration, truth: Truth) -> list[str]:
    """Lines with the figures of a scan."""
    assert truth.vertices is not None
    assert truth.faces is not None
    surface, pairs = (truth.vertices, truth.faces), truth.facts["pairs"]
    _, sway_mm = compute_sway_residual(
        _read_aligned_poses(stored, calibration), pairs, truth.vertices
    )
    still_from_rig = RigidTransform.identity()
    if "motion" in truth.facts:  # fit to the body as it was then
        still_from_rig = fit_to_surface(stored.cloud.points, *surface)
    in_rig, body = stored.mesh, transform_mesh(stored.mesh, still_from_rig)
    points = still_from_rig.apply(stored.cloud.points)
    cloud = compute_signed_distances(points, *surface)
    measured = np.unique(body.faces[~body.filled])
    mesh = compute_signed_distances(body.vertices[measured], *surface)
    lines: list[str] = []

    def part(what: str) -> AbstractContextManager[None]:
        return optional(what, lambda line: lines.append(f"  {line}"))

    with part("cloud"):
        lines += _describe_cloud(cloud, stored.cloud.sigma_mm)
    with part("mesh"):
        lines += _describe_mesh(mesh, in_rig)
    with part("torso girths"):
        girths = compute_girth_errors(body, measure_true_girths(*surface))
        lines.append(f"  torso girths (tape)     {_format_girths(girths)}")
    if truth.at_mean_breath is not None:
        with part("torso girths at mean breath"):
            true = measure_true_girths(truth.at_mean_breath, truth.faces)
            girths = compute_girth_errors(body, true, mean_breath=True)
            lines.append(f"  ... against mean breath {_format_girths(girths)}")
    with part("coverage"):
        visible, covered = measure_visible_coverage(points, *surface, pairs)
        lines.append(
            f"  covered within 1 mm     {100.0 * covered:.1f} % of the {100.0 * visible:.1f} % of "
            "the surface that a camera and its projector see"
        )
    lines.append(f"  pairs to each other     {sway_mm:.3f} mm RMS over the body, along and across")
    return lines


def _describe_cloud(signed_mm: Array, sigma_mm: Floats) -> Iterator[str]:
    scale, beyond = normalize_errors(signed_mm, sigma_mm)
    yield f"  cloud, {len(signed_mm):,} points   {_format_figures(summarize_deviation(signed_mm))}"
    yield (
        f"  error over sigma        {scale:.2f} (robust; 1 is right), {100.0 * beyond:.2f} % "
        "of the points beyond three sigmas"
    )


def _describe_mesh(signed_mm: Array, mesh: BodyMesh) -> Iterator[str]:
    yield f"  mesh, measured vertices {_format_figures(summarize_deviation(signed_mm))}"
    shape = compute_topology(mesh.vertices, mesh.faces)
    yield (
        f"  mesh: {'closed' if shape.closed else 'open'}, "
        f"{'manifold' if shape.manifold else 'not manifold'}, {shape.components} piece(s), "
        f"{'outward' if shape.volume_mm3 > 0 else 'inward'} faces, "
        f"{shape.volume_mm3 / 1e6:.2f} litres"
    )


def _read_aligned_poses(
    stored: StoredScan, calibration: RigCalibration
) -> dict[str, RigidTransform]:
    """rig_from_camera of the pairs in the scan, as aligned if they were."""
    measured = [name for name, points in stored.facts["measured"].items() if points]
    alignment = stored.facts["alignment"]
    if alignment is None:
        return {name: calibration.rig_from_camera[name] for name in measured}
    return {
        name: RigidTransform.from_matrix(alignment["rig_from_camera"][name]) for name in measured
    }


def _format_girths(girths: GirthErrors) -> str:
    return (
        f"RMS {girths.rms_mm:.2f}, worst {girths.worst_mm:.2f} mm at {girths.worst_at_mm:.0f} mm, "
        f"{girths.heights} heights; stature {girths.stature_mm:+z.2f} mm"
    )


def _format_figures(d: Deviation) -> str:
    return (
        f"bias {d.bias_mm:+z.3f}, median {d.median_mm:.3f}, RMS {d.rms_mm:.3f}, "
        f"95 % {d.p95_mm:.3f}, worst {d.worst_mm:.2f} mm"
    )
