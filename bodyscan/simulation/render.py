"""From a scene, a camera and a projector to images: light by rays, then lens and sensor."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from bodyscan.capture.rig import FrameNames
from bodyscan.simulation.gray import PAD, LightTable, bit_count, code_bits, light_table, table_index
from bodyscan.simulation.lens import TrueCamera, sampled_directions
from bodyscan.simulation.projector import Projector
from bodyscan.simulation.scene import Hits, Scene, dot
from bodyscan.simulation.settings import Noise, Optics, Projection

Array = NDArray[np.float64]
Floats = NDArray[np.float32]
Image = NDArray[np.uint8]

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
        rows = max(1, _BAND // (camera.width * optics.samples**2))
        seed = int(rng.integers(1 << 62))
        bands = [slice(r, min(r + rows, camera.height)) for r in range(0, camera.height, rows)]
        shifted = [
            (band, sampled_directions(camera, optics.samples, np.random.default_rng(seed), band))
            for band in bands
        ]
        return View(camera, optics, tuple(shifted))


@dataclass(frozen=True)
class Lamps:
    """How bright: grey level of a white surface facing the projector at reach_mm, and what the
    room's light makes of a white surface."""

    laser_grey: float
    ambient_grey: float
    reach_mm: float


@dataclass(frozen=True, eq=False)
class PixelTruth:
    """What lies at each pixel's centre. depth: (height, width) mm, NaN where nothing is.

    s: stripe coordinate, NaN where no light of the projector arrives.
    """

    depth: Array
    s: Array


def frame_names(frames: FrameNames, bits: int) -> tuple[list[str], list[str]]:
    """Names of the patterns and of their inverses, as the rig file has them."""
    return _names(frames.pattern, bits), _names(frames.inverse, bits)


def _names(template: str | tuple[str, ...], bits: int) -> list[str]:
    if isinstance(template, str):
        return [template.format(bit=bit) for bit in range(bits)]
    if len(template) != bits:
        raise ValueError(f"{len(template)} frame names are given for {bits} patterns")
    return list(template)


def render_pair(
    scene: Scene,
    view: View,
    projector: Projector,
    lamps: Lamps,
    projection: Projection,
    rng: np.random.Generator,
    *,
    frames: FrameNames | None = None,
    sequence: bool = True,
) -> dict[str, Floats]:
    """Noiseless images, (height, width) float32 grey levels, by frame name.

    With `sequence` the whole stripe sequence (lit, dark, patterns, inverses), else lit alone.
    """
    frames = frames or FrameNames()
    tables = _tables(projector.stripes, projection, rng, frames, sequence)
    height, width = view.camera.height, view.camera.width
    images = {name: np.zeros((height, width), np.float32) for name in (*tables, "")}
    samples = view.optics.samples**2
    for rows, directions in view.bands:
        hits = scene.cast(directions)
        weight, s = laser_light(scene, hits, projector, lamps)
        index = table_index(s, projector.stripes, _blur_rows(hits, projection, lamps))
        for name, table in tables.items():
            images[name][rows] = _pixels(weight, table.at(index), samples).reshape(-1, width)
        ambient = _pixels(hits.albedo, np.full_like(s, lamps.ambient_grey), samples)
        images[""][rows] = ambient.reshape(-1, width)
    return _finished(images, view, projection, frames, rng, sequence)


def _pixels(weight: Floats, light: Floats, samples: int) -> Floats:
    """Mean over each pixel's samples of weight times light."""
    total = np.einsum("ij,ij->i", weight.reshape(-1, samples), light.reshape(-1, samples))
    return total * np.float32(1.0 / samples)


def laser_light(
    scene: Scene, hits: Hits, projector: Projector, lamps: Lamps
) -> tuple[Floats, Floats]:
    """Grey level that each hit would get from a lit stripe (cosine, 1/r^2, shadow), and its s."""
    s = projector.stripe(hits.points)
    reached = np.isfinite(hits.depth) & (s > -PAD) & (s < projector.stripes + PAD)
    chosen = np.flatnonzero(reached)
    points, normals = hits.points.take(chosen, axis=0), hits.normals.take(chosen, axis=0)
    towards = projector.source(s[chosen]) - points
    square, height = dot(towards, towards), dot(towards, normals)
    front = height * dot(points, normals) < 0  # light and viewer are on the same side
    cosine = np.abs(height) / np.sqrt(square * dot(normals, normals))
    shadow = scene.shadowed(points, towards, hits.surface[chosen])
    bright = np.float32(lamps.laser_grey * lamps.reach_mm**2) * cosine / square
    weight = np.zeros(len(s), np.float32)
    weight[chosen] = bright * (front & ~shadow) * hits.albedo[chosen]
    return weight, s


def pixel_truth(scene: Scene, camera: TrueCamera, projector: Projector) -> PixelTruth:
    """Depth and stripe coordinate at the pixels' centres."""
    directions = camera.directions(camera.grid()).reshape(-1, 3)
    hits = scene.cast(directions.astype(np.float32))
    depth = np.where(np.isfinite(hits.depth), hits.depth, np.nan).astype(float)
    weight, _ = laser_light(scene, hits, projector, Lamps(1.0, 0.0, 1000.0))
    s = projector.stripe(directions * depth[:, None])
    lit = (weight > 0) & (s >= 0) & (s <= projector.stripes)
    shape = (camera.height, camera.width)
    return PixelTruth(depth.reshape(shape), np.where(lit, s, np.nan).reshape(shape))


def expose(image: Floats, noise: Noise, rng: np.random.Generator) -> Image:
    """What the sensor makes of a noiseless image: shot and read noise, 8 bits."""
    electrons = noise.electrons_per_grey * noise.photons
    spread = np.sqrt(np.maximum(image, 0.0) / electrons + noise.read_grey**2)
    noisy = image + spread * rng.standard_normal(image.shape, dtype=np.float32)
    return np.clip(np.rint(noisy), 0, 255).astype(np.uint8)


def _tables(
    stripes: int,
    projection: Projection,
    rng: np.random.Generator,
    frames: FrameNames,
    sequence: bool,
) -> dict[str, LightTable]:
    """A table of light for each frame that the laser lights."""
    names = [frames.lit]
    if sequence:
        patterns, inverses = frame_names(frames, bit_count(stripes))
        names += patterns + inverses
    if projection.jitter_stripes <= 0:
        return dict(zip(names, _steady_tables(stripes, projection), strict=False))
    lit = _lit_stripes(stripes)[: len(names)]
    strays = projection.jitter_stripes * rng.standard_normal((len(names), stripes + 1))
    blurs = _blurs(projection)
    return {n: light_table(on, blurs, j) for n, on, j in zip(names, lit, strays, strict=True)}


@lru_cache(maxsize=8)
def _steady_tables(stripes: int, projection: Projection) -> tuple[LightTable, ...]:
    """Of lit, the patterns and the inverses, when no boundary strays."""
    return tuple(light_table(lit, _blurs(projection)) for lit in _lit_stripes(stripes))


def _lit_stripes(stripes: int) -> NDArray[np.bool_]:
    """(1 + 2 bits, stripes): which are on in lit, the patterns, the inverses."""
    bits = code_bits(stripes)
    return np.concatenate([np.ones((1, stripes), bool), bits, ~bits])


def _blurs(projection: Projection) -> Array:
    """Standard deviations in stripes, from the best focus to the worst."""
    steps = _DEFOCUS_STEPS if projection.defocus_stripes > 0 else 1
    worst = projection.defocus_stripes * np.arange(steps) / max(steps - 1, 1) * 2.0
    return np.hypot(projection.blur_stripes, worst)


def _blur_rows(hits: Hits, projection: Projection, lamps: Lamps) -> NDArray[np.int32] | None:
    """Which of `_blurs` holds at each hit."""
    if projection.defocus_stripes <= 0:
        return None
    depth = np.where(np.isfinite(hits.depth), hits.depth, lamps.reach_mm)
    off = np.abs(lamps.reach_mm / depth - 1.0) * 2.0
    step = np.rint(off * (_DEFOCUS_STEPS - 1) / 2.0)
    return np.minimum(step, _DEFOCUS_STEPS - 1).astype(np.int32)


def _finished(
    images: dict[str, Floats],
    view: View,
    projection: Projection,
    frames: FrameNames,
    rng: np.random.Generator,
    sequence: bool,
) -> dict[str, Floats]:
    """Speckle, ambient light, vignetting and the lens's blur put on."""
    ambient = images.pop("")
    shade = _vignette(view)
    done = {}
    for name, image in images.items():
        if projection.speckle > 0:
            image = image * _speckle(image.shape, projection.speckle, rng)
        done[name] = _blurred((image + ambient) * shade, view.optics.blur_px)
    if sequence and frames.dark is not None:
        done[frames.dark] = _blurred(ambient * shade, view.optics.blur_px)
    return done


def _speckle(shape: tuple[int, ...], size: float, rng: np.random.Generator) -> Floats:
    """Brightness factors of mean 1: a gamma distribution, as speckle averaged over a pixel has."""
    return rng.standard_gamma(1.0 / size**2, shape, dtype=np.float32) * np.float32(size**2)


def _vignette(view: View) -> Floats | float:
    if view.optics.vignetting <= 0:
        return 1.0
    directions = view.camera.directions(view.camera.grid())
    cosine = 1.0 / np.linalg.norm(directions, axis=-1)
    return (1.0 - view.optics.vignetting * (1.0 - cosine**4)).astype(np.float32)


def _blurred(image: Floats, sigma: float) -> Floats:
    if sigma <= 0:
        return image
    return cv2.GaussianBlur(image, (0, 0), sigma, borderType=cv2.BORDER_REFLECT_101)
