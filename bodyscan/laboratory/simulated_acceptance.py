"""Spheres and a plate put into a simulated rig, captured, and measured pose by pose."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import open3d as o3d

from bodyscan.arrays import Array
from bodyscan.captures.folder import open_scan
from bodyscan.errors import BadInput
from bodyscan.evaluation.acceptance import AcceptanceFile, Readings
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.progress import Progress, map_threads, silent
from bodyscan.registration.rig_calibration import RigCalibration
from bodyscan.rig.rig import Rig, Volume, load_rig
from bodyscan.simulation import files
from bodyscan.simulation.layout import TruePair, build_room
from bodyscan.simulation.presets import settings_from_dict
from bodyscan.simulation.rays import View
from bodyscan.simulation.scene import Surface, grid_surface
from bodyscan.simulation.sensor import fixed_pattern
from bodyscan.simulation.settings import SimulationSettings
from bodyscan.simulation.simulate import Stream, Task, draw_true_pairs, random_stream, render_task
from bodyscan.workflows.accept_rig import read_plates, read_spheres


@dataclass(frozen=True, eq=False)
class SimulatedRig:
    """The rig of a workspace as it truly is."""

    rig: Rig
    settings: SimulationSettings
    seed: int
    pairs: dict[str, TruePair]


def open_workspace(workspace: Path) -> SimulatedRig:
    """Rebuild the rig that `bodyscan simulate` built there; BadInput if another version made it."""
    remedy = "give a folder that this version of `bodyscan simulate` wrote"
    try:
        truth = json.loads((workspace / "truth" / "truth.json").read_text("utf-8"))
        settings, seed = settings_from_dict(truth["settings"]), int(truth["seed"])
        stored_poses = {name: pair["rig_from_camera"] for name, pair in truth["pairs"].items()}
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise BadInput(
            f"is not a simulated workspace ({type(error).__name__}: {error})",
            where=str(workspace),
            remedy=remedy,
        ) from error
    rig = load_rig(workspace / "rig.yaml")
    pairs = draw_true_pairs(rig, settings, seed)
    for name, pair in pairs.items():
        if not np.allclose(pair.rig_from_camera.matrix, stored_poses.get(name, np.nan), atol=1e-6):
            raise BadInput(
                f"pair {name} stands elsewhere than its truth says",
                where=str(workspace),
                remedy=remedy,
            )
    return SimulatedRig(rig, settings, seed, pairs)


def sphere_surfaces(centres: Array, radius_mm: float) -> tuple[Surface, ...]:
    """Build white balls at centres (N, 3)."""
    # Facets of a 60 mm sphere are then less than 0.002 mm inside it.
    mesh = o3d.geometry.TriangleMesh.create_sphere(radius_mm, resolution=200)
    arms, triangles = np.asarray(mesh.vertices), np.asarray(mesh.triangles)
    return tuple(
        Surface(arms + centre, triangles, 0.7, normals=arms / radius_mm) for centre in centres
    )


def plate_surface(width_mm: float, height_mm: float) -> tuple[Surface, ...]:
    """Build a white plate in the plane x = 0, centred on the origin, visible from either side."""
    across, up = np.array([0.0, width_mm, 0.0]), np.array([0.0, 0.0, height_mm])
    return (grid_surface(-0.5 * (across + up), across, up, albedo=0.7),)


def capture_artefact(
    simulated: SimulatedRig,
    surfaces: Sequence[Surface],
    rig_from_artefact: RigidTransform,
    out: Path,
    *,
    shots: int = 1,
    number: int = 0,
    progress: Progress = silent,
) -> Path:
    """Write a scan folder `out` of the artefact in one pose, taken `shots` times.

    number: of the place; every place and shot has its own noise. Pairs that do not see the artefact
        take no part.
    """
    rig, settings = simulated.rig, simulated.settings
    room = build_room(simulated.pairs.values(), settings.room)
    order = {name: k for k, name in enumerate(simulated.pairs)}
    taking = [
        pair
        for pair in simulated.pairs.values()
        if pair.has_stripes and _in_picture(pair, surfaces, rig_from_artefact)
    ]
    names = [f"s{k + 1:02d}" for k in range(shots)]

    def work(pair: TruePair) -> None:
        rays = random_stream(simulated.seed, Stream.ARTEFACT_RAYS, order[pair.name])
        view = View.from_camera(pair.camera, settings.optics, rays)
        pixels = random_stream(simulated.seed, Stream.PIXELS, order[pair.name])
        fixed = fixed_pattern(pair.camera, settings.noise, pixels)
        for k, name in enumerate(names):
            purpose = Stream.ARTEFACT_NOISE, order[pair.name], number, k
            task = Task(k, name, out.name, tuple(surfaces), rig_from_artefact, 225.0, True)
            noise = random_stream(simulated.seed, *purpose)
            render_task(rig, pair, view, room, task, settings, out.parent, noise, fixed)

    map_threads(work, taking, stage=f"simulating {out.name}", progress=progress)
    striped = [pair.name for pair in taking]
    files.write_captures(out, "scan", [(name, striped, []) for name in names], "sim-artefact")
    return out


def _in_picture(
    pair: TruePair, surfaces: Sequence[Surface], rig_from_artefact: RigidTransform
) -> bool:
    camera_from_artefact = pair.rig_from_camera.inverse() @ rig_from_artefact
    points = camera_from_artefact.apply(np.concatenate([s.vertices for s in surfaces]))
    points = points[points[:, 2] > 1.0]
    u, v = pair.camera.image(points).T
    return bool(np.any((u >= 0) & (v >= 0) & (u < pair.camera.width) & (v < pair.camera.height)))


SPHERES = (
    ("middle, across", (0.0, 0.0, 0.45), (0.0, 1.0, 0.0)),
    ("middle, upright", (0.0, 0.0, 0.5), (0.0, 0.0, 1.0)),
    ("low, front", (0.25, 0.1, 0.25), (0.6, 0.8, 0.0)),
    ("high, left", (0.0, 0.25, 0.65), (1.0, 0.0, 0.0)),
    ("through the middle", (0.0, -0.1, 0.4), (0.5, 0.5, 0.7)),
)
"""Name; middle as shares of the volume's radius (x, y) and height (z); direction of the bar."""
PLATES = (
    ("middle, facing front", (0.0, 0.0, 0.45), (1.0, 0.0, 0.0)),
    ("left, facing left and back", (-0.1, 0.25, 0.5), (-0.8, 0.6, 0.0)),
    ("low, tilted up", (0.2, -0.1, 0.3), (0.7, -0.4, 0.5)),
)
"""Name, middle, and the direction the plate faces."""


def simulate_readings(
    calibration: RigCalibration,
    workspace: Path,
    file: AcceptanceFile,
    repeats: int,
    max_poses: int | None,
    progress: Progress = silent,
) -> Readings:
    """Measure `repeats` shots of the spheres and one of the plate in each of the first `max_poses`.

    The images of a pose are measured and deleted before the next one's are made.
    """
    world = open_workspace(workspace)
    centres, volume = np.array(file.spheres.centres_mm), calibration.rig.volume
    balls = sphere_surfaces(centres, file.spheres.radius_mm)
    flat = plate_surface(*file.plate.size_mm)
    of_spheres = [
        (name, at, balls, repeats, read_spheres)
        for name, at in spheres_at(volume, centres)[:max_poses]
    ]
    of_plates = [(name, at, flat, 1, read_plates) for name, at in plates_at(volume)[:max_poses]]
    total = Readings()
    for number, (name, at, surfaces, shots, read) in enumerate([*of_spheres, *of_plates]):
        with TemporaryDirectory(prefix="bodyscan-") as folder:
            out = Path(folder) / f"pose-{number + 1}"
            taken = capture_artefact(
                world, surfaces, at, out, shots=shots, number=number, progress=progress
            )
            total += read(calibration, open_scan(calibration.rig, taken), name, file, progress)
    return total


def spheres_at(volume: Volume, centres: Array) -> list[tuple[str, RigidTransform]]:
    """List names and `rig_from_artefact` of a bar of spheres with centres (N, 3)."""
    middle = centres.mean(axis=0)
    return [
        (name, _pose_in_volume(volume, share, direction, middle))
        for name, share, direction in SPHERES
    ]


def plates_at(volume: Volume) -> list[tuple[str, RigidTransform]]:
    """List names and `rig_from_artefact` of a plate in the plane x = 0 about the origin."""
    return [
        (name, _pose_in_volume(volume, share, direction, np.zeros(3)))
        for name, share, direction in PLATES
    ]


def _pose_in_volume(
    volume: Volume,
    share: tuple[float, float, float],
    direction: tuple[float, float, float],
    middle: Array,
) -> RigidTransform:
    """Put an artefact's `middle` at `share` of the volume, x along `direction`, y level."""
    x = np.array(direction) / np.linalg.norm(direction)
    level = np.cross([0.0, 0.0, 1.0], x)
    y = level / np.linalg.norm(level) if np.linalg.norm(level) > 1e-9 else np.array([0.0, 1, 0])
    rotation = np.stack([x, y, np.cross(x, y)], axis=1)
    height = volume.bottom_mm + share[2] * (volume.top_mm - volume.bottom_mm)
    target = np.array([share[0] * volume.radius_mm, share[1] * volume.radius_mm, height])
    return RigidTransform(rotation, target - rotation @ middle)
