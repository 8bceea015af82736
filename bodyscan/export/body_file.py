"""One body in one file, with a JSON beside it that describes it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from bodyscan.arrays import Array
from bodyscan.body_model.skinned import SkinnedBody
from bodyscan.export.formats import BODY_FORMATS, BodyFormat
from bodyscan.export.texture import Texture
from bodyscan.files.atomic import write_json
from bodyscan.files.registry import make_unknown_format_error
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.mesh.body import REGION_NAMES, BodyCloud, BodyMesh
from bodyscan.mesh.repair import collapse_slivers
from bodyscan.mesh.topology import compute_face_areas
from bodyscan.version import __version__


@dataclass(frozen=True)
class Provenance:
    """What a body was made from.

    subject: its pseudonym, if any.
    defaced: the head was replaced by a plain one.
    found: the scan's findings (verdict, sway, pairs left out).
    rig_from_body: the pose of the body frame, if the body is given in that.
    up: z, or y (x to the subject's left) for programs that expect it; formats whose standard names
        the axes have those.
    """

    subject: str | None
    calibration_id: str
    defaced: bool = False
    found: Mapping[str, Any] = field(default_factory=dict)
    rig_from_body: RigidTransform | None = None
    up: str = "z"


def write_body(
    path: Path,
    body: BodyCloud | BodyMesh | SkinnedBody,
    origin: Provenance,
    texture: Texture | None = None,
) -> None:
    """Write `body` in the format that `path`'s suffix names, and `<path>.json` beside it.

    A mesh is written without its faces of zero area, unless it has a texture; a registered body has
    all of them. Raises BadInput for a suffix that is not that of a format, or of one that cannot hold
    a cloud.
    """
    path = Path(path)
    kind = "cloud" if isinstance(body, BodyCloud) else "mesh"
    name = path.suffix.lower().removeprefix(".")
    able = [known for known in BODY_FORMATS.names() if kind in BODY_FORMATS.find(known).holds]
    if name not in able:
        what = name or "a file without suffix"
        raise make_unknown_format_error(f"a {kind}", what, able, where=str(path))
    format_ = BODY_FORMATS.find(name)
    up = (origin.up,) if format_.free_axes else ()
    found: dict[str, Any] = {}
    if texture is not None:
        companions = [path.with_suffix(suffix).name for suffix in (".mtl", ".png")]
        found["texture_px"] = len(texture.image)
        found["companions"] = companions if name == "obj" else []
    shown = {} if texture is None else {"texture": texture}
    if isinstance(body, SkinnedBody):
        if format_.write_skinned is None:
            format_.write(path, body.mesh, *up, **shown)
        else:
            format_.write_skinned(path, body, *up, **shown)
        body = body.mesh
    else:
        if isinstance(body, BodyMesh) and texture is None:
            body = collapse_slivers(body)
        format_.write(path, body, *up, **shown)
    if up == ("y",):
        format_ = replace(format_, axes=("left", "up", "front"))
    described = describe_body(path.name, format_, body, origin) | found
    write_json(path.with_name(f"{path.name}.json"), described)


def describe_body(
    name: str, format_: BodyFormat, body: BodyCloud | BodyMesh, origin: Provenance
) -> dict[str, Any]:
    """Describe a body in an exported file of that name: the content of the JSON beside it."""
    in_body = origin.rig_from_body
    info: dict[str, Any] = dict(origin.found) | {
        "file": name,
        "units": format_.unit,
        "axes": dict(zip("xyz", format_.axes, strict=True)),
        "frame": "rig" if in_body is None else "body",
        "origin": f"on the floor, {'at the rig centre' if in_body is None else 'under the body'}",
        "rig_from_frame": (in_body or RigidTransform.identity()).matrix,
        "rig_from_file": _rig_from_file(format_, in_body or RigidTransform.identity()),
        "software": f"bodyscan {__version__}",
        "subject": origin.subject,
        "calibration_id": origin.calibration_id,
        "defaced": origin.defaced,
        "kind": "cloud" if isinstance(body, BodyCloud) else "mesh",
    }
    if "regions" in format_.holds and body.regions is not None:
        info["regions"] = list(REGION_NAMES)
    if isinstance(body, BodyCloud):
        return info | {"points": len(body.points), "sigma_mm": _compute_median(body.sigma_mm)}
    areas = compute_face_areas(body.vertices, body.faces)
    return info | {
        "vertices": len(body.vertices),
        "faces": len(body.faces),
        "filled_faces": int(np.count_nonzero(body.filled)),
        "area_mm2": float(areas.sum()),
        "filled_area_mm2": float(areas[body.filled].sum()),
        "coverage": float(areas[~body.filled].sum() / areas.sum()) if len(areas) else 0.0,
        "sigma_mm": _compute_median(body.sigma_mm),
    }


def _rig_from_file(format_: BodyFormat, rig_from_body: RigidTransform) -> Array:
    """Matrix (4, 4) from coordinates as the file has them, in its unit and axes, to mm, rig frame."""
    pointing = ("front", "left", "up")
    body_from_file = np.eye(4)
    scale = {"mm": 1.0, "m": 1000.0}[format_.unit]
    body_from_file[:3, :3] = scale * np.eye(3)[:, [pointing.index(one) for one in format_.axes]]
    return rig_from_body.matrix @ body_from_file


def _compute_median(sigma_mm: np.ndarray[Any, Any]) -> float | None:
    """Compute the median of what was measured; None if nothing was."""
    known = sigma_mm[np.isfinite(sigma_mm)]
    return float(np.median(known)) if known.size else None
