"""Kalibr's camchain.yaml: a chain of cameras, each with its pose in the frame of the one before.

Metres, as Kalibr's targets are. The first camera's frame is the world.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from bodyscan.errors import BadInput
from bodyscan.files.atomic import write_text
from bodyscan.files.yaml_file import dump_yaml
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.interchange.foreign_file import ForeignFile, read_document
from bodyscan.interchange.found_camera import FoundCamera, FoundCameras
from bodyscan.interchange.rig_format import RigCameras, RigFormat, describe_opencv_lens

NOTE = """\
# Metres. Pixel centres at whole numbers. `name` is the pair's. Kalibr's cameras have no skew: shear
# a point (u, v) of the pair to (u - skew / fv * (v - pv), v) before using it with them.
"""


def write_kalibr(cameras: RigCameras, path: Path) -> Path:
    """Write cam0, cam1, ... in the order of the pairs; returns `path`.

    Raises BadInput for a lens that is neither a fisheye (equidistant) nor of k1, k2, p1, p2 (radtan).
    """
    content: dict[str, Any] = {}
    before: RigidTransform | None = None
    for number, (name, (camera, rig_from_camera)) in enumerate(cameras.items()):
        is_fisheye, coefficients = describe_opencv_lens(camera)
        if np.any(coefficients[4:]):
            what = (
                f"Kalibr has no lens like {camera.lens.kind!r}: its radtan ends with k1, k2, p1, p2"
            )
            remedy = "choose another format, such as opencv, colmap or mrcal"
            raise BadInput(what, where=f"pair {name}", remedy=remedy)
        entry: dict[str, Any] = {
            "camera_model": "pinhole",
            "intrinsics": [camera.alpha, camera.beta, camera.u0, camera.v0],
            "distortion_model": "equidistant" if is_fisheye else "radtan",
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


def read_kalibr(path: Path) -> FoundCameras:
    """Read cameras by cam0, cam1, ..., and by the pair's name if bodyscan wrote the file.

    A camera without T_cn_cnm1 is placed by T_cam_imu, which takes the IMU's coordinates to the
    camera's, or by its inverse, T_imu_cam, where cam0 has one of them too.
    """
    file = ForeignFile.read(path)
    data = read_document(file)
    chain = data if isinstance(data, dict) else {}
    cameras = {key: entry for key, entry in chain.items() if isinstance(entry, dict)}
    if "cam0" not in cameras:
        remedy = "give camchain-....yaml, which kalibr_calibrate_cameras wrote"
        raise file.error("not a Kalibr camchain: no cam0", remedy=remedy)
    readers = {}
    for number in range(len(cameras)):
        key = f"cam{number}"
        if key not in cameras:
            break
        readers[key] = partial(_read_camera, file, cameras, number)
        if isinstance(cameras[key].get("name"), str):
            readers[cameras[key]["name"]] = readers[key]
    return readers


def _compute_pose_in_first(
    file: ForeignFile, cameras: Mapping[str, Any], number: int
) -> RigidTransform | None:
    """Compute a camera's pose, `camera_from_cam0`; None if neither chain nor IMU gives it."""
    pose: RigidTransform | None = RigidTransform.identity()
    for k in range(1, number + 1):
        key = f"cam{k}"
        if "T_cn_cnm1" in cameras[key]:
            step = _read_transform(file, cameras, key, "T_cn_cnm1")
            pose = step @ pose if step and pose else None
        else:
            camera_from_imu, first = (
                _read_transform(file, cameras, one, "T_cam_imu")
                or _read_transform(file, cameras, one, "T_imu_cam", inverse=True)
                for one in (key, "cam0")
            )
            pose = camera_from_imu @ first.inverse() if camera_from_imu and first else None
    return pose


def _read_transform(
    file: ForeignFile, cameras: Mapping[str, Any], key: str, word: str, *, inverse: bool = False
) -> RigidTransform | None:
    if word not in cameras[key]:
        return None
    name = f"{key}.{word}"
    matrix = file.numbers(cameras[key][word], name, 16).reshape(4, 4)
    pose = file.pose(matrix[:3, :3], matrix[:3, 3], name)
    return pose.inverse() if inverse else pose


def _read_camera(file: ForeignFile, cameras: Mapping[str, Any], number: int) -> FoundCamera:
    key = f"cam{number}"
    entry = cameras[key]
    file.require(entry, ("camera_model", "intrinsics", "distortion_model", "resolution"), key)
    given = [] if entry["distortion_model"] == "none" else entry.get("distortion_coeffs", [])
    around = {word: str(entry[word]) for word in ("camera_model", "distortion_model")}
    lens = file.lens(given, f"{key}.distortion_coeffs", around)
    matrix = file.pinhole_matrix(entry["intrinsics"], f"{key}.intrinsics")
    matrix[0, 1] = file.numbers(entry.get("skew", 0.0), f"{key}.skew", 1)[0]
    return FoundCamera(
        matrix,
        lens,
        file.size(entry["resolution"], f"{key}.resolution"),
        _compute_pose_in_first(file, cameras, number),
        file.where(key),
    )


FORMAT = RigFormat("camchain.yaml", "m", write_kalibr, read_kalibr)
