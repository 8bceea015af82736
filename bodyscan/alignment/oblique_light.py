"""Light that enters skin obliquely and comes out aside: found by comparing pairs, and undone.

Below the surface light continues as refracted, so what a camera sees entered a little earlier, back
along the direction of the light: by `aside_mm` times the tangent of the refracted angle. A pixel
thus shows the stripe of a neighbouring place, and its depth is wrong by where that stripe's sheet
meets the pixel's ray: by more where the surface leans against the sheet, and with the opposite sign
if the projector stands on the other side of the camera. Pairs that see the same skin under
different slopes disagree by that, whatever else the skin is like, and one length explains all of
them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import cv2
import numpy as np

from bodyscan.alignment.icp import Alignment, align
from bodyscan.alignment.overlap_equations import LEAST_SPREAD_MM
from bodyscan.alignment.overlaps import COARSE, OverlapPoints, each_overlap, match_overlap
from bodyscan.alignment.sway_prior import SwayPrior
from bodyscan.arrays import Array, Floats
from bodyscan.compiled import compiled
from bodyscan.geometry.light_planes import LightSheets
from bodyscan.geometry.pose_covariance import PoseCovariance
from bodyscan.geometry.robust import spread
from bodyscan.geometry.scaled_systems import solve_scaled
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.progress import THREADS
from bodyscan.reconstruction.range_image import RangeImage
from bodyscan.settings import AlignmentSettings

REFRACTION = 1.4
"""Refractive index of skin (Tuchin, Tissue Optics, 2015: 1.36 to 1.45)."""
STRIPES, FEWEST_SHEETS = 32, 3
PARALLEL = 1e-3
"""Angle between sheets, radians, below which light comes from a kilometre away and its direction is
not known well enough."""
WINDOW_MM = 7.0
"""Window over which normals are averaged: normals of five pixels are as noisy as the effect is
large."""
MOST_LIFT = 4.0
"""Largest shift of a point along its ray per unit of `aside_mm`; only grazing light exceeds it."""
ROUNDS = 2
"""Rounds after the first; each leaves a tenth of the remainder."""
FEWEST_IMAGES = 4
"""Fewest images: with any one left out there must still be several."""
TOLD_SIGMAS, LEAST_MM = 4.0, 0.05
"""Smallest length that is believed: a surface that leans by 20 degrees then stands off by as much,
which makes 0.3 mm of a girth."""
SHORTEST = np.float32(1e-3)
"""Shortest mean of unit normals that has a direction."""
FLATTEST = 0.1
"""Least cosine between light, ray and sheet: when flatter, the effect has no size and nothing is
measured."""


@dataclass(frozen=True, eq=False)
class LightLine:
    """The line in which a projector's sheets meet, camera frame.

    origin: its point nearest to the camera, taken as the source of light, (3,) mm.
    along: unit vector, (3,).
    """

    origin: Array
    along: Array

    @staticmethod
    def of(sheets: LightSheets) -> LightLine | None:
        """The line of these sheets; None if there are too few, or they are parallel."""
        planes = sheets.tangent_planes(np.linspace(0.0, sheets.stripes, STRIPES + 2)[1:-1])
        planes = planes[np.isfinite(planes).all(axis=1)]
        if len(planes) < FEWEST_SHEETS:
            return None
        left, sizes, right = np.linalg.svd(planes[:, :3], full_matrices=False)
        if sizes[1] < PARALLEL * sizes[0]:
            return None
        two = left[:, :2].T @ -planes[:, 3] / sizes[:2]
        return LightLine(two @ right[:2], right[2])

    def lift(self, points: Array, normals: Array) -> Array:
        """How far points are seen from where they are, (N,) mm along their rays for 1 mm aside.

        points: (N, 3) mm, camera frame.
        normals: unit, towards the camera, (N, 3).

        Positive away from the camera; NaN where light or camera graze the surface or each other.
        """
        light = points - self.origin
        light /= np.linalg.norm(light, axis=1, keepdims=True)
        ray = points / np.linalg.norm(points, axis=1, keepdims=True)
        sheet = np.cross(self.along, light)
        sheet /= np.linalg.norm(sheet, axis=1, keepdims=True)
        facing = -np.sum(light * normals, axis=1)
        refracted = np.sqrt(1.0 - (1.0 - facing**2) / REFRACTION**2)
        # Light stays in its sheet: perpendicular to it, it goes aside by as much as the normal
        # leans.
        aside = facing * np.sum(sheet * normals, axis=1) / (REFRACTION * refracted)
        across = np.sum(sheet * ray, axis=1)
        seen = -np.sum(ray * normals, axis=1)
        clear = (facing > FLATTEST) & (seen > FLATTEST) & (np.abs(across) > FLATTEST**2)
        return np.where(clear, -aside / np.where(clear, across, 1.0), np.nan)


@dataclass(frozen=True)
class ObliqueLight:
    """The effect of oblique light.

    aside_mm: how far aside light comes out, over the tangent of the refracted angle.
    sigma_mm: its standard deviation, from the influence of every single pair.
    """

    aside_mm: float
    sigma_mm: float

    @property
    def told(self) -> bool:
        """Whether the effect is there; light never comes out before the place where it entered."""
        return self.aside_mm > max(TOLD_SIGMAS * self.sigma_mm, LEAST_MM)

    @property
    def most_mm(self) -> float:
        """Upper bound of the effect, mm."""
        return abs(self.aside_mm) + self.sigma_mm


@dataclass(frozen=True, eq=False)
class _Shared:
    """Equations of an overlap: J^T W J (7, 7), J^T W d (7,), by source motion and length."""

    information: Array
    gradient: Array


def light_lines(
    images: Sequence[RangeImage], sheets: Mapping[str, LightSheets]
) -> dict[str, LightLine] | None:
    """Of each pair; None where one has no sheets of light, or points are of stripes of both
    directions, which oblique light moves each their own way."""
    seen = [image.pair for image in images]
    found = {name: LightLine.of(sheets[name]) for name in seen if name in sheets}
    lines = {name: line for name, line in found.items() if line is not None}
    return None if len(lines) < len(images) or any(one.agreement for one in images) else lines


def take_out(
    images: Sequence[RangeImage],
    rig_from_camera: Mapping[str, RigidTransform],
    found: Alignment,
    lines: Mapping[str, LightLine],
    prior: PoseCovariance,
    settings: AlignmentSettings,
) -> tuple[list[RangeImage], Alignment, ObliqueLight | None]:
    """Remove the effect from the images if it is significant, and align them again.

    found: the images' alignment from `rig_from_camera`, which compensated for the effect as far as
        poses can, so the remainder is estimated again.

    If it is not significant, images and alignment are returned unchanged, except that an effect
    that could be there unnoticed goes into the points' sigmas.
    """
    first = find_oblique_light(images, found.rig_from_camera, lines, prior, settings)
    if first is None or not first.told:
        seen = list(images)
        if first is not None and first.sigma_mm > LEAST_MM:
            unknown = ObliqueLight(0.0, first.sigma_mm)
            seen = [undo(image, lines[image.pair], unknown) for image in images]
        return seen, found, first
    total, seen = first, list(images)
    for _ in range(ROUNDS):
        seen = [undo(image, lines[image.pair], total) for image in images]
        found = align(seen, rig_from_camera, prior, settings)
        rest = find_oblique_light(seen, found.rig_from_camera, lines, prior, settings)
        if rest is None:
            break
        total = ObliqueLight(total.aside_mm + rest.aside_mm, rest.sigma_mm)
    return seen, found, total


def find_oblique_light(
    images: Sequence[RangeImage],
    rig_from_camera: Mapping[str, RigidTransform],
    lines: Mapping[str, LightLine],
    prior: PoseCovariance,
    settings: AlignmentSettings,
) -> ObliqueLight | None:
    """Estimate one length for all overlaps together with the pairs' motions.

    What motions explain as well does not count.

    rig_from_camera: aligned, so that the remainder is small.
    lines: of every image's projector.

    None if fewer than four images overlap, or all evidence depends on one image.
    """
    names = [image.pair for image in images]
    placed = [rig_from_camera[name] for name in names]

    # Each image is one piece of evidence, however many points it has: some of them are enough.
    correlated = max(settings.correlated / COARSE.step, 1.0)

    def points(image: RangeImage) -> OverlapPoints:
        seen = OverlapPoints.of(replace(image, normals=_steady(image)), settings.spacing_mm)
        return seen.some(COARSE)

    with ThreadPoolExecutor(THREADS) as pool:
        clouds = list(pool.map(points, images))

        def of_two(i: int, j: int) -> _Shared | None:
            reach, fewest = settings.least_reach_mm, settings.fewest
            found = match_overlap(clouds[i], clouds[j], placed[i], placed[j], reach, fewest)
            if found is None:
                return None
            places = found.points, found.normals
            apart = _apart(lines[names[i]], placed[i], *places)
            apart -= _apart(lines[names[j]], placed[j], *places)
            return _shared(*places, found.distances, found.sigma_mm, apart, correlated)

        overlaps = each_overlap(pool, len(names), of_two)
    seen = sorted({k for both in overlaps for k in both})
    if len(seen) < FEWEST_IMAGES:
        return None
    held = np.asarray(np.linalg.inv(SwayPrior.of(settings).covariance(names, prior)), np.float64)
    without = np.array([_aside(overlaps, held, one) for one in seen])
    if not np.isfinite(without).all():
        return None
    # Jackknife (Tukey 1958): images err independently, points of one image together.
    sigma = np.sqrt((len(seen) - 1) / len(seen) * np.sum((without - without.mean()) ** 2))
    return ObliqueLight(_aside(overlaps, held), float(sigma))


def undo(image: RangeImage, line: LightLine, found: ObliqueLight) -> RangeImage:
    """Move the points of a range image to where the surface is, and enlarge their sigmas.

    The sigmas include the uncertainty of the shift, or all of it where light or camera graze.
    """
    valid = image.valid
    points, normals = image.points[valid].astype(np.float64), _steady(image)[valid]
    lift = line.lift(points, normals.astype(np.float64))
    known = np.isfinite(lift)
    unsure = np.where(known, found.sigma_mm * np.abs(lift), MOST_LIFT * found.most_mm)
    length = np.linalg.norm(points, axis=1, keepdims=True)
    moved = np.where(known, found.aside_mm * lift, 0.0)[:, None] / length
    common = np.zeros_like(image.sigma_mm) if image.common_mm is None else image.common_mm.copy()
    placed, sigma_mm = image.points.copy(), image.sigma_mm.copy()
    placed[valid] = points * (1.0 - moved)
    sigma_mm[valid], common[valid] = (
        np.hypot(one[valid], unsure).astype(np.float32) for one in (sigma_mm, common)
    )
    return replace(image, points=placed, sigma_mm=sigma_mm, common_mm=common)


def _steady(image: RangeImage) -> Floats:
    """Unit normals (h, w, 3), each averaged over a window, so that rims have some too."""
    known = np.isfinite(image.normals[..., 2]) & image.valid
    if not known.any():
        return image.normals
    pixel_mm = float(np.median(image.points[known][:, 2])) / image.camera.alpha
    side = 2 * max(1, round(0.5 * WINDOW_MM / pixel_mm)) + 1
    total = cv2.blur(np.where(known[..., None], image.normals, np.float32(0.0)), (side, side))
    to_unit_length(total.reshape(-1, 3))
    return total


@compiled
def to_unit_length(normals: Floats) -> None:
    """Scale normals (N, 3) to unit length; NaN where hardly anything is left of them."""
    for n in range(len(normals)):
        x, y, z = normals[n, 0], normals[n, 1], normals[n, 2]
        length = np.sqrt(x * x + y * y + z * z)
        for k in range(3):
            normals[n, k] = normals[n, k] / length if length > SHORTEST else np.float32(np.nan)


def _apart(
    line: LightLine, rig_from_camera: RigidTransform, points: Array, normals: Array
) -> Array:
    """Offsets (N,) mm along normals (N, 3) at which a pair sees points (N, 3) for 1 mm aside."""
    camera_from_rig = rig_from_camera.inverse()
    seen, across = camera_from_rig.apply(points), camera_from_rig.rotate(normals)
    facing = np.sum(seen * across, axis=1) / np.linalg.norm(seen, axis=1)
    return line.lift(seen, across) * facing


def _shared(
    points: Array,
    normals: Array,
    distances: Array,
    sigma_mm: Array,
    apart: Array,
    correlated: float,
) -> _Shared:
    """As `OverlapEquations`, the length as last unknown; matches without `apart` drop out."""
    rows = np.column_stack([np.cross(points, normals), normals, apart])
    variance = sigma_mm**2 + spread(distances, LEAST_SPREAD_MM) ** 2
    weight = np.isfinite(apart) / (variance + 0.25 * distances**2) / correlated
    rows[~np.isfinite(apart)] = 0.0
    weighted = rows.T * weight
    return _Shared(weighted @ rows, weighted @ distances)


def _aside(
    overlaps: Mapping[tuple[int, int], _Shared], held: Array, without: int | None = None
) -> float:
    """The length that explains the overlaps best, NaN if none is left.

    held: inverse covariance (6P, 6P) of the pairs' motions.
    without: number of an image to leave out.
    """
    size = len(held)
    normal, right = np.zeros((size + 1, size + 1)), np.zeros(size + 1)
    normal[:size, :size] = held
    # The target's motion has the opposite effect; `apart` covers both images.
    signed = np.concatenate([np.eye(7)[:, :6], -np.eye(7)[:, :6], np.eye(7)[:, 6:]], axis=1)
    for (a, b), one in overlaps.items():
        if without in (a, b):
            continue
        at = np.concatenate([6 * a + np.arange(6), 6 * b + np.arange(6), [size]])
        normal[np.ix_(at, at)] += signed.T @ one.information @ signed
        right[at] += signed.T @ one.gradient
    return float(solve_scaled(normal, right)[-1]) if normal[-1, -1] > 0.0 else float("nan")
