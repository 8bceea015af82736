"""A stored scan as files for other programs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from bodyscan.errors import BadInput
from bodyscan.export.defacing import deface as without_face
from bodyscan.export.exporting import MESH_FORMATS, Origin, export
from bodyscan.export.neck import find_neck
from bodyscan.fusion.storage import StoredScan
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.measurement.body_frame import rig_from_body
from bodyscan.mesh.body import BodyMesh
from bodyscan.mesh.decimation import decimate
from bodyscan.settings import ExportSettings

FRAMES = ("rig", "body")

VERSIONS = {
    "full": ("body", lambda mesh: mesh),
    "light": ("body-light", decimate),
    "open": ("body-open", BodyMesh.measured_part),
}


def export_scan(
    scan: StoredScan,
    folder: Path,
    formats: Sequence[str],
    versions: Sequence[str] = ExportSettings().versions,
    *,
    deface: bool = False,
    frame: str = "rig",
) -> list[Path]:
    """Write the mesh in each format (ply, obj, stl, glb) and version; returns what was written.

    Versions: full, light (50,000 faces), open (without filled faces). Each file has a JSON beside
    it. deface: with a plain head instead of the subject's, below the neck as without. frame: rig, or
    body (origin under the body, x the way it faces). Raises BadInput for a format, version or frame
    that there is not, FailedWork where no neck is found.
    """
    suffixes = [f".{name.strip().lower().lstrip('.')}" for name in formats]
    asked = [(s, MESH_FORMATS) for s in suffixes] + [(v, VERSIONS) for v in versions]
    for name, known in [*asked, (frame, FRAMES)]:
        if name not in known:
            raise BadInput(
                f"there is no {name.lstrip('.')!r} to export",
                remedy=f"Choose from {', '.join(k.lstrip('.') for k in known)}.",
            )
    placing = rig_from_body(scan.mesh.vertices) if frame == "body" else None
    origin = Origin(
        scan.facts.get("subject"),
        scan.facts["calibration_id"],
        deface,
        found_by_scan(scan.facts),
        placing,
    )
    neck = find_neck(scan.mesh.vertices, scan.mesh.faces) if deface else None
    written = []
    for version in versions:
        stem, made = VERSIONS[version]
        mesh = made(scan.mesh) if neck is None else without_face(made(scan.mesh), neck)
        if placing is not None:
            mesh = carried(mesh, placing.inverse())
        for suffix in suffixes:
            written.append(folder / f"{stem}{suffix}")
            export(written[-1], mesh, origin)
    return written


def found_by_scan(facts: Mapping[str, Any]) -> dict[str, Any]:
    """What an export repeats of scan.json: the verdict, pairs left out, the subject's sway (mm)."""
    alignment = facts.get("alignment")
    return {
        "when": facts.get("when"),
        "verdict": facts.get("verdict"),
        "left_out": facts.get("failed", {}),
        "sway_mm": alignment["motion_mm"] if alignment else None,
    }


def carried(mesh: BodyMesh, a_from_b: RigidTransform) -> BodyMesh:
    """A mesh given in b, in a."""
    return replace(
        mesh,
        vertices=a_from_b.apply(mesh.vertices),
        normals=a_from_b.rotate(mesh.normals.astype(np.float64)).astype(np.float32),
    )
