"""From a scene, a camera and a projector to images: rays, light, and the effect of the lens."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from bodyscan.arrays import Array, Floats, Mask
from bodyscan.rig.frame_names import FrameNames
from bodyscan.simulation.lamps import Lamps, compute_laser_light, spread_light
from bodyscan.simulation.lens import TrueCamera
from bodyscan.simulation.patterns import find_table_entries, make_light_table, make_patterns
from bodyscan.simulation.projector import Projector
from bodyscan.simulation.rays import Band, View, average_light, trace_band
from bodyscan.simulation.scene import Scene
from bodyscan.simulation.sensor import Brightness, add_speckle, blur, defocus, list_blurs, shade
from bodyscan.simulation.settings import Projection
from bodyscan.stripes.codes.gray import Gray
from bodyscan.stripes.stripe_code import StripeCode


@dataclass(frozen=True, eq=False)
class Moving:
    """What moves while a sequence is taken."""

    surfaces: int  # how many move, the first of the scene's
    at: Callable[[str], Scene]  # the scene when a frame of that name is taken
    reach_mm: float  # largest displacement from the scene that is rendered once for all frames


@dataclass(frozen=True, eq=False)
class PixelTruth:
    """What lies at each pixel's centre."""

    depth: Array  # (height, width) mm along z, NaN where there is nothing
    s: Array  # stripe coordinate, NaN where no light of the projector arrives


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
    moving: Moving | None = None,
    flicker: Mapping[str, Brightness] | None = None,
) -> dict[str, Floats]:
    """Render images without sensor noise, (height, width) float32 grey levels, by frame name.

    scene: in the camera's frame.
    rng: for the laser's jitter and speckle.
    code: Gray with inverses if not given.
    sequence: the whole stripe sequence (lit, dark and the code's images), or lit alone. The dark
        image of a stripe-index rig, which its instrument keeps to itself, is named "".
    moving: pixels near it are cast anew for every frame; its shadows on what is still do not move.
    flicker: of frames that differ in brightness (its gain is left to `sensor.expose`).

    `sensor.expose` turns the result into 8-bit images.
    """
    frames = frames or FrameNames()
    code = code or Gray(stripes=projector.stripes, direction="vertical")
    lit = _tabulate_light(code, projection, rng, frames, sequence)
    dark = frames.dark if code.uses_dark else None if code.is_projected else ""
    unlit = () if dark is None or not sequence else (dark,)
    source = _Source(projector, lamps, projection)
    images = _render_still(scene, view, source, lit, unlit, moving.surfaces if moving else 0)
    if moving is not None:
        _rerender_moving(images, view, source, lit, moving)
    for name in lit:
        light = images.laser[name]
        light = spread_light(light, images.skin, images.depth, view.camera.alpha, lamps.skin)
        images.laser[name] = light + images.gloss[name] if name in images.gloss else light
    for name, now in (flicker or {}).items():
        if name in images.laser:
            images.laser[name] *= np.float32(now.laser)
            images.ambient[name] = images.ambient[name] * np.float32(now.room)
    shading = shade(view.camera, view.optics)
    blurs = list_blurs(view.optics, defocus(images.depth, lamps.focus_mm))
    return {
        name: blur(
            (add_speckle(light, projection.speckle, rng) + images.ambient[name]) * shading, blurs
        )
        for name, light in images.laser.items()
    }


@dataclass(frozen=True, eq=False)
class _Source:
    """What lights the ends of rays."""

    projector: Projector
    lamps: Lamps
    projection: Projection


@dataclass(frozen=True, eq=False)
class _LightImages:
    """What a camera sees before its lens blurs it: grey levels (H, W)."""

    # laser, ambient: by frame, of the projector's light and of the room's.
    laser: dict[str, Floats]
    ambient: dict[str, Floats]
    depth: Floats  # (H, W) mm, minimum over each pixel's samples
    near: Mask  # (H, W) where something that moves shows
    # By frame, the part of the projector's light that skin mirrors; empty if nothing is glossy.
    gloss: dict[str, Floats]
    skin: Floats  # (H, W) the share that is skin


def _render_still(
    scene: Scene,
    view: View,
    source: _Source,
    lit: Mapping[str, Floats],
    unlit: tuple[str, ...],
    moving_surfaces: int,
) -> _LightImages:
    """Render every frame of a still scene, whose first surfaces will move."""
    shape = (view.camera.height, view.camera.width)
    laser = {name: np.zeros(shape, np.float32) for name in (*lit, *unlit)}
    ambient, depth = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
    near, skin = np.zeros(shape, bool), np.zeros(shape, np.float32)
    glossy = lit if source.lamps.skin.gloss > 0 else {}
    gloss = {name: np.zeros(shape, np.float32) for name in glossy}
    for band in view.bands:
        rays, slices = _LitRays.cast(scene, band, source), band.slices
        for name, table in lit.items():
            laser[name][slices] = rays.light(table)
        ambient[slices], depth[slices] = rays.ambient, rays.depth
        near[slices], skin[slices] = rays.surface < moving_surfaces, rays.skin
        for name in gloss:
            gloss[name][slices] = rays.light(lit[name], gloss=True)
    return _LightImages(laser, dict.fromkeys(laser, ambient), depth, near, gloss, skin)


def _rerender_moving(
    images: _LightImages, view: View, source: _Source, lit: Mapping[str, Floats], moving: Moving
) -> None:
    """Update what moves, and what it covers and uncovers, for the moment of each frame."""
    near = _dilate(images.near, images.depth, moving.reach_mm, view.camera)
    bands = list(view.bands_around(near))
    for name in images.laser:
        scene = moving.at(name)
        images.ambient[name] = images.ambient[name].copy()
        for band in bands:
            rays, chosen = _LitRays.cast(scene, band, source), near[band.slices]
            np.copyto(images.ambient[name][band.slices], rays.ambient, where=chosen)
            if name in lit:
                np.copyto(images.laser[name][band.slices], rays.light(lit[name]), where=chosen)
            if name in images.gloss:
                mirrored = rays.light(lit[name], gloss=True)
                np.copyto(images.gloss[name][band.slices], mirrored, where=chosen)


@dataclass(frozen=True, eq=False)
class _LitRays:
    """A band's rays, with the projector's light where they end."""

    # weight, gloss: (R, C, K) grey level under full light, scattered and mirrored.
    weight: Floats
    gloss: Floats
    index: NDArray[np.int32]  # (R, C, K) into a table of light
    ambient: Floats  # (R, C) grey level due to the room's own light
    skin: Floats  # (R, C) mean
    # depth, surface: (R, C) minimum over the samples.
    depth: Floats
    surface: Floats

    @staticmethod
    def cast(scene: Scene, band: Band, source: _Source) -> _LitRays:
        ends = trace_band(scene, band, source.projector, source.lamps)
        blurs = _blur_rows(ends.depth, source.projection, source.lamps)
        return _LitRays(
            weight=ends.white * ends.albedo,
            gloss=ends.gloss,
            index=find_table_entries(ends.s, source.projector.stripes, blurs),
            ambient=(ends.room * ends.albedo).mean(axis=-1),
            skin=ends.skin.mean(axis=-1),
            depth=ends.depth.min(axis=-1),
            surface=ends.surface.min(axis=-1),
        )

    def light(self, table: Floats, *, gloss: bool = False) -> Floats:
        """Compute the grey level (R, C) of one frame, scattered or mirrored."""
        return average_light(self.gloss if gloss else self.weight, self.index, table.ravel())


def _dilate(near: Mask, depth: Floats, reach_mm: float, camera: TrueCamera) -> Mask:
    """Dilate a mask (H, W) by the pixels that a motion of `reach_mm` may cover."""
    if not near.any():
        return near
    pixels = int(np.ceil(reach_mm * camera.alpha / float(depth[near].min()))) + 2
    kernel = np.ones((2 * pixels + 1, 2 * pixels + 1), np.uint8)
    grown = np.asarray(cv2.dilate(near.astype(np.uint8), kernel), np.uint8)
    return grown.astype(bool)


def compute_pixel_truth(scene: Scene, camera: TrueCamera, projector: Projector) -> PixelTruth:
    """Compute depth and stripe coordinate at the pixels' centres."""
    directions = camera.directions(camera.grid()).reshape(-1, 3)
    hits = scene.cast(directions.astype(np.float32))
    depth = np.where(np.isfinite(hits.depth), hits.depth, np.nan).astype(float)
    weight = compute_laser_light(scene, hits, projector, Lamps(1.0, 0.0, 1.0, 1.0)).weight
    s = projector.stripe(directions * depth[:, None])
    lit = (weight > 0) & (s >= 0) & (s <= projector.stripes)
    shape = (camera.height, camera.width)
    return PixelTruth(depth.reshape(shape), np.where(lit, s, np.nan).reshape(shape))


def _tabulate_light(
    code: StripeCode,
    projection: Projection,
    rng: np.random.Generator,
    frames: FrameNames,
    sequence: bool,
) -> dict[str, Floats]:
    """Tabulate the light of each frame that the laser lights: lit, and the code's images."""
    lights = {frames.lit or "lit": np.ones(code.stripes)}
    if sequence:
        lights |= make_patterns(code, frames)
    strays: Array | list[None] = [None] * len(lights)
    if projection.jitter_stripes > 0:
        drawn = rng.standard_normal((len(lights), code.stripes + 1))
        strays = projection.jitter_stripes * drawn
    blurs = _list_blurs(projection)
    return {
        name: make_light_table(light**projection.gamma, blurs, stray, len(light) // code.stripes)
        for (name, light), stray in zip(lights.items(), strays, strict=True)
    }


def _list_blurs(projection: Projection) -> Array:
    """List sigmas in stripes from the best focus to the worst, in 12 steps."""
    if projection.defocus_stripes <= 0:
        return np.array([projection.blur_stripes])
    steps = np.linspace(0.0, projection.defocus_stripes, 12)
    return np.hypot(projection.blur_stripes, steps)


def _blur_rows(depth: Floats, projection: Projection, lamps: Lamps) -> NDArray[np.int32] | None:
    """Look up which of `_list_blurs` applies at each depth, taken for the distance to the projector."""
    if projection.defocus_stripes <= 0:
        return None
    return np.rint(defocus(depth, lamps.focus_mm) * 11).astype(np.int32)
