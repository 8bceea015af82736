"""The rig and the room as built: nominal poses with the errors of hands and tape measures."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from bodyscan.arrays import Array
from bodyscan.errors import BadInput
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.rig.pair import NominalPose, Pair
from bodyscan.rig.rig import Rig
from bodyscan.simulation.lens import TrueCamera
from bodyscan.simulation.projector import MirrorProjector, PinholeProjector, Projector
from bodyscan.simulation.scene import Surface, build_grid_surface
from bodyscan.simulation.settings import Optics, Projection, Room, SimulationSettings


@dataclass(frozen=True, eq=False)
class TruePair:
    """A pair: its name, its camera and that camera's pose, its projector in the camera's frame."""

    name: str
    camera: TrueCamera
    rig_from_camera: RigidTransform
    projector: Projector
    reach_mm: float  # the working distance, from the nominal pose
    has_stripes: bool  # False for a camera alone, which a plain lamp lights


def build_pairs(
    rig: Rig, settings: SimulationSettings, stream: Callable[[int], np.random.Generator]
) -> dict[str, TruePair]:
    """Draw every pair's true parameters, each from its own `stream(number)`.

    A pair that fixes the rig frame stands exactly where it should. Raises BadInput for a pair
    without a nominal pose.
    """
    return {
        pair.name: _build(pair, pair is rig.frame_pair, settings, stream(number))
        for number, pair in enumerate(rig.pairs)
    }


def _build(
    pair: Pair, fixed: bool, settings: SimulationSettings, rng: np.random.Generator
) -> TruePair:
    if pair.nominal is None:
        raise BadInput(
            "a rig can be simulated only if every pair has a nominal pose",
            where=f"pair {pair.name}",
            remedy="Add nominal: {position_mm: [x, y, z], look_at_mm: [x, y, z]} to the rig file.",
        )
    optics = settings.optics
    reach = float(np.linalg.norm(np.subtract(*_find_endpoints(pair.nominal))))
    camera = draw_camera(pair.camera.width, pair.camera.height, optics, rng)
    nominal = rig_from_nominal(pair.nominal)
    perturbed = _perturb(nominal, optics, reach, rng)
    rig_from_camera = nominal if fixed else perturbed
    horizontal = pair.projector is None or pair.projector.direction == "horizontal"
    nominal_pose = pair.projector_nominal or _choose_projector(nominal, reach, horizontal)
    rig_from_projector = _perturb(rig_from_nominal(nominal_pose), optics, reach, rng)
    stripes = pair.projector.stripes if pair.projector else 2
    builder = build_mirror if settings.projection.kind == "mirror" else build_pinhole
    depths = reach * np.linspace(settings.projection.near, settings.projection.far, 5)
    projector = builder(
        rig_from_camera.inverse() @ rig_from_projector,
        stripes,
        horizontal,
        sample_view_volume(camera, depths),
        settings.projection,
        rng,
    )
    has_stripes = pair.projector is not None
    return TruePair(pair.name, camera, rig_from_camera, projector, reach, has_stripes)


def draw_camera(width: int, height: int, optics: Optics, rng: np.random.Generator) -> TrueCamera:
    """Draw a camera around the nominal one; pixel values scale with the image's width."""
    pixel = width / 1280.0
    alpha = optics.focal_widths * width * (1.0 + optics.focal_spread * rng.standard_normal())
    beta = alpha * (1.0 + optics.aspect_spread * (1.0 + 0.5 * rng.standard_normal()))
    u0, v0 = optics.centre_px * pixel * rng.standard_normal(2)
    gamma = optics.skew_px * pixel * (1.0 + 0.2 * rng.standard_normal())
    k1 = optics.k1 + optics.k1_spread * float(np.clip(rng.standard_normal(), -2, 2))
    k2 = optics.k2 + optics.k2_spread * float(np.clip(rng.standard_normal(), -2, 2))
    u0, v0 = u0 + (width - 1) / 2.0, v0 + (height - 1) / 2.0
    alpha, beta, gamma, u0, v0 = (float(value) for value in (alpha, beta, gamma, u0, v0))
    p1 = p2 = k3 = 0.0
    if optics.p_spread or optics.k3_spread:
        p1, p2 = (float(p) for p in optics.p_spread * rng.standard_normal(2))
        k3 = optics.k3_spread * float(np.clip(rng.standard_normal(), -2, 2))
    return TrueCamera(alpha, beta, gamma, u0, v0, k1, k2, width, height, p1, p2, k3)


def rig_from_nominal(nominal_pose: NominalPose) -> RigidTransform:
    """Compute the pose of a device that looks along its z axis, y down, upright in the rig."""
    position, target = _find_endpoints(nominal_pose)
    forward = target - position
    forward = forward / np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    if np.linalg.norm(right) < 1e-6:  # straight up or down: the image's top is towards x
        right = np.cross([-1.0, 0.0, 0.0], forward)
    right = right / np.linalg.norm(right)
    return RigidTransform(np.stack([right, np.cross(forward, right), forward], axis=1), position)


def _find_endpoints(nominal_pose: NominalPose) -> tuple[Array, Array]:
    return np.array(nominal_pose.position_mm, float), np.array(nominal_pose.look_at_mm, float)


def _choose_projector(nominal: RigidTransform, reach: float, horizontal: bool) -> NominalPose:
    """Choose a projector's pose if the rig file has none: above the camera, or to its right."""
    axis = -nominal.rotation[:, 1] if horizontal else nominal.rotation[:, 0]
    position = nominal.translation + 0.22 * reach * axis
    target = nominal.translation + reach * nominal.rotation[:, 2]
    return NominalPose(position_mm=tuple(position.tolist()), look_at_mm=tuple(target.tolist()))


def _perturb(
    rig_from_device: RigidTransform, optics: Optics, reach: float, rng: np.random.Generator
) -> RigidTransform:
    """Perturb a pose by errors of placing by hand; smaller ones in a rig smaller than 1.3 m."""
    turn = np.radians(optics.angle_deg) * rng.standard_normal(3)
    shift = optics.position_mm * min(1.0, reach / 1300.0) * rng.standard_normal(3)
    rotation_error = RigidTransform.from_rotation_vector(turn, np.zeros(3)).rotation
    return RigidTransform(
        rig_from_device.rotation @ rotation_error, rig_from_device.translation + shift
    )


def sample_view_volume(camera: TrueCamera, depths: Sequence[float] | Array) -> Array:
    """Sample points (N, 3) at some depths over the field of view, corners included."""
    u, v = np.linspace(-0.5, camera.width - 0.5, 9), np.linspace(-0.5, camera.height - 0.5, 9)
    grid = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
    return (camera.directions(grid)[:, None, :] * np.reshape(depths, (-1, 1))).reshape(-1, 3)


def build_mirror(
    camera_from_projector: RigidTransform,
    stripes: int,
    horizontal: bool,
    points: Array,
    projection: Projection,
    rng: np.random.Generator,
) -> MirrorProjector:
    """Build a laser and mirror in the projector's position, sweeping over all points.

    The laser's apex lies at a right angle to the outgoing direction; stripes along the mirror's axis.
    """
    axes = camera_from_projector.rotation.T
    axis = axes[0] if horizontal else -axes[1]
    out = axes[2]
    back = np.cross(axis, out)
    centre = camera_from_projector.translation
    laser = centre + projection.laser_mm * back
    offset = float(rng.uniform(*projection.mirror_offset_mm))
    tilt = np.radians(projection.sheet_tilt_deg) * (1.0 + 0.3 * rng.standard_normal())
    target = centre + projection.aim_mm * rng.standard_normal() * out
    aim = (target - laser) / np.linalg.norm(target - laser)
    upright = np.cross(axis, aim)
    sheet = np.cos(tilt) * upright / np.linalg.norm(upright) + np.sin(tilt) * axis
    sheet = sheet - (sheet @ aim) * aim
    zero = (out + back) / np.sqrt(2.0)
    full = MirrorProjector(
        stripes, axis, centre, zero, offset, laser, sheet / np.linalg.norm(sheet), aim, 0.0, 1.0
    )
    theta = full.angle(points)
    fan = float(1.05 * np.abs(full.fan_tangent(points, theta)).max())
    first, last = _sweep(points, theta, horizontal, projection.margin)
    return replace(
        full,
        first_angle=first,
        sweep_angle=last - first,
        fan=fan,
        smile_stripes=projection.smile_stripes,
    )


def build_pinhole(
    camera_from_projector: RigidTransform,
    stripes: int,
    horizontal: bool,
    points: Array,
    projection: Projection,
    rng: np.random.Generator,
) -> PinholeProjector:
    """Build a projector with a lens in the projector's position; k1 and k2 bow its sheets."""
    x, y, z = camera_from_projector.rotation.T
    rows = np.stack([x, y, z] if horizontal else [-y, x, z])
    k1 = projection.k1 * (1.0 + 0.2 * rng.standard_normal())
    k2 = projection.k2 * (1.0 + 0.2 * rng.standard_normal())
    centre = camera_from_projector.translation
    full = PinholeProjector(stripes, rows, centre, 0.0, 1.0, 1e9, k1, k2)
    along, across = full.slide(points)
    first, last = _sweep(points, across, horizontal, projection.margin)
    half = float(1.05 * np.abs(along).max())
    bow = projection.smile_stripes
    return replace(full, first=first, last=last, half=half, smile_stripes=bow)


def _sweep(points: Array, values: Array, horizontal: bool, margin: float) -> tuple[float, float]:
    """Bound values (N,) at points (N, 3): first and last, down the image or to its right."""
    low, high = float(values.min()), float(values.max())
    low, high = low - margin * (high - low), high + margin * (high - low)
    image = points[:, 1 if horizontal else 0] / points[:, 2]
    return (low, high) if np.corrcoef(image, values)[0, 1] > 0 else (high, low)


def build_room(pairs: Iterable[TruePair], room: Room) -> tuple[Surface, ...]:
    """Build the floor at z = 0 and four walls, rig frame."""
    positions = np.stack([pair.rig_from_camera.translation for pair in pairs])
    half = max(room.wall_mm, 2.0 * float(np.linalg.norm(positions[:, :2], axis=1).max()))
    x, y = np.array([2.0 * half, 0.0, 0.0]), np.array([0.0, 2.0 * half, 0.0])
    up, corner = np.array([0.0, 0.0, 3.0 * half]), np.array([-half, -half, 0.0])
    walls = [(corner, x, up), (corner, y, up), (corner + y, x, up), (corner + x, y, up)]
    floor = build_grid_surface(corner, x, y, albedo=room.floor, encloses=True)
    return (floor, *(build_grid_surface(*wall, albedo=room.wall, encloses=True) for wall in walls))
