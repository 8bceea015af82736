"""Kalibr's camchain.yaml: a chain of cameras, each with its pose in the frame of the one before.

Metres, as Kalibr's targets are. The format has no frame of its entry: the first camera's is the
world.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from bodyscan.errors import BadInput
from bodyscan.files.atomic import write_text
from bodyscan.files.yaml_file import YamlError, dump_yaml, read_yaml
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.interchange.foreign_file import ForeignFile
from bodyscan.interchange.found_camera import FoundCamera
from bodyscan.interchange.rig_format import RigCameras, RigFormat, opencv_coefficients

NOTE = """\
# Metres. Pixel centres at whole numbers. `name` is the pair's. Kalibr's cameras have no skew: shear
# a point (u, v) of the pair to (u - skew / fv * (v - pv), v) before using it with them.
"""


def write_kalibr(cameras: RigCameras, path: Path) -> Path:
    """Write cam0, cam1, ... in the order of the pairs; returns `path`.

    Raises BadInput for a lens with more than Kalibr's radtan has, k1, k2, p1, p2.
    """
    content: dict[str, Any] = {}
    before: RigidTransform | None = None
    for number, (name, (camera, rig_from_camera)) in enumerate(cameras.items()):
        coefficients = opencv_coefficients(name, camera)
        if np.any(coefficients[4:]):
            raise BadInput(
                f"Kalibr has no lens like {camera.lens.kind!r}: its radtan ends with k1, k2, p1, p2",
                where=f"pair {name}",
                remedy="choose another format, such as opencv, colmap or mrcal",
            )
        entry: dict[str, Any] = {
            "camera_model": "pinhole",
            "intrinsics": [camera.alpha, camera.beta, camera.u0, camera.v0],
            "distortion_model": "radtan",
            "distortion_coeffs": coefficients[:4].tolist(),
            "resolution": [camera.width, camera.height],
            "rostopic": f"/{name}/image_raw",
            "name": name,
            "skew": camera.gamma,
        }
        if before is not None:
            chain = (rig_from_camera.inverse() @ before).matrix
            chain[:3, 3] /= 1000.0
            entry["T_cn_cnm1"] = chain.tolist()
        before = rig_from_camera
        content[f"cam{number}"] = entry
    write_text(Path(path), NOTE + dump_yaml(content))
    return Path(path)


def read_kalibr(path: Path) -> dict[str, FoundCamera]:
    """Read cameras by cam0, cam1, ..., and by the pair's name if bodyscan wrote the file."""
    file = ForeignFile.read(path)
    try:
        data = read_yaml(path).data
    except YamlError as error:
        raise file.error(error.problem.text) from None
    chain = data if isinstance(data, dict) else {}
    cameras = {key: entry for key, entry in chain.items() if isinstance(entry, dict)}
    if "cam0" not in cameras:
        raise file.error(
            "is not a camchain of Kalibr's: it has no cam0",
            remedy="give camchain-....yaml, which kalibr_calibrate_cameras wrote",
        )
    found: dict[str, FoundCamera] = {}
    pose: RigidTransform | None = RigidTransform.identity()
    for number in range(len(cameras)):
        key = f"cam{number}"
        if key not in cameras:
            break
        entry = cameras[key]
        if number > 0:
            pose = _compute_next_pose(file, key, entry, pose)
        one = _read_camera(file, key, entry, pose)
        found[key] = one
        if isinstance(entry.get("name"), str):
            found[entry["name"]] = one
    return found


def _compute_next_pose(
    file: ForeignFile, key: str, entry: dict[str, Any], before: RigidTransform | None
) -> RigidTransform | None:
    """Compute the next camera's pose; after a gap in the chain there is none."""
    if "T_cn_cnm1" not in entry or before is None:
        return None
    name = f"{key}.T_cn_cnm1"
    matrix = file.numbers(entry["T_cn_cnm1"], name, 16).reshape(4, 4)
    step = file.pose(matrix[:3, :3], matrix[:3, 3], name)
    return step @ before


def _read_camera(
    file: ForeignFile, key: str, entry: dict[str, Any], pose: RigidTransform | None
) -> FoundCamera:
    words = ("camera_model", "intrinsics", "distortion_model", "resolution")
    file.require(entry, words, key)
    supported = {"camera_model": ("model", "pinhole"), "distortion_model": ("lens", "radtan")}
    for word, (what, wanted) in supported.items():
        if entry[word] not in (wanted, "none" if what == "lens" else wanted):
            wrong = f"{entry[word]!r} is a {what} that is not supported, {wanted} is"
            raise file.error(wrong, f"{key}.{word}", "calibrate it with pinhole-radtan")
    lens = entry.get("distortion_coeffs", []) if entry["distortion_model"] == "radtan" else []
    matrix = file.pinhole_matrix(entry["intrinsics"], f"{key}.intrinsics")
    matrix[0, 1] = file.numbers(entry.get("skew", 0.0), f"{key}.skew", 1)[0]
    return FoundCamera(
        matrix,
        file.lens(lens, f"{key}.distortion_coeffs"),
        file.size(entry["resolution"], f"{key}.resolution"),
        pose,
        file.where(key),
    )


FORMAT = RigFormat("camchain.yaml", "m", write_kalibr, read_kalibr)
