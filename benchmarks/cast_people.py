"""Range images of a simulated person by ray casting, without rendering images.

A scan at full size takes a quarter of an hour to render; this takes seconds. Depths and
calibration have the errors of rendered scans (`bench/standing`, full size, workshop).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np

from benchmarks.true_calibration import calibration_from_facts
from bodyscan.arrays import Array, Indices
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.reconstruction.range_image import RangeImage
from bodyscan.registration.rig_calibration import RigCalibration
from bodyscan.rig.rig import Rig, load_rig
from bodyscan.simulation.body import load_subject
from bodyscan.simulation.files import compute_person_times, describe_camera, scale_rig
from bodyscan.simulation.lamps import Lamps, compute_laser_light
from bodyscan.simulation.layout import TruePair
from bodyscan.simulation.living import LivingBody, animate
from bodyscan.simulation.presets import compose_settings
from bodyscan.simulation.projector import MirrorProjector
from bodyscan.simulation.scene import Hits, Scene
from bodyscan.simulation.settings import Pace
from bodyscan.simulation.simulate import CALIBRATION, PERSON_SHOT, draw_true_pairs

PROJECT = Path(__file__).parents[1]
SCALE = 0.45
"""Image scale: pixels of 2 mm. With larger ones poles share too little to be tied."""
NOISE_MM = 0.09
"""Noise of a pixel that faces the camera; for a slanting one it grows as 1 / cosine."""
COMMON_MM = 0.04
"""Common error of all depths of a pair, due to its light planes."""
SHIFT_MM, TURN_DEG = 0.045, 0.0023
"""Pose error of each pair, at the person."""
LEAST_COSINE = 0.2
STANCE_DEG, STANCE_MM = 5.0, 15.0
"""Variation when people are asked to stand on the same marks again."""


@dataclass(frozen=True, eq=False)
class CastScan:
    """A cast scan and its truth.

    images: of each pair.
    body, moment_ms: the true body, and the scan's moment.
    stance: where the person stood, from the body's frame.
    """

    calibration: RigCalibration
    images: tuple[RangeImage, ...]
    body: LivingBody
    stance: RigidTransform
    moment_ms: float

    @property
    def faces(self) -> Indices:
        return np.asarray(self.body.rest.triangles, np.int64)

    def vertices(self, ms: float | None = None, *, breathing: bool = True) -> Array:
        """True vertices (N, 3) mm, rig frame; by default in the middle of the scan."""
        moment = self.moment_ms if ms is None else ms
        return self.stance.apply(self.body.vertices(moment, breathing=breathing))


def cast_person(
    rig_name: str,
    subject: str,
    preset: str,
    seed: int,
    *,
    start: Literal["one-after-another", "together", "poles"] = "one-after-another",
    size: float = 1.0,
) -> CastScan:
    """Cast a person of `data/subjects` and of `presets.SUBJECTS`; everything random follows from
    the seed.

    size: of the body, besides the preset's.
    """
    rng = np.random.default_rng([seed, 1])
    full = load_rig(PROJECT / "rigs" / f"{rig_name}.yaml")
    rig = scale_rig(full, SCALE, CALIBRATION)
    settings = compose_settings("mirror", preset="workshop", subject=preset)
    person = replace(settings.person, size=size * settings.person.size, subdivisions=1)
    pairs = draw_true_pairs(rig, settings, seed)
    still = load_subject(PROJECT / "data" / "subjects" / f"{subject}.ply", person, rng)
    body = animate(still, person, rng)
    turn = np.array([0.0, 0.0, np.radians(STANCE_DEG) * rng.standard_normal()])
    shift = STANCE_MM * rng.standard_normal(3) * [1.0, 1.0, 0.0]
    stance = RigidTransform.from_rotation_vector(turn, shift)
    frames = compute_person_times(full, PERSON_SHOT, Pace(start=start)).items()
    moments = {name: 0.5 * (min(ms.values()) + max(ms.values())) for name, ms in frames}
    middle = 0.5 * (min(moments.values()) + max(moments.values()))
    calibration = _calibrated(rig, pairs, seed)
    images = tuple(
        _cast(pair, calibration, CastScan(calibration, (), body, stance, moments[name]), rng)
        for name, pair in pairs.items()
    )
    return CastScan(calibration, images, body, stance, middle)


def _calibrated(rig: Rig, pairs: Mapping[str, TruePair], seed: int) -> RigCalibration:
    facts = {}
    for name, pair in pairs.items():
        assert isinstance(pair.projector, MirrorProjector)
        facts[name] = {
            "camera": describe_camera(pair.camera),
            "rig_from_camera": pair.rig_from_camera.matrix,
            "boundary_planes": pair.projector.plane(np.arange(pair.projector.stripes + 1.0)),
        }
    return calibration_from_facts(rig, facts, seed, shift_mm=SHIFT_MM, turn_deg=TURN_DEG)


def _cast(
    pair: TruePair, calibration: RigCalibration, scan: CastScan, rng: np.random.Generator
) -> RangeImage:
    """The pair's range image for the scan's moment."""
    grid = pair.camera.width * np.arange(pair.camera.height)[:, None]
    pixels = np.stack(np.divmod(grid + np.arange(pair.camera.width), pair.camera.width), axis=-1)
    rays = pair.camera.directions(pixels[..., ::-1].reshape(-1, 2).astype(float))
    depth, normals = _seen(pair, rays, scan, scan.moment_ms)
    towards = np.sum(normals * rays, axis=1)
    cosine = np.abs(towards) / np.linalg.norm(rays, axis=1)
    depth[cosine < LEAST_COSINE] = np.nan
    sigma = np.where(np.isfinite(depth), NOISE_MM / np.maximum(cosine, LEAST_COSINE), np.nan)
    off = sigma * rng.standard_normal(len(depth)) + COMMON_MM * rng.standard_normal()
    shape = pair.camera.height, pair.camera.width
    return RangeImage(
        pair.name,
        calibration.pairs[pair.name].camera,
        (rays * (depth + off)[:, None]).reshape(*shape, 3).astype(np.float32),
        (-np.sign(towards)[:, None] * normals).reshape(*shape, 3).astype(np.float32),
        np.hypot(sigma, COMMON_MM).reshape(shape).astype(np.float32),
        np.where(np.isfinite(depth), 40.0 + 200.0 * cosine, 0.0).reshape(shape).astype(np.uint8),
        time_ms=scan.moment_ms,
        common_mm=np.full(shape, COMMON_MM, np.float32),
    )


def _seen(pair: TruePair, rays: Array, scan: CastScan, ms: float) -> tuple[Array, Array]:
    """Depths (N,) of rays (N, 3), NaN where nothing is lit, and normals (N, 3)."""
    surface = replace(scan.body.surface(ms), vertices=scan.vertices(ms))
    surface = replace(surface, normals=scan.stance.rotate(np.asarray(surface.normals)))
    scene = Scene([surface.transform(pair.rig_from_camera.inverse())])
    hits: Hits = scene.cast(rays.astype(np.float32))
    lit = compute_laser_light(scene, hits, pair.projector, Lamps(1.0, 0.0, 1.0, 1.0)).weight > 0.0
    normals = hits.normals.astype(np.float64)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    return np.where(lit, hits.depth, np.nan).astype(np.float64), normals
