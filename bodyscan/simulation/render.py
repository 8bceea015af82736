"""From a scene, a camera and a projector to images: rays, light, and what the lens makes of it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from bodyscan.arrays import Array, Floats, Mask
from bodyscan.rig.frame_names import FrameNames
from bodyscan.simulation.flicker import Brightness
from bodyscan.simulation.gray import LightTable, light_table, table_index
from bodyscan.simulation.inter_reflection import LitFacets, light_facets
from bodyscan.simulation.lamps import Lamps, laser_light, room_light
from bodyscan.simulation.lens import TrueCamera, sample_directions
from bodyscan.simulation.patterns import projected_patterns
from bodyscan.simulation.projector import Projector
from bodyscan.simulation.scene import Hits, Scene
from bodyscan.simulation.sensor import add_speckle, blur, off_focus, shade
from bodyscan.simulation.settings import InterReflection, Optics, Projection
from bodyscan.simulation.skin import spread_light
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

    def rays_of(self, chosen: Mask) -> Floats:
        """Rays (pixels * samples, 3) of the pixels chosen (H, W)."""
        samples = self.optics.samples**2
        parts = [rays.reshape(-1, samples, 3)[chosen[rows].ravel()] for rows, rays in self.bands]
        return np.concatenate(parts).reshape(-1, 3)


@dataclass(frozen=True, eq=False)
class Moving:
    """What moves while a sequence is taken.

    surfaces: so many do, the first of the scene's.  at: the scene when a frame of that name is
    taken.  reach_mm: how far anything goes from where it is in the scene that all else is seen in.
    """

    surfaces: int
    at: Callable[[str], Scene]
    reach_mm: float


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
    moving: Moving | None = None,
    flicker: Mapping[str, Brightness] | None = None,
) -> dict[str, Floats]:
    """Images without sensor noise, (height, width) float32 grey levels, by frame name.

    scene: in the camera's frame.  rng: for the laser's jitter and speckle.  moving: pixels near it are
    cast anew for every frame; shadows that it throws on what is still stay where they are.  flicker:
    of frames that are not as bright as the others (its gain is left to `sensor.expose`).
    With `sequence` the whole stripe sequence (lit, dark and those of the code: Gray with inverses
    if none is given), else lit alone. The dark image of a stripe-index rig, which its instrument
    keeps to itself, is named "". `sensor.expose` makes 8-bit images of them.
    """
    frames = frames or FrameNames()
    code = code or Gray(stripes=projector.stripes, direction="vertical")
    lit = _tables(code, projection, rng, frames, sequence)
    dark = frames.dark if code.uses_dark else None if code.is_projected else ""
    unlit = () if dark is None or not sequence else (dark,)
    source = _Source(projector, lamps, projection, view.optics.samples**2)
    seen = _see(scene, view, source, lit, unlit, moving.surfaces if moving else 0)
    if moving is not None:
        _see_again(seen, view, source, lit, moving)
    if inter_reflection is not None and inter_reflection.facet_mm > 0:
        between = _Between.of(scene, source, lit, inter_reflection)
        between.add_to(seen.laser, scene, view)
    for name in lit:
        light = seen.laser[name]
        light = spread_light(light, seen.skin, seen.depth, view.camera.alpha, lamps.skin)
        seen.laser[name] = light + seen.gloss[name] if name in seen.gloss else light
    for name, now in (flicker or {}).items():
        if name in seen.laser:
            seen.laser[name] *= np.float32(now.laser)
            seen.ambient[name] = seen.ambient[name] * np.float32(now.room)
    shading, focus = shade(view.camera, view.optics), off_focus(seen.depth, lamps.focus_mm)
    return {
        name: blur(
            (add_speckle(light, projection.speckle, rng) + seen.ambient[name]) * shading,
            view.optics,
            focus,
        )
        for name, light in seen.laser.items()
    }


@dataclass(frozen=True, eq=False)
class _Source:
    """What lights the ends of rays, of which each pixel has several."""

    projector: Projector
    lamps: Lamps
    projection: Projection
    samples: int


@dataclass(frozen=True, eq=False)
class _Seen:
    """What a camera sees before its lens blurs it: grey levels (H, W).

    laser, ambient: by frame, of the projector's light and of the room's.  depth: (H, W) mm, the least
    in each pixel.  near: (H, W) where something shows that moves.  gloss: by frame, of the projector's
    light what skin mirrors; none where nothing is glossy.  skin: (H, W) the share that is skin.
    """

    laser: dict[str, Floats]
    ambient: dict[str, Floats]
    depth: Floats
    near: Mask
    gloss: dict[str, Floats]
    skin: Floats


def _see(
    scene: Scene,
    view: View,
    source: _Source,
    lit: Mapping[str, LightTable],
    unlit: tuple[str, ...],
    moving_surfaces: int,
) -> _Seen:
    """Every frame of a scene in which nothing moves; its first surfaces will."""
    shape = (view.camera.height, view.camera.width)
    laser = {name: np.zeros(shape, np.float32) for name in (*lit, *unlit)}
    ambient, depth = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
    near, skin = np.zeros(shape, bool), np.zeros(shape, np.float32)
    glossy = lit if source.lamps.skin.gloss > 0 else {}
    gloss = {name: np.zeros(shape, np.float32) for name in glossy}
    for rows, directions in view.bands:
        rays = _LitRays.of(scene, directions, source)
        for name, table in lit.items():
            laser[name][rows] = rays.light(table).reshape(-1, shape[1])
        ambient[rows] = rays.ambient(source.lamps).reshape(-1, shape[1])
        depth[rows] = rays.nearest().reshape(-1, shape[1])
        near[rows] = rays.on_first(moving_surfaces).reshape(-1, shape[1])
        skin[rows] = rays.skin().reshape(-1, shape[1])
        for name in gloss:
            gloss[name][rows] = rays.mirrored(lit[name]).reshape(-1, shape[1])
    return _Seen(laser, dict.fromkeys(laser, ambient), depth, near, gloss, skin)


def _see_again(
    seen: _Seen, view: View, source: _Source, lit: Mapping[str, LightTable], moving: Moving
) -> None:
    """What moves, and what it covers and uncovers, as it is when each frame is taken."""
    near = _reached(seen.near, seen.depth, moving.reach_mm, view.camera)
    directions = view.rays_of(near)
    for name in seen.laser:
        rays = _LitRays.of(moving.at(name), directions, source)
        seen.ambient[name] = seen.ambient[name].copy()
        seen.ambient[name][near] = rays.ambient(source.lamps)
        if name in lit:
            seen.laser[name][near] = rays.light(lit[name])
        if name in seen.gloss:
            seen.gloss[name][near] = rays.mirrored(lit[name])


@dataclass(frozen=True, eq=False)
class _LitRays:
    """Rays of some pixels, several each, with the projector's light where they end.

    weight, gloss: (rays,) grey level under full light, scattered and mirrored.  index: into a table
    of light.
    """

    hits: Hits
    weight: Floats
    gloss: Floats | None
    index: NDArray[np.int32]
    samples: int

    @staticmethod
    def of(scene: Scene, directions: Floats, source: _Source) -> _LitRays:
        hits = scene.cast(directions)
        light = laser_light(scene, hits, source.projector, source.lamps)
        blurs = _blur_rows(hits, source.projection, source.lamps)
        index = table_index(light.s, source.projector.stripes, blurs)
        return _LitRays(hits, light.weight, light.gloss, index, source.samples)

    def light(self, table: LightTable) -> Floats:
        """(pixels,) grey level of one frame."""
        return _pixels(self.weight, table.at(self.index), self.samples)

    def mirrored(self, table: LightTable) -> Floats:
        """(pixels,) the part of one frame that glossy skin mirrors."""
        if self.gloss is None:
            return np.zeros(len(self.index) // self.samples, np.float32)
        return _pixels(self.gloss, table.at(self.index), self.samples)

    def skin(self) -> Floats:
        """(pixels,) the share that is skin."""
        return _pixels(self.hits.skin, np.ones_like(self.hits.skin), self.samples)

    def ambient(self, lamps: Lamps) -> Floats:
        """(pixels,) grey level by the room's own light."""
        return _pixels(self.hits.albedo, room_light(self.hits, lamps), self.samples)

    def nearest(self) -> Floats:
        """(pixels,) the least depth, mm."""
        return self.hits.depth.reshape(-1, self.samples).min(axis=1)

    def on_first(self, surfaces: int) -> Mask:
        """(pixels,) whether any ray ends on one of the first surfaces."""
        return np.asarray((self.hits.surface < surfaces).reshape(-1, self.samples).any(axis=1))


def _reached(near: Mask, depth: Floats, reach_mm: float, camera: TrueCamera) -> Mask:
    """Pixels that something may come to which shows at those `near` (H, W), at most so far away."""
    if not near.any():
        return near
    pixels = int(np.ceil(reach_mm * camera.alpha / float(depth[near].min()))) + 2
    kernel = np.ones((2 * pixels + 1, 2 * pixels + 1), np.uint8)
    grown = np.asarray(cv2.dilate(near.astype(np.uint8), kernel), np.uint8)
    return grown.astype(bool)


@dataclass(frozen=True, eq=False)
class _Between:
    """Light between surfaces. radiosity: (frames, facets) grey levels, in the order of `names`."""

    names: tuple[str, ...]
    facets: LitFacets
    radiosity: Floats

    @staticmethod
    def of(
        scene: Scene,
        source: _Source,
        tables: Mapping[str, LightTable],
        chosen: InterReflection,
    ) -> _Between:
        facets = light_facets(scene, source.projector, source.lamps, chosen.facet_mm)
        blur = _blur_rows(facets.samples, source.projection, source.lamps)
        index = table_index(facets.s, source.projector.stripes, blur)
        light = np.stack([facets.radiosity(table.at(index)) for table in tables.values()])
        return _Between(tuple(tables), facets, light)

    def add_to(self, laser: dict[str, Floats], scene: Scene, view: View) -> None:
        """What pixels get of it, to every frame (H, W): it changes slowly, one sample of each tells."""
        samples = view.optics.samples**2
        for rows, directions in view.bands:
            hits = scene.cast(directions)
            middle = Hits(*(getattr(hits, f.name)[samples // 2 :: samples] for f in fields(Hits)))
            albedo = _pixels(hits.albedo, np.ones_like(hits.albedo), samples)
            found = self.facets.irradiance(middle, self.radiosity)
            for name, light in zip(self.names, found, strict=True):
                laser[name][rows] += (albedo * light).reshape(-1, view.camera.width)


def _pixels(weight: Floats, light: Floats, samples: int) -> Floats:
    """Mean over each pixel's samples of weight times light."""
    total = np.einsum("ij,ij->i", weight.reshape(-1, samples), light.reshape(-1, samples))
    return total * np.float32(1.0 / samples)


def pixel_truth(scene: Scene, camera: TrueCamera, projector: Projector) -> PixelTruth:
    """Depth and stripe coordinate at the pixels' centres."""
    directions = camera.directions(camera.grid()).reshape(-1, 3)
    hits = scene.cast(directions.astype(np.float32))
    depth = np.where(np.isfinite(hits.depth), hits.depth, np.nan).astype(float)
    weight = laser_light(scene, hits, projector, Lamps(1.0, 0.0, 1.0, 1.0)).weight
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
    lights = _lights(code, frames, projection.gamma)
    lights = lights if sequence else lights[:1]
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
        for name, light in _lights(code, frames, projection.gamma)
    )


def _lights(code: StripeCode, frames: FrameNames, gamma: float) -> list[tuple[str, Array]]:
    """Lit and the code's images: name, and light along the sweep."""
    coded = projected_patterns(code, frames)
    if gamma != 1.0:
        coded = {name: light**gamma for name, light in coded.items()}
    return [(frames.lit or "lit", np.ones(code.stripes)), *coded.items()]


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
