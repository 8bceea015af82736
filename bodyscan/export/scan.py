"""A stored scan as files for other programs."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from bodyscan.arrays import Array
from bodyscan.body_model.registered import register_body
from bodyscan.body_model.skinned import SkinnedBody, make_skinned
from bodyscan.body_model.template import load_template
from bodyscan.errors import BadInput
from bodyscan.export.body_file import Provenance, write_body
from bodyscan.export.defacing import Neck, find_neck
from bodyscan.export.defacing import deface as replace_head
from bodyscan.export.formats import BODY_FORMATS
from bodyscan.export.texture import Texture, make_texture
from bodyscan.files.model import did_you_mean
from bodyscan.fusion.storage import StoredScan
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.measurement.landmarks import find_landmarks
from bodyscan.mesh.body import BodyMesh
from bodyscan.mesh.body_frame import find_body_frame
from bodyscan.mesh.repair import collapse_slivers, decimate
from bodyscan.settings import ExportSettings

VERSIONS: dict[str, tuple[str, Callable[[BodyMesh], BodyMesh]]] = {
    "full": ("body", lambda mesh: mesh),
    "light": ("body-light", decimate),
    "open": ("body-open", BodyMesh.measured_part),
    "textured": ("body-textured", decimate),
}


def export_scan(
    scan: StoredScan,
    folder: Path,
    formats: Sequence[str],
    versions: Sequence[str] = ExportSettings().versions,
    *,
    texture_px: int = ExportSettings().texture_px,
    deface: bool = False,
    frame: str = "rig",
    up: str = "z",
    made: Callable[[Path], object] = lambda path: None,
) -> list[Path]:
    """Write the mesh in each format (see `BODY_FORMATS`) and version; `made` is told each path.

    versions: full, light (50,000 faces), open (without filled faces), registered (a parametric body
        laid over the scan), textured (light, with an image of `texture_px` a side instead of vertex
        colours, in formats that hold it; then registered has one too). Each has a JSON beside it.
    deface: replace the subject's head by a plain one; below the neck nothing changes. The JSON then
        has neither pseudonym nor date.
    frame: rig, or body (origin under the body, x the way it faces).
    up: the axis that points up, z or y; in GLB always y.

    Raises BadInput for an unknown format, version, frame or axis, for a registered body that shows a
    face or fits nobody; FailedWork if no neck is found.
    """
    names = [name.strip().lower().removeprefix(".") for name in formats]
    able = [name for name in names if "texture" in BODY_FORMATS.find(name).holds]
    known = [(version, (*VERSIONS, "registered")) for version in versions]
    _require_known(*known, (frame, ("rig", "body")), (up, ("z", "y")))
    if "textured" in versions and not able:
        raise BadInput(f"{', '.join(names)} holds no texture", remedy="Add `glb` or `obj`.")
    if deface and "registered" in versions:
        remedy = "Leave out one of `registered` and `deface`."
        raise BadInput("a registered body shows the face, which is to be removed", remedy=remedy)
    pose = find_body_frame(scan.mesh.vertices).rig_from_body if frame == "body" else None
    subject, identity = None if deface else scan.facts.get("subject"), scan.facts["calibration_id"]
    origin = Provenance(subject, identity, deface, _find_facts(scan.facts, deface), pose, up)
    neck = find_neck(scan.mesh.vertices, scan.mesh.faces) if deface else None
    written = []
    for version in versions:
        body: BodyMesh | SkinnedBody
        texture = None
        if version == "registered":
            stem, body = "body-registered", _register(scan.mesh, pose)
            rest = load_template().vertices
            if "textured" in versions:
                texture = _make_texture(scan, body.mesh, neck, pose, texture_px, rest)
        else:
            stem, convert = VERSIONS[version]
            body = convert(scan.mesh)
            body = body if neck is None else replace_head(body, neck)
            body = body if pose is None else transform_mesh(body, pose.inverse())
            if version == "textured":
                body = collapse_slivers(body)
                texture = _make_texture(scan, body, neck, pose, texture_px, body.vertices)
        for name in able if version == "textured" else names:
            written.append(folder / f"{stem}.{name}")
            write_body(written[-1], body, origin, texture if name in able else None)
            made(written[-1])
    return written


def _require_known(*choices: tuple[str, Sequence[str]]) -> None:
    """Raise BadInput for a name that is none of those beside it."""
    for name, known in choices:
        if name not in known:
            what = f"there is no {name!r} to export{did_you_mean(name, known)}"
            raise BadInput(what, remedy=f"Choose from {', '.join(known)}.")


def _make_texture(
    scan: StoredScan,
    mesh: BodyMesh,
    neck: Neck | None,
    rig_from_frame: RigidTransform | None,
    size: int,
    rest: Array,
) -> Texture:
    """Make a texture of the colours of a scan's points for a mesh in another frame than the rig's.

    neck: of a mesh without its face. rest: see `make_texture`.
    """
    points, colours = scan.cloud.points, scan.cloud.colours
    if neck is not None:  # the points show the face
        shown = replace_head(scan.mesh, neck)
        points, colours = shown.vertices, shown.colours
    points = points if rig_from_frame is None else rig_from_frame.inverse().apply(points)
    return make_texture(mesh.vertices, mesh.faces, points, colours, size, rest=rest)


def _register(mesh: BodyMesh, rig_from_frame: RigidTransform | None) -> SkinnedBody:
    """Lay the parametric body over a scan's mesh, with its landmarks."""
    registered = register_body(mesh)
    landmarks = [one for one in find_landmarks(registered).values() if one.found != "unseen"]
    carried = [(one.name, np.array(one.position_mm), one.sigma_mm, one.found) for one in landmarks]
    frame = RigidTransform.identity() if rig_from_frame is None else rig_from_frame.inverse()
    return make_skinned(registered, carried, frame)


def _find_facts(facts: Mapping[str, Any], shared: bool) -> dict[str, Any]:
    """Select what an export repeats from scan.json: verdict, pairs left out, sway (mm).

    shared: without date, and without sentences, which may name a folder.
    """
    verdict, left_out = facts.get("verdict"), facts.get("failed", {})
    if shared:
        grade = (verdict or {}).get("grade")
        verdict, left_out = grade and {"grade": grade}, dict.fromkeys(left_out, "")
    return {
        "when": None if shared else facts.get("when"),
        "verdict": verdict,
        "left_out": left_out,
        "sway_mm": (facts.get("alignment") or {}).get("motion_mm"),
    }


def transform_mesh(mesh: BodyMesh, a_from_b: RigidTransform) -> BodyMesh:
    """Transform a mesh from frame b to frame a."""
    normals = a_from_b.rotate(mesh.normals.astype(np.float64)).astype(np.float32)
    return replace(mesh, vertices=a_from_b.apply(mesh.vertices), normals=normals)
