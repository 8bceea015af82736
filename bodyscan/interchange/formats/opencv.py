"""OpenCV's FileStorage: YAML, XML or JSON.

bodyscan writes one entry per pair. Files from elsewhere have nodes with any name, given in the rig
file; a node inside others is named with their names first: `stereo/K1`.

OpenCV's camera functions have no skew, so the file says what to do about it.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import cv2

from bodyscan.errors import CalibrationFileError
from bodyscan.files.atomic import write_text
from bodyscan.files.model import did_you_mean
from bodyscan.geometry.camera import Camera
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.interchange.foreign_file import ForeignFile, read_document
from bodyscan.interchange.found_camera import FoundCamera, FoundCameras
from bodyscan.interchange.rig_format import (
    Nodes,
    RigCameras,
    RigFormat,
    describe_opencv_lens,
    projector_name,
)

NOTE = (
    "Lengths in mm. x_camera = R x_rig + T. Pixel centres at whole numbers. camera_matrix holds the "
    "skew, but OpenCV's functions ignore it: use it with pixels sheared to "
    "u - skew / fy * (v - cy), v, which a camera without skew would have seen. Of a projector, "
    "x_projector = R x_camera + T, as stereoCalibrate has it; the middle of its first column is 0."
)


def write_opencv(cameras: RigCameras, path: Path) -> Path:
    """Write a sequence `pairs` as cv2.FileStorage reads it.

    Each entry has name, image size, camera_matrix (with its skew), distortion_coefficients
    (OpenCV's, in its order), R and T of `camera_from_rig`; and if its projector is known,
    `projector` with R and T of `projector_from_camera`.

    Returns `path`.
    """
    memory = cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY | cv2.FILE_STORAGE_FORMAT_YAML
    store = cv2.FileStorage("rig.yaml", memory)
    store.writeComment(NOTE, False)
    store.startWriteStruct("pairs", cv2.FILE_NODE_SEQ)
    inner = {projector_name(name) for name in cameras}
    for name, (camera, rig_from_camera) in cameras.items():
        if name in inner:
            continue
        store.startWriteStruct("", cv2.FILE_NODE_MAP)
        store.write("name", name)
        _write_camera(store, camera, rig_from_camera.inverse())
        light = projector_name(name)
        if light in cameras:
            projector, rig_from_projector = cameras[light]
            store.startWriteStruct("projector", cv2.FILE_NODE_MAP)
            from_camera = rig_from_projector.inverse() @ rig_from_camera
            _write_camera(store, projector, from_camera)
            store.endWriteStruct()
        store.endWriteStruct()
    store.endWriteStruct()
    write_text(Path(path), store.releaseAndGetString())
    return Path(path)


def _write_camera(store: Any, camera: Camera, pose: RigidTransform) -> None:
    is_fisheye, coefficients = describe_opencv_lens(camera)
    store.write("image_width", camera.width)
    store.write("image_height", camera.height)
    store.write("camera_matrix", camera.matrix)
    store.write("skew", camera.gamma)
    if is_fisheye:
        store.write("distortion_model", "equidistant")
    store.write("distortion_coefficients", coefficients[None])
    store.write("R", pose.rotation)
    store.write("T", pose.translation.reshape(3, 1))


def read_opencv(path: Path) -> FoundCameras:
    """Read a file that `write_opencv` wrote: cameras, and projectors by `projector_name`."""
    file = ForeignFile.read(path)
    root = _read_root(file)
    if not isinstance(root.get("pairs"), list):
        raise file.error(
            "has no list of pairs as bodyscan writes it",
            remedy="say which of its nodes are meant, such as camera: {matrix: K, distortion: D}; "
            f"it has {', '.join(root)}",
        )
    readers = {}
    for k, entry in enumerate(root["pairs"]):
        label = str(_find_below(file, entry, "name", f"pairs/{k}"))
        readers[label] = partial(_read_camera, file, entry, f"pairs/{k}", label)
        if "projector" in entry:
            light = partial(_read_projector, file, entry, f"pairs/{k}", label)
            readers[projector_name(label)] = light
    return readers


def _read_projector(file: ForeignFile, entry: Any, name: str, label: str) -> FoundCamera:
    camera = _read_camera(file, entry, name, label)
    inner = _read_camera(file, entry["projector"], f"{name}/projector", label)
    assert inner.camera_from_world is not None
    assert camera.camera_from_world is not None
    return replace(inner, camera_from_world=inner.camera_from_world @ camera.camera_from_world)


def _read_camera(file: ForeignFile, entry: Any, name: str, label: str) -> FoundCamera:
    def numbers(key: str) -> Any:
        return _find_below(file, entry, key, name)

    size = [numbers("image_width"), numbers("image_height")]
    return FoundCamera(
        file.matrix(numbers("camera_matrix"), f"{label}.camera_matrix"),
        file.lens(numbers("distortion_coefficients"), f"{label}.distortion_coefficients", entry),
        file.size(size, f"{label}.image_width"),
        file.pose(numbers("R"), numbers("T"), f"{label}.R", f"{label}.T"),
        file.where(f"{label}.camera_matrix"),
    )


def read_nodes(path: Path, nodes: Nodes, pose_path: Path | None = None) -> FoundCamera:
    """Read the camera whose numbers are in these nodes: matrix; distortion, size (or width and height)
    if given; rotation and translation, of `pose_path` if they are in another file."""
    file = ForeignFile.read(path)
    root = _read_root(file)
    pose_file = ForeignFile.read(pose_path) if pose_path else file
    poses = _read_root(pose_file) if pose_path else root

    def values(what: str) -> Any:
        inside = (pose_file, poses) if what in ("rotation", "translation") else (file, root)
        return _find_node(*inside, nodes[what])[0]

    size = file.size(values("size"), nodes["size"]) if "size" in nodes else None
    if "width" in nodes:
        size = file.size([values("width"), values("height")], nodes["width"])
    pose = None
    if "rotation" in nodes:
        names = nodes["rotation"], nodes["translation"]
        pose = pose_file.pose(values("rotation"), values("translation"), *names)
    matrix = file.matrix(values("matrix"), nodes["matrix"])
    coefficients = values("distortion") if "distortion" in nodes else []
    name = nodes.get("distortion", nodes["matrix"])
    lens = file.lens(coefficients, name, _find_node(file, root, name)[1])
    return FoundCamera(matrix, lens, size, pose, file.where(nodes["matrix"].split("/")[-1]))


def _read_root(file: ForeignFile) -> dict[str, Any]:
    root = read_document(file)
    if not isinstance(root, dict):
        raise file.error("is neither YAML, XML nor JSON as OpenCV's FileStorage reads them")
    return root


def _find_node(file: ForeignFile, root: dict[str, Any], name: str) -> tuple[Any, dict[str, Any]]:
    """Find a node by its name, with those around it first: `stereo/K1`; and what stands beside it
    and beside those around it, the innermost of a name."""
    node, passed, around = root, "", dict[str, Any]()
    for part in name.split("/"):
        below = _find_below(file, node, part, passed)
        around |= node
        node, passed = below, f"{passed}/{part}" if passed else part
    return node, around


def _find_below(file: ForeignFile, node: Any, name: str, passed: str) -> Any:
    """Find a node below another. Raises CalibrationFileError, which lists those there are."""
    keys = list(node) if isinstance(node, dict) else []
    if name not in keys:
        parent = f"below {passed}" if passed else "in it"
        raise CalibrationFileError(
            f"has no node {name!r} {parent}{did_you_mean(name, keys)}",
            where=file.where(passed.split("/")[-1]) if passed else str(file.path),
            remedy=f"there is {', '.join(keys) or 'none'}",
        )
    return node[name]


FORMAT = RigFormat("rig-opencv.yaml", "mm", write_opencv, read_opencv, read_nodes)
