"""A stored scan as files for other programs."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from bodyscan.errors import BadInput
from bodyscan.export.exporting import MESH_FORMATS, Origin, export
from bodyscan.fusion.storage import StoredScan
from bodyscan.fusion.versions import light, measured_only

VERSIONS = {
    "full": ("body", lambda mesh: mesh),
    "light": ("body-light", light),
    "open": ("body-open", measured_only),
}


def export_scan(
    scan: StoredScan,
    folder: Path,
    formats: Sequence[str],
    versions: Sequence[str] = ("full", "light"),
) -> list[Path]:
    """Write the mesh in each format (ply, obj, stl, glb) and version; returns what was written.

    Versions: full, light (50,000 faces), open (without filled faces). Each file has a JSON beside
    it. Raises BadInput for a format or version that there is not.
    """
    suffixes = [f".{name.strip().lower().lstrip('.')}" for name in formats]
    for name, known in [(s, MESH_FORMATS) for s in suffixes] + [(v, VERSIONS) for v in versions]:
        if name not in known:
            raise BadInput(
                f"there is no {name.lstrip('.')!r} to export",
                remedy=f"Choose from {', '.join(k.lstrip('.') for k in known)}.",
            )
    origin = Origin(scan.facts.get("subject"), scan.facts["calibration_id"])
    written = []
    for version in versions:
        stem, made = VERSIONS[version]
        mesh = made(scan.mesh)
        for suffix in suffixes:
            written.append(folder / f"{stem}{suffix}")
            export(written[-1], mesh, origin)
    return written
