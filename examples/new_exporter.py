"""A new export format, OFF, in one file: `python examples/new_exporter.py SCAN OUT`.

Put into bodyscan/export/formats as off.py it becomes a format for `bodyscan export --format off`,
for pipelines and for Python. Here it is registered from outside.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

import bodyscan
from bodyscan.export.formats import BODY_FORMATS, BodyFormat
from bodyscan.files.atomic import write_text


def write_off(path: Path, mesh: bodyscan.BodyMesh) -> None:
    """Write Geomview's Object File Format: counts, vertices (mm), then the corners of each face."""
    corners = np.insert(mesh.faces, 0, 3, axis=1)
    lines = [
        "OFF",
        f"{len(mesh.vertices)} {len(mesh.faces)} 0",
        *(f"{x:.4f} {y:.4f} {z:.4f}" for x, y, z in mesh.vertices.tolist()),
        *(" ".join(map(str, row)) for row in corners.tolist()),
    ]
    write_text(path, "\n".join(lines) + "\n")


FORMAT = BodyFormat(write_off, holds=frozenset({"mesh"}))


def main(scan: Path, out: Path) -> None:
    """Export a stored scan in the new format, with a JSON beside it as with every export."""
    BODY_FORMATS.register("off", FORMAT)
    chosen = bodyscan.ExportSettings(formats=("off",), versions=("full",))
    for path in bodyscan.export_scan(bodyscan.load_scan(scan), out, chosen):
        print(f"written: {path}")


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
