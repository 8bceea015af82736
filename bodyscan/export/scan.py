"""A stored scan as files for other programs."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from bodyscan.errors import BadInput
from bodyscan.export.body_file import Provenance, write_body
from bodyscan.export.defacing import deface as replace_head
from bodyscan.export.defacing import find_neck
from bodyscan.export.formats import BODY_FORMATS
from bodyscan.files.model import did_you_mean
from bodyscan.fusion.storage import StoredScan
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.mesh.body import BodyMesh
from bodyscan.mesh.body_parts import find_body_frame
from bodyscan.mesh.repair import decimate
from bodyscan.settings import ExportSettings

VERSIONS: dict[str, tuple[str, Callable[[BodyMesh], BodyMesh]]] = {
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
    """Write the mesh in each format (see `BODY_FORMATS`) and version; returns the paths.

    versions: full, light (50,000 faces), open (without filled faces). Each file has a JSON beside
        it.
    deface: replace the subject's head by a plain one; below the neck nothing changes. The JSON then
        has neither pseudonym nor date.
    frame: rig, or body (origin under the body, x the way it faces).

    Raises BadInput for an unknown format, version or frame, FailedWork if no neck is found.
    """
    names = [name.strip().lower().removeprefix(".") for name in formats]
    for name in names:
        BODY_FORMATS.find(name)
    for name, known in [*((version, VERSIONS) for version in versions), (frame, ("rig", "body"))]:
        if name not in known:
            what = f"there is no {name!r} to export{did_you_mean(name, known)}"
            raise BadInput(what, remedy=f"Choose from {', '.join(known)}.")
    pose = find_body_frame(scan.mesh.vertices).rig_from_body if frame == "body" else None
    subject, identity = scan.facts.get("subject"), scan.facts["calibration_id"]
    origin = Provenance(subject, identity, deface, scan_facts(scan.facts), pose)
    if deface:
        origin = replace(origin, subject=None, found=_without_person(origin.found))
    neck = find_neck(scan.mesh.vertices, scan.mesh.faces) if deface else None
    written = []
    for version in versions:
        stem, convert = VERSIONS[version]
        mesh = convert(scan.mesh)
        if neck is not None:
            mesh = replace_head(mesh, neck)
        if pose is not None:
            mesh = transform_mesh(mesh, pose.inverse())
        for name in names:
            written.append(folder / f"{stem}.{name}")
            write_body(written[-1], mesh, origin)
    return written


def scan_facts(facts: Mapping[str, Any]) -> dict[str, Any]:
    """Select what an export repeats from scan.json: verdict, pairs left out, sway (mm)."""
    alignment = facts.get("alignment")
    return {
        "when": facts.get("when"),
        "verdict": facts.get("verdict"),
        "left_out": facts.get("failed", {}),
        "sway_mm": alignment["motion_mm"] if alignment else None,
    }


def _without_person(found: Mapping[str, Any]) -> dict[str, Any]:
    """What a file for sharing may say: no date, and no sentence, which may name a folder."""
    grade = (found["verdict"] or {}).get("grade")
    shared = {
        "verdict": grade and {"grade": grade},
        "left_out": dict.fromkeys(found["left_out"], ""),
    }
    return {"when": None, "sway_mm": found["sway_mm"], **shared}


def transform_mesh(mesh: BodyMesh, a_from_b: RigidTransform) -> BodyMesh:
    """Transform a mesh from frame b to frame a."""
    normals = a_from_b.rotate(mesh.normals.astype(np.float64)).astype(np.float32)
    return replace(mesh, vertices=a_from_b.apply(mesh.vertices), normals=normals)
