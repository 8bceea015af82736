"""Read a pair that another program calibrated, convert it to our terms and check it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from bodyscan.arrays import Array
from bodyscan.calibration.projector_camera import intersect_central_rays, sheets_from_projector
from bodyscan.errors import CalibrationFileError
from bodyscan.geometry.camera import Camera, CameraPrior
from bodyscan.geometry.light_planes import LightSheets
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.interchange.found_camera import FoundCamera, find_camera
from bodyscan.interchange.rig_format import MILLIMETRES, RIG_FORMATS
from bodyscan.rig.pair import Known, KnownCamera, Pair
from bodyscan.stripes.stripe_code import StripeCode


@dataclass(frozen=True, eq=False)
class KnownPair:
    """What another program knows of a pair."""

    camera: Camera
    camera_from_world: RigidTransform | None  # mm, None if the file does not say
    projector: Camera | None  # the projector as a camera, None if nothing is known of it
    projector_from_camera: RigidTransform | None  # mm, None if nothing is known of the projector
    sigma_px: float | None  # see `Known`
    source: str  # the file and its format

    def sheets(self, code: StripeCode) -> LightSheets:
        """Compute the sheets of the stripes that the projector shows."""
        assert self.projector is not None
        assert self.projector_from_camera is not None
        middle = intersect_central_rays(self.camera, self.projector, self.projector_from_camera)
        return sheets_from_projector(
            self.projector,
            self.projector_from_camera,
            middle,
            code.stripes,
            code.direction,
            self.sigma_px or 0.0,
        )


def read_known_camera(pair: Pair, folder: Path) -> Camera:
    """Read the camera of a pair with `known`, whose file is relative to `folder`.

    Its prior lets boards move it by `sigma_px`, or holds it fixed if none is given. Raises
    CalibrationFileError for a file that is wrong or describes another camera.
    """
    assert pair.known is not None
    found = _find(pair.known, pair.known.camera, pair.name, folder)
    camera = found.camera(pair.camera.width, pair.camera.height)
    sigmas = compute_parameter_sigmas(camera, pair.known.sigma_px or 1e-6)
    return replace(camera, prior=CameraPrior(camera.parameters, sigmas))


def read_known_pair(pair: Pair, folder: Path) -> KnownPair:
    """Read all that is known of a pair with `known`.

    Raises CalibrationFileError like `read_known_camera`, and also if lengths lack a unit or the
    projector has no pose.
    """
    known = pair.known
    assert known is not None
    found = _find(known, known.camera, pair.name, folder)
    camera = found.camera(pair.camera.width, pair.camera.height)
    camera_from_world = _convert_pose(known, known.camera, found, pair.name)
    projector, projector_from_camera = None, None
    if known.projector is not None and pair.projector is not None:
        light = _find(known, known.projector, pair.name, folder)
        projector = _convert_projector(light, pair.projector)
        from_world = _convert_pose(known, known.projector, light, pair.name)
        if known.projector.nodes and camera_from_world is not None:
            from_world = from_world or RigidTransform.identity()  # the projector is the world
        if from_world is None:
            raise CalibrationFileError(
                f"does not say where the projector of pair {pair.name} stands",
                where=light.where,
                remedy="give rotation and translation below `known.projector` in the rig file",
            )
        world_from_camera = (camera_from_world or RigidTransform.identity()).inverse()
        projector_from_camera = from_world @ world_from_camera
        _require_baseline(projector_from_camera, light.where, known)
    source = f"{known.file} ({known.format})"
    return KnownPair(
        camera, camera_from_world, projector, projector_from_camera, known.sigma_px, source
    )


def _require_baseline(projector_from_camera: RigidTransform, where: str, known: Known) -> None:
    """Refuse a projector nearer than a lens is wide, or farther away than a room is."""
    baseline = float(np.linalg.norm(projector_from_camera.translation))
    if not 5.0 < baseline < 2e4:
        raise CalibrationFileError(
            f"puts the projector {baseline:.3g} mm from its camera. Possible cause: its lengths are "
            f"not in {known.units or 'the unit of its format'}",
            where=where,
            remedy="correct `units` below `known` in the rig file",
        )


def compute_parameter_sigmas(camera: Camera, sigma_px: float) -> Array:
    """Compute standard deviations (P,) of a camera's parameters for pixels with sigma_px.

    Each parameter by itself moves the most affected image point by just sigma_px.
    """
    u, v = (np.linspace(0.0, size - 1.0, 9) for size in (camera.width, camera.height))
    rays = camera.rays(np.stack(np.meshgrid(u, v), axis=-1)).reshape(-1, 3)
    by_parameter, _ = camera.jacobians(rays[np.isfinite(rays).all(axis=1)])
    largest: Array = np.linalg.norm(by_parameter, axis=1).max(axis=0)
    return sigma_px / largest


def _find(known: Known, device: KnownCamera, name: str, folder: Path) -> FoundCamera:
    path = Path(folder) / (device.file or known.file)
    form = RIG_FORMATS.find(known.format)
    if device.nodes and form.read_nodes:
        pose_path = Path(folder) / device.pose_file if device.pose_file else None
        return form.read_nodes(path, device.nodes, pose_path)
    cameras = form.read(path)
    only = device.file is not None or device is known.camera
    if device.name is None and only and len(cameras) == 1:
        return next(iter(cameras.values()))()
    return find_camera(cameras, device.name or name, str(path))


def _convert_pose(
    known: Known, device: KnownCamera, found: FoundCamera, name: str
) -> RigidTransform | None:
    """Convert `camera_from_world` to mm; None if the file has no pose."""
    pose = found.camera_from_world
    if pose is None:
        return None
    unit = known.units or (None if device.nodes else RIG_FORMATS.find(known.format).unit)
    if unit is None:
        raise CalibrationFileError(
            "does not say in which unit its lengths are",
            where=found.where,
            remedy=f"add `units: mm` (or cm, or m) to `known` of pair {name} in the rig file",
        )
    scaled = RigidTransform(pose.rotation, pose.translation * MILLIMETRES[unit])
    return scaled.inverse() if device.inverse else scaled


def _convert_projector(found: FoundCamera, code: StripeCode) -> Camera:
    """Convert the projector to a camera; if the file gives no image size, a stripe is a pixel. Stripes
    must divide the image evenly, or they belong to another projector. The start of waves (`origin`) is
    counted in stripes, so another stripe width would move the waves."""
    stripes = {one.direction: one.stripes for one in code.directions}
    if found.size is None:
        u0, v0 = float(found.matrix[0, 2]), float(found.matrix[1, 2])
        width = stripes.get("vertical", max(round(2.0 * u0), 1))
        return found.projector(width, stripes.get("horizontal", max(round(2.0 * v0), 1)))
    for one in code.directions:
        direction, count, origin = one.direction, one.stripes, getattr(one, "origin", None)
        size = found.size[0 if direction == "vertical" else 1]
        if count < size and origin:
            raise CalibrationFileError(
                f"has a projector of {found.size[0]} x {found.size[1]} px, but its waves begin at "
                f"`origin: {origin:g}` of {count} stripes: in stripes wider than a pixel they "
                "begin elsewhere",
                where=found.where,
                remedy=f"write `stripes: {size}` for {direction} stripes in the rig file, and `origin` "
                "in pixels",
            )
        if count > size or (size % count and one.has_edges):
            raise CalibrationFileError(
                f"has a projector of {found.size[0]} x {found.size[1]} px, which {count} {direction} "
                f"stripes do not divide evenly ({size / count:.4g} px each)",
                where=found.where,
                remedy="correct `stripes` or `direction` in the rig file, or give the file of this "
                "projector",
            )
    return found.projector(*found.size)
