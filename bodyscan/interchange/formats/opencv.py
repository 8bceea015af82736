"""OpenCV's FileStorage: YAML, XML or JSON.

bodyscan writes one entry per pair. Files from elsewhere have nodes with any name, given in the rig
file; a node inside others is named with their names first: `stereo/K1`.

OpenCV's camera functions have no skew, so the file says what to do about it.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2

from bodyscan.errors import CalibrationFileError
from bodyscan.files.atomic import write_text
from bodyscan.files.model import did_you_mean
from bodyscan.geometry.camera import Camera
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.interchange.foreign_file import ForeignFile
from bodyscan.interchange.found_camera import FoundCamera
from bodyscan.interchange.rig_format import (
    Nodes,
    RigCameras,
    RigFormat,
    opencv_coefficients,
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

    Returns `path`. Raises BadInput for a lens that OpenCV does not have.
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
        _write_camera(store, name, camera, rig_from_camera.inverse())
        light = projector_name(name)
        if light in cameras:
            projector, rig_from_projector = cameras[light]
            store.startWriteStruct("projector", cv2.FILE_NODE_MAP)
            from_camera = rig_from_projector.inverse() @ rig_from_camera
            _write_camera(store, light, projector, from_camera)
            store.endWriteStruct()
        store.endWriteStruct()
    store.endWriteStruct()
    write_text(Path(path), store.releaseAndGetString())
    return Path(path)


def _write_camera(store: Any, name: str, camera: Camera, pose: RigidTransform) -> None:
    store.write("image_width", camera.width)
    store.write("image_height", camera.height)
    store.write("camera_matrix", camera.matrix)
    store.write("skew", camera.gamma)
    store.write("distortion_coefficients", opencv_coefficients(name, camera)[None])
    store.write("R", pose.rotation)
    store.write("T", pose.translation.reshape(3, 1))


def read_opencv(path: Path) -> dict[str, FoundCamera]:
    """Read a file that `write_opencv` wrote: cameras, and projectors by `projector_name`."""
    file = ForeignFile.read(path)
    store = _open_storage(file)
    pairs = store.getNode("pairs")
    if not pairs.isSeq():
        raise file.error(
            "has no list of pairs as bodyscan writes it",
            remedy="say which of its nodes are meant, such as camera: {matrix: K, distortion: D}; "
            f"it has {', '.join(store.root().keys())}",
        )
    found = {}
    for k in range(int(pairs.size())):
        entry, name = pairs.at(k), f"pairs/{k}"
        label = _find_below(file, entry, "name", name).string()
        camera = found[label] = _read_camera(file, entry, name, label)
        if "projector" in entry.keys():  # noqa: SIM118 (it is no dict)
            light = _find_below(file, entry, "projector", name)
            inner = _read_camera(file, light, f"{name}/projector", label)
            assert inner.camera_from_world is not None
            assert camera.camera_from_world is not None
            from_rig = inner.camera_from_world @ camera.camera_from_world
            found[projector_name(label)] = replace(inner, camera_from_world=from_rig)
    return found


def _read_camera(file: ForeignFile, entry: Any, name: str, label: str) -> FoundCamera:
    def numbers(key: str) -> Any:
        return _read_values(file, _find_below(file, entry, key, name), f"{name}/{key}")

    size = [numbers("image_width"), numbers("image_height")]
    return FoundCamera(
        file.matrix(numbers("camera_matrix"), f"{label}.camera_matrix"),
        file.lens(numbers("distortion_coefficients"), f"{label}.distortion_coefficients"),
        file.size(size, f"{label}.image_width"),
        file.pose(numbers("R"), numbers("T"), f"{label}.R", f"{label}.T"),
        file.where(f"{label}.camera_matrix"),
    )


def read_nodes(path: Path, nodes: Nodes) -> FoundCamera:
    """Read the camera whose numbers are in these nodes: matrix; distortion, size (or width and height),
    rotation and translation if given."""
    file = ForeignFile.read(path)
    store = _open_storage(file)

    def values(what: str) -> Any:
        return _read_values(file, _find_node(file, store, nodes[what]), nodes[what])

    size = file.size(values("size"), nodes["size"]) if "size" in nodes else None
    if "width" in nodes:
        size = file.size([values("width"), values("height")], nodes["width"])
    pose = None
    if "rotation" in nodes:
        names = nodes["rotation"], nodes["translation"]
        pose = file.pose(values("rotation"), values("translation"), *names)
    coefficients = values("distortion") if "distortion" in nodes else []
    lens = file.lens(coefficients, nodes.get("distortion", nodes["matrix"]))
    matrix = file.matrix(values("matrix"), nodes["matrix"])
    return FoundCamera(matrix, lens, size, pose, file.where(nodes["matrix"].split("/")[-1]))


def _open_storage(file: ForeignFile) -> Any:
    """Open the storage; its nodes live only as long as it does."""
    text = file.text.lstrip()
    if not text.startswith(("%YAML", "<?xml", "{")):
        text = "%YAML:1.0\n---\n" + text  # OpenCV needs it, ROS leaves it out
    read = cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY
    try:
        store = cv2.FileStorage(text, read)
        if store.isOpened() and store.root().isMap():
            return store
    except (SystemError, cv2.error):
        pass
    raise file.error("is neither YAML, XML nor JSON as OpenCV's FileStorage reads them")


def _find_node(file: ForeignFile, store: Any, name: str) -> Any:
    """Find a node by its name, with those around it first: `stereo/K1`."""
    node, passed = store.root(), ""
    for part in name.split("/"):
        node = _find_below(file, node, part, passed)
        passed = f"{passed}/{part}" if passed else part
    return node


def _find_below(file: ForeignFile, node: Any, name: str, passed: str) -> Any:
    """Find a node below another. Raises CalibrationFileError, which lists those there are."""
    keys = list(node.keys()) if node.isMap() else []
    if name not in keys:
        parent = f"below {passed}" if passed else "in it"
        raise CalibrationFileError(
            f"has no node {name!r} {parent}{did_you_mean(name, keys)}",
            where=file.where(passed.split("/")[-1]) if passed else str(file.path),
            remedy=f"there is {', '.join(keys) or 'none'}",
        )
    return node.getNode(name)


def _read_values(file: ForeignFile, node: Any, name: str) -> Any:
    """Read a number, or a list of what is in the node; of a matrix its numbers row by row."""
    if node.isMap() and "data" in node.keys():  # noqa: SIM118 (it is no dict)
        return _read_values(file, node.getNode("data"), name)
    if node.isSeq():
        return [_read_values(file, node.at(k), name) for k in range(int(node.size()))]
    if node.isInt() or node.isReal():
        return float(node.real())
    raise file.error("holds what is not a number", name.split("/")[-1])


FORMAT = RigFormat("rig-opencv.yaml", "mm", write_opencv, read_opencv, read_nodes)
