"""From a scene, a camera and a projector to images: rays, light, and what the lens makes of it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from bodyscan.arrays import Array, Floats
from bodyscan.rig.frame_names import FrameNames
from bodyscan.simulation.gray import LightTable, light_table, table_index
from bodyscan.simulation.inter_reflection import LitFacets, light_facets
from bodyscan.simulation.lamps import Lamps, laser_light
from bodyscan.simulation.lens import TrueCamera, sample_directions
from bodyscan.simulation.patterns import projected_patterns
from bodyscan.simulation.projector import Projector
from bodyscan.simulation.scene import Hits, Scene
from bodyscan.simulation.sensor import add_speckle, blur, off_focus, shade
from bodyscan.simulation.settings import InterReflection, Optics, Projection
from bodyscan.stripes.codes.gray import Gray
from bodyscan.stripes.stripe_code import StripeCode

_BAND = 250_000
_DEFOCUS_STEPS = 12


@dataclass(frozen=True, eq=False)
class View:
    """A camera's rays, several a pixel, kept for all its shots.

    bands: rows of the image, and their rays (rows * width * samples, 3).
    """

    camera: TrueCamera
    optics: Optics
    bands: tuple[tuple[slice, Floats], ...]

    @staticmethod
    def of(camera: TrueCamera, optics: Optics, rng: np.random.Generator) -> View:
        """Rays through places inside each pixel that `rng` shifts."""
        rows = max(1, _BAND // (camera.width * optics.samples**2))
        cuts = [slice(r, min(r + rows, camera.height)) for r in range(0, camera.height, rows)]
        bands = [(cut, sample_directions(camera, optics.samples, rng, cut)) for cut in cuts]
        return View(camera, optics, tuple(bands))


@dataclass(frozen=True, eq=False)
class PixelTruth:
    """What lies at each pixel's centre. depth: (height, width) mm along z, NaN where nothing is.

    s: stripe coordinate, NaN where no light of the projector arrives.
    """

    depth: Array
    s: Array


def render_pair(
    scene: Scene,
    view: View,
    projector: Projector,
    lamps: Lamps,
    projection: Projection,
    rng: np.random.Generator,
    *,
    frames: FrameNames | None = None,
    code: StripeCode | None = None,
    sequence: bool = True,
    inter_reflection: InterReflection | None = None,
) -> dict[str, Floats]:
    """Images without sensor noise, (height, width) float32 grey levels, by frame name.

    scene: in the camera's frame.  rng: for the laser's jitter and speckle.
    With `sequence` the whole stripe sequence (lit, dark and those of the code: Gray with inverses
    if none is given), else lit alone. The dark image of a stripe-index rig, which its instrument
    keeps to itself, is named "". `sensor.expose` makes 8-bit images of them.
    """
    frames = frames or FrameNames()
    code = code or Gray(stripes=projector.stripes, direction="vertical")
    tables = _tables(code, projection, rng, frames, sequence)
    shape = (view.camera.height, view.camera.width)
    laser = {name: np.zeros(shape, np.float32) for name in tables}
    ambient, depth = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
    between = None
    if inter_reflection is not None and inter_reflection.facet_mm > 0:
        between = _Between.of(scene, projector, lamps, projection, tables, inter_reflection)
    samples = view.optics.samples**2
    for rows, directions in view.bands:
        hits = scene.cast(directions)
        weight, s = laser_light(scene, hits, projector, lamps)
        index = table_index(s, projector.stripes, _blur_rows(hits, projection, lamps))
        for name, table in tables.items():
            laser[name][rows] = _pixels(weight, table.at(index), samples).reshape(-1, shape[1])
        white = np.full_like(s, lamps.ambient_grey)
        ambient[rows] = _pixels(hits.albedo, white, samples).reshape(-1, shape[1])
        if between is not None:
            albedo = _pixels(hits.albedo, np.ones_like(s), samples)
            for name, light in between.at(hits, samples).items():
                laser[name][rows] += (albedo * light).reshape(-1, shape[1])
        depth[rows] = hits.depth.reshape(-1, samples).min(axis=1).reshape(-1, shape[1])
    dark = frames.dark if code.uses_dark else None if code.is_projected else ""
    if sequence and dark is not None:
        laser[dark] = np.zeros(shape, np.float32)
    shading, focus = shade(view.camera, view.optics), off_focus(depth, lamps.focus_mm)
    return {
        name: blur(
            (add_speckle(light, projection.speckle, rng) + ambient) * shading, view.optics, focus
        )
        for name, light in laser.items()
    }


@dataclass(frozen=True, eq=False)
class _Between:
    """Light between surfaces. radiosity: (frames, facets) grey levels, in the order of `names`."""

    names: tuple[str, ...]
    facets: LitFacets
    radiosity: Floats

    @staticmethod
    def of(
        scene: Scene,
        projector: Projector,
        lamps: Lamps,
        projection: Projection,
        tables: Mapping[str, LightTable],
        chosen: InterReflection,
    ) -> _Between:
        facets = light_facets(scene, projector, lamps, chosen.facet_mm)
        blur = _blur_rows(facets.samples, projection, lamps)
        index = table_index(facets.s, projector.stripes, blur)
        light = np.stack([facets.radiosity(table.at(index)) for table in tables.values()])
        return _Between(tuple(tables), facets, light)

    def at(self, hits: Hits, samples: int) -> dict[str, Floats]:
        """By frame, what white pixels get (pixels,): it changes slowly, one sample of each tells."""
        middle = Hits(*(getattr(hits, f.name)[samples // 2 :: samples] for f in fields(Hits)))
        found = self.facets.irradiance(middle, self.radiosity)
        return dict(zip(self.names, found, strict=True))


def _pixels(weight: Floats, light: Floats, samples: int) -> Floats:
    """Mean over each pixel's samples of weight times light."""
    total = np.einsum("ij,ij->i", weight.reshape(-1, samples), light.reshape(-1, samples))
    return total * np.float32(1.0 / samples)


def pixel_truth(scene: Scene, camera: TrueCamera, projector: Projector) -> PixelTruth:
    """Depth and stripe coordinate at the pixels' centres."""
    directions = camera.directions(camera.grid()).reshape(-1, 3)
    hits = scene.cast(directions.astype(np.float32))
    depth = np.where(np.isfinite(hits.depth), hits.depth, np.nan).astype(float)
    weight, _ = laser_light(scene, hits, projector, Lamps(1.0, 0.0, 1.0, 1.0))
    s = projector.stripe(directions * depth[:, None])
    lit = (weight > 0) & (s >= 0) & (s <= projector.stripes)
    shape = (camera.height, camera.width)
    return PixelTruth(depth.reshape(shape), np.where(lit, s, np.nan).reshape(shape))


def _tables(
    code: StripeCode,
    projection: Projection,
    rng: np.random.Generator,
    frames: FrameNames,
    sequence: bool,
) -> dict[str, LightTable]:
    """A table of light for each frame that the laser lights."""
    if projection.jitter_stripes <= 0:
        steady = _steady_tables(code, frames, projection)
        return dict(steady if sequence else steady[:1])
    lights = _lights(code, frames) if sequence else _lights(code, frames)[:1]
    strays = projection.jitter_stripes * rng.standard_normal((len(lights), code.stripes + 1))
    blurs = _blurs(projection)
    return {
        name: light_table(light, blurs, stray, len(light) // code.stripes)
        for (name, light), stray in zip(lights, strays, strict=True)
    }


@lru_cache(maxsize=8)
def _steady_tables(
    code: StripeCode, frames: FrameNames, projection: Projection
) -> tuple[tuple[str, LightTable], ...]:
    """Of lit and the code's images, when no boundary strays."""
    blurs = _blurs(projection)
    return tuple(
        (name, light_table(light, blurs, parts=len(light) // code.stripes))
        for name, light in _lights(code, frames)
    )


def _lights(code: StripeCode, frames: FrameNames) -> list[tuple[str, Array]]:
    """Lit and the code's images: name, and light along the sweep."""
    return [(frames.lit or "lit", np.ones(code.stripes)), *projected_patterns(code, frames).items()]


def _blurs(projection: Projection) -> Array:
    """Standard deviations in stripes, from the best focus to the worst."""
    if projection.defocus_stripes <= 0:
        return np.array([projection.blur_stripes])
    steps = np.linspace(0.0, projection.defocus_stripes, _DEFOCUS_STEPS)
    return np.hypot(projection.blur_stripes, steps)


def _blur_rows(hits: Hits, projection: Projection, lamps: Lamps) -> NDArray[np.int32] | None:
    """Which of `_blurs` holds at each hit; its distance to the projector is about its depth."""
    if projection.defocus_stripes <= 0:
        return None
    off = off_focus(hits.depth, lamps.focus_mm)
    return np.rint(off * (_DEFOCUS_STEPS - 1)).astype(np.int32)
