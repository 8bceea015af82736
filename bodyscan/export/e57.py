"""E57 (ASTM E2807): each pair's raw cloud with its pose, for survey and inspection software."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from bodyscan.errors import BadInput
from bodyscan.files.atomic import atomic_replacement, write_json
from bodyscan.fusion.storage import Scan
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.reconstruction.range_image import RangeImage
from bodyscan.version import __version__


def write_e57(
    path: Path, images: Sequence[RangeImage], rig_from_camera: Mapping[str, RigidTransform]
) -> dict[str, int]:
    """Write every range image as a scan named after its pair; returns how many points each has.

    Metres, as the standard requires; points in the camera frame, with its pose in the rig frame;
    colours as the camera saw them, or grey levels; row and column of each point's pixel. E57 wants a
    random number in every file, so two files of the same scan differ in that. Raises BadInput without
    the package pye57.
    """
    try:
        import pye57
    except ImportError as error:
        raise BadInput(
            "E57 needs the package pye57, which is not installed",
            where=str(path),
            remedy="pip install 'bodyscan[e57]'",
        ) from error
    counts = {}
    with atomic_replacement(Path(path)) as temporary:
        file = pye57.E57(str(temporary), mode="w")
        for image in images:
            rows, columns = np.nonzero(image.valid)
            counts[image.pair] = len(rows)
            if not len(rows):
                continue
            x, y, z = image.points[rows, columns].astype(np.float64).T / 1000.0
            data = {"cartesianX": x, "cartesianY": y, "cartesianZ": z}
            data |= {"rowIndex": image.corner[0] + rows, "columnIndex": image.corner[1] + columns}
            seen = (image.colours[..., None] if image.rgb is None else image.rgb)[rows, columns]
            channels = np.broadcast_to(seen, (len(rows), 3)).T
            data |= dict(zip(("colorRed", "colorGreen", "colorBlue"), channels, strict=True))
            pose = rig_from_camera[image.pair]
            turn = Rotation.from_matrix(pose.rotation).as_quat(scalar_first=True)
            shift = pose.translation / 1000.0
            file.write_scan_raw(data, name=image.pair, rotation=turn, translation=shift)
        file.close()
    return counts


def export_raw_clouds(path: Path, scan: Scan, *, subject: str | None, calibration_id: str) -> None:
    """`write_e57` of a scan's aligned range images, and `<path>.json` beside it."""
    counts = write_e57(path, scan.range_images, scan.rig_from_camera)
    write_json(
        path.with_name(f"{path.name}.json"),
        {
            "file": path.name,
            "kind": "raw clouds",
            "units": "m",
            "axes": "each scan in its camera's frame; its pose to the rig frame: x front, z up",
            "software": f"bodyscan {__version__}",
            "subject": subject,
            "calibration_id": calibration_id,
            "verdict": asdict(scan.verdict),
            "left_out": scan.failed,
            "points": counts,
            "sway_mm": scan.alignment.motion_mm if scan.alignment else None,
        },
    )
