"""How much of the body was measured, by the mesh and the range images.

The cloud is thinned to a requested number of points; coverage does not depend on that.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from bodyscan.arrays import Array, Mask
from bodyscan.fusion.hole_filling import Crown
from bodyscan.fusion.verdict.evidence import Coverage, Finding, ScanEvidence
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.mesh.body import SKIN, BodyMesh
from bodyscan.mesh.topology import face_normals
from bodyscan.reconstruction.range_image import RangeImage

MAX_FILLED = 0.12
"""Share of the surface that may be filled in a good scan."""
MAX_SATURATED = 0.05
"""of the skin: highlights on nose and forehead are less."""


def measure_coverage(
    mesh: BodyMesh, images: Sequence[RangeImage], rig_from_camera: Mapping[str, RigidTransform]
) -> Coverage:
    """Compare a sample of the mesh's faces with range images: cleaned, of all pairs that gave some."""
    sample = slice(None, None, max(1, len(mesh.faces) // 20_000))
    points = mesh.vertices[mesh.faces[sample]].mean(axis=1)
    cross = face_normals(mesh.vertices, mesh.faces[sample])
    doubled_area = np.linalg.norm(cross, axis=1)
    normals = cross / np.maximum(doubled_area[:, None], 1e-12)
    views = [_view_points(points, normals, image, rig_from_camera[image.pair]) for image in images]
    count = np.sum([view.measured for view in views], axis=0)
    # Dark hair and cloth return too little light to whatever pair; fair hair is unsure.
    kinds = mesh.face_regions
    skin = np.ones(len(points), bool) if kinds is None else kinds[sample] == SKIN
    yields, saturated = {}, {}
    for image, view in zip(images, views, strict=True):
        # What a pair alone measured is no evidence against it.
        expected = view.visible & skin & (count - view.measured > 0)
        if np.count_nonzero(expected) >= 50:
            yields[image.pair] = float(np.mean(view.valid[expected]))
            saturated[image.pair] = float(np.mean(view.white[expected]))
    return Coverage(points[:, 2], 0.5 * doubled_area, count == 0, yields, saturated)


@dataclass(frozen=True, eq=False)
class _View:
    """One camera's view of N points of the mesh; masks (N,).

    visible: inside its image and facing it by 60 degrees or less.
    valid, measured: at whose pixel it measured something, and which it measured themselves.
    white: white in its lit image.
    """

    visible: Mask
    valid: Mask
    measured: Mask
    white: Mask


def _view_points(
    points: Array, normals: Array, image: RangeImage, rig_from_camera: RigidTransform
) -> _View:
    camera_from_rig, camera = rig_from_camera.inverse(), image.camera
    points, normals = camera_from_rig.apply(points), camera_from_rig.rotate(normals)
    ahead = points[:, 2] > 1.0
    u, v = camera.project(np.where(ahead[:, None], points, 1.0)).T
    inside = ahead & (u > -0.5) & (v > -0.5)
    inside &= (u < camera.width - 0.5) & (v < camera.height - 0.5)
    column = np.where(inside, np.rint(u), 0).astype(np.intp)
    row = np.where(inside, np.rint(v), 0).astype(np.intp)
    facing = -np.sum(points * normals, axis=1) > 0.5 * np.linalg.norm(points, axis=1)
    index = np.stack([row, column], axis=-1) - image.corner
    kept = inside & ((index >= 0) & (index < image.sigma_mm.shape)).all(axis=1)
    pixel = tuple(np.where(kept[:, None], index, 0).T)
    valid = kept & image.valid[pixel]
    distance = np.abs(np.sum((image.points[pixel] - points) * normals, axis=1))
    white = inside & (image.lit[row, column] >= 254)
    # A mesh of few points may be 10 mm off what was measured; webs and soles are farther off.
    return _View(inside & facing, valid, valid & (distance < 10.0), white)


def check_yields(scan: ScanEvidence) -> Iterator[Finding]:
    """Pairs that measured less than they see, by what others measured there."""
    coverage = scan.coverage
    if coverage is None:
        return
    for name, share in coverage.saturated.items():
        if share > MAX_SATURATED:
            yield (
                "usable",
                f"pair {name} is overexposed: {share:.0%} of the skin that it sees is white in its lit "
                "image. Shorten its exposure or dim its projector",
            )
    for name, share in coverage.yields.items():
        # Shadows of arms and chin leave 85 % and more.
        if share < 0.6 and coverage.saturated[name] <= MAX_SATURATED:
            yield (
                "usable",
                f"pair {name} measured {share:.0%} of the skin that it sees and others measured. "
                "Possible causes: an object blocks its view; its images are too dark or out of focus; "
                "it is mounted in the wrong place or upside down",
            )


def check_gaps(scan: ScanEvidence) -> Iterator[Finding]:
    """The filled share of the whole surface, and of bands of 50 mm in height."""
    if scan.mesh and _sees_one_side(scan):
        yield (
            "usable",
            "one side only was seen, as the cameras stand: the mesh's other side is filled "
            f"({scan.mesh.filled_share:.0%} of its surface)",
        )
        return
    coverage = scan.coverage
    if coverage is None:
        return
    if coverage.filled_share > MAX_FILLED:
        yield (
            "repeat" if coverage.filled_share > 0.5 else "usable",
            f"{coverage.filled_share:.0%} of the surface is filled: nothing was measured there",
        )
    band_mm = 50.0
    band = np.maximum(coverage.heights_mm / band_mm, 0.0).astype(np.int64)
    area = np.bincount(band, coverage.areas_mm2)
    filled = np.bincount(band, coverage.areas_mm2 * coverage.filled) / np.maximum(area, 1e-9)
    heights = np.maximum(scan.cloud.points[:, 2] / band_mm, 0)
    points = np.bincount(heights.astype(np.int64), None, len(area))[: len(area)]
    filled[(area == 0.0) & (points == 0)] = 1.0  # the mesh begins above it
    empty = (filled > 0.5) & (band_mm * np.arange(len(filled)) >= 50.0)  # soles are never seen
    starts = np.flatnonzero(empty & ~np.roll(empty, 1))
    ends = np.flatnonzero(empty & ~np.roll(empty, -1)) + 1
    for low, high in zip(starts, ends, strict=True):
        yield (
            "usable",
            f"next to nothing was measured from {band_mm * low:.0f} to {band_mm * high:.0f} mm. "
            "Possible causes: hair; black cloth; out of view",
        )


def check_crown(scan: ScanEvidence) -> Iterator[Finding]:
    """A crown that was not measured, and may be higher by the 4 mm that ISO 20685-1 allows."""
    coverage = scan.coverage
    if coverage is None or (scan.mesh and _sees_one_side(scan)):
        return
    top = coverage.heights_mm > coverage.heights_mm.max() - 20.0
    if not coverage.filled[top].any():
        return
    crown = Crown.from_cloud(scan.cloud.points, scan.cloud.normals)
    if crown.unknown_mm > 4.0:
        yield (
            "usable",
            f"nothing was measured of the crown, and perhaps of all above {crown.highest[2]:.0f} mm: "
            "the stature is a guess. Possible causes: hair; a cap; out of view",
        )


def _sees_one_side(scan: ScanEvidence) -> bool:
    """Whether all cameras stand within 45 degrees of one direction from what was measured."""
    if scan.rig.cameras is None:
        return False
    directions = scan.rig.cameras - scan.cloud.points.mean(axis=0)
    directions = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    mean = directions.sum(axis=0)
    return bool(np.all(directions @ mean >= 0.7 * np.linalg.norm(mean)))
