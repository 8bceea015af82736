"""One body to one file, with a JSON beside it that says what the file holds."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from bodyscan import __version__
from bodyscan.errors import BadInput
from bodyscan.export.glb import write_glb
from bodyscan.export.obj import write_obj
from bodyscan.export.ply import write_ply
from bodyscan.export.stl import write_stl
from bodyscan.files import write_json
from bodyscan.fusion.body import BodyCloud, BodyMesh

CLOUD_FORMATS = (".ply", ".glb")
MESH_FORMATS = (".ply", ".obj", ".stl", ".glb")


@dataclass(frozen=True)
class Origin:
    """What a body was made from: the subject's pseudonym (if any) and the calibration."""

    subject: str | None
    calibration_id: str


def export(path: Path, body: BodyCloud | BodyMesh, origin: Origin) -> None:
    """Write `body` in the format that `path`'s suffix names, and `<path>.json` beside it.

    Raises BadInput for a suffix that is no format of ours, or none for a cloud.
    """
    path = Path(path)
    suffix, is_cloud = path.suffix.lower(), isinstance(body, BodyCloud)
    formats = CLOUD_FORMATS if is_cloud else MESH_FORMATS
    if suffix not in formats:
        what = "a cloud" if is_cloud else "a mesh"
        raise BadInput(
            f"{what} cannot be written as {suffix or 'a file without suffix'!r}",
            where=str(path),
            remedy=f"Choose one of {', '.join(formats)}.",
        )
    if suffix == ".ply":
        write_ply(path, body)
    elif suffix == ".glb":
        write_glb(path, body)
    elif isinstance(body, BodyMesh):
        {".obj": write_obj, ".stl": write_stl}[suffix](path, body)
    write_json(path.with_name(f"{path.name}.json"), description(path, body, origin))


def description(path: Path, body: BodyCloud | BodyMesh, origin: Origin) -> dict[str, Any]:
    """What the JSON beside an export says."""
    metres = path.suffix.lower() == ".glb"
    axes = {"x": "front", "y": "left", "z": "up"}
    said: dict[str, Any] = {
        "file": path.name,
        "units": "m" if metres else "mm",
        "axes": {"x": "left", "y": "up", "z": "front"} if metres else axes,
        "origin": "on the floor, at the rig's centre",
        "software": f"bodyscan {__version__}",
        "subject": origin.subject,
        "calibration_id": origin.calibration_id,
        "kind": "cloud" if isinstance(body, BodyCloud) else "mesh",
    }
    if isinstance(body, BodyCloud):
        return said | {"points": len(body.points), "sigma_mm": _middle(body.sigma_mm)}
    return said | {
        "vertices": len(body.vertices),
        "faces": len(body.faces),
        "filled_faces": int(np.count_nonzero(body.filled)),
        "sigma_mm": _middle(body.sigma_mm),
    }


def _middle(sigma_mm: np.ndarray[Any, Any]) -> float | None:
    """The median, None if nothing was measured."""
    known = sigma_mm[np.isfinite(sigma_mm)]
    return float(np.median(known)) if known.size else None
