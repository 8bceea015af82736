"""A format that bodyscan does not have: points and normals as text."""

from pathlib import Path

import numpy as np

from bodyscan.export.formats import BodyFormat
from bodyscan.files.atomic import write_text
from bodyscan.mesh.body import BodyCloud, BodyMesh


def write_xyz(path: Path, body: BodyCloud | BodyMesh) -> None:
    points = body.points if isinstance(body, BodyCloud) else body.vertices
    rows = np.column_stack([points, body.normals])
    write_text(path, "".join(f"{' '.join(f'{value:.3f}' for value in row)}\n" for row in rows))


FORMAT = BodyFormat(write_xyz, holds=frozenset({"mesh", "cloud", "normals"}))
