"""How much of the body was measured, by the mesh and the range images.

The cloud is thinned to a requested number of points; coverage does not depend on that.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from bodyscan.arrays import Array, Indices, Mask
from bodyscan.calibration.pair import PairCalibration
from bodyscan.fusion.brightness import MIN_GREY
from bodyscan.fusion.hole_filling import Crown
from bodyscan.fusion.regions import DARK
from bodyscan.fusion.verdict.evidence import BAND_MM, Coverage, Finding, ScanEvidence
from bodyscan.geometry.camera import Camera
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.mesh.body import SKIN, BodyMesh
from bodyscan.mesh.topology import compute_face_normals
from bodyscan.reconstruction.range_image import RangeImage

MAX_FILLED = 0.12
"""Share of the surface that may be filled in a good scan."""
MAX_SATURATED = 0.05
"""of the skin: highlights on nose and forehead are less."""


def measure_coverage(
    mesh: BodyMesh,
    images: Sequence[RangeImage],
    rig_from_camera: Mapping[str, RigidTransform],
    pairs: Mapping[str, PairCalibration] = MappingProxyType({}),
) -> Coverage:
    """Compare a sample of the mesh's faces with range images: cleaned, of all pairs that gave some.

    pairs: all calibrated ones.
    """
    sample = slice(None, None, max(1, len(mesh.faces) // 20_000))
    points = mesh.vertices[mesh.faces[sample]].mean(axis=1)
    cross = compute_face_normals(mesh.vertices, mesh.faces[sample])
    doubled_area = np.linalg.norm(cross, axis=1)
    normals = cross / np.maximum(doubled_area[:, None], 1e-12)
    views = [_view_points(points, normals, image, rig_from_camera[image.pair]) for image in images]
    count = np.sum([view.measured for view in views], axis=0)
    # Dark hair and cloth return too little light to whatever pair; fair hair is unsure.
    kinds = mesh.face_regions
    skin = np.ones(len(points), bool) if kinds is None else kinds[sample] == SKIN
    yields, saturated = {}, {}
    missed = np.zeros(len(points), bool)
    for name in pairs.keys() - {image.pair for image in images}:
        missed |= _look(points, normals, pairs[name].camera, rig_from_camera[name])[0]
    for image, view in zip(images, views, strict=True):
        # What a pair alone measured is no evidence against it.
        expected = view.visible & skin & (count - view.measured > 0)
        if np.count_nonzero(expected) >= 50:
            yields[image.pair] = float(np.mean(view.valid[expected]))
            saturated[image.pair] = float(np.mean(view.white[expected]))
        if not image.valid.any():
            missed |= view.visible
    area, filled = 0.5 * doubled_area, count == 0
    return Coverage(points[:, 2], area, filled, yields, saturated, filled & missed)


@dataclass(frozen=True, eq=False)
class _View:
    """One camera's view of N points of the mesh; masks (N,)."""

    visible: Mask  # inside its image and facing it by 60 degrees or less
    # valid, measured: at whose pixel it measured something, and which it measured themselves.
    valid: Mask
    measured: Mask
    white: Mask  # white in its lit image


def _look(
    points: Array, normals: Array, camera: Camera, rig_from_camera: RigidTransform
) -> tuple[Mask, Mask, Indices]:
    """Which of the points a camera sees at 60 degrees or less, which lie in its image, and at which
    row and column (N, 2); what stands in between is not asked."""
    camera_from_rig = rig_from_camera.inverse()
    points, normals = camera_from_rig.apply(points), camera_from_rig.rotate(normals)
    ahead = points[:, 2] > 1.0
    u, v = camera.project(np.where(ahead[:, None], points, 1.0)).T
    inside = ahead & (u > -0.5) & (v > -0.5)
    inside &= (u < camera.width - 0.5) & (v < camera.height - 0.5)
    pixel = np.where(inside[:, None], np.rint(np.stack([v, u], axis=-1)), 0).astype(np.intp)
    facing = -np.sum(points * normals, axis=1) > 0.5 * np.linalg.norm(points, axis=1)
    return inside & facing, inside, pixel


def _view_points(
    points: Array, normals: Array, image: RangeImage, rig_from_camera: RigidTransform
) -> _View:
    visible, inside, image_pixel = _look(points, normals, image.camera, rig_from_camera)
    index = image_pixel - image.corner
    kept = inside & ((index >= 0) & (index < image.sigma_mm.shape)).all(axis=1)
    pixel = tuple(np.where(kept[:, None], index, 0).T)
    valid = kept & image.valid[pixel]
    camera_from_rig = rig_from_camera.inverse()
    points, normals = camera_from_rig.apply(points), camera_from_rig.rotate(normals)
    distance = np.abs(np.sum((image.points[pixel] - points) * normals, axis=1))
    white = inside & (image.lit[tuple(image_pixel.T)] >= 254)
    # A mesh of few points may be 10 mm off what was measured; webs and soles are farther off.
    return _View(visible, valid, valid & (distance < 10.0), white)


def check_exposure(scan: ScanEvidence) -> Iterator[Finding]:
    """Pairs whose lit images are white where they show the subject."""
    shares = dict(scan.coverage.saturated) if scan.coverage else {}
    for name, share in scan.images.saturated.items():
        shares[name] = max(share, shares.get(name, 0.0))
    over = {name: share for name, share in shares.items() if share > MAX_SATURATED}
    if not over:
        return
    low, high = f"{min(over.values()):.0%}", f"{max(over.values()):.0%}"
    names = ", ".join(sorted(over))
    pairs = f"pair {names} is" if len(over) == 1 else f"pairs {names} are"
    spoiled = frozenset(name for name, share in over.items() if share > 0.3)  # as `overexposed`
    yield Finding(
        "usable",
        f"{pairs} overexposed: {low if low == high else f'{low} to {high}'} of the skin in view "
        "is white in the lit image. Shorten the exposure or dim the projector",
        frozenset(over),
        spoiled,
        spoils=bool(spoiled),
    )


def check_brightness(scan: ScanEvidence) -> Iterator[Finding]:
    """Images too dark to tell hair and cloth from skin; their points then lack the relief sigma."""
    grey = float(np.median(scan.cloud.grey))
    if 0.0 < grey * DARK < MIN_GREY:
        yield Finding(
            "usable",
            f"the images are dark: half of the body has grey levels below {grey:.0f} of 255, so that "
            "hair and dark cloth cannot be told from skin. Lengthen the exposure",
        )


def check_views(scan: ScanEvidence) -> Iterator[Finding]:
    """Pairs that measured something else than the others where they look as well."""
    coverage, report = scan.coverage, scan.images.seams
    if coverage is None or report is None:
        return
    alone = [names[0] for names in report.isolated if len(names) == 1]
    for name in alone:
        share = coverage.yields.get(name, 1.0)
        if share < 0.3 and name not in scan.images.saturated:
            yield Finding(
                "repeat",
                f"pair {name} shows something else than the others: it measured {share:.0%} of the "
                "skin that they measured in its view, and no surface is common to both. Possible "
                "causes: its images are upside down, or another pair's (cables, folders); a wrong pose",
                frozenset([name]),
                frozenset([name]),
                spoils=True,
            )


def check_yields(scan: ScanEvidence) -> Iterator[Finding]:
    """Pairs that measured less than they see, by what others measured there."""
    coverage = scan.coverage
    if coverage is None:
        return
    for name, share in coverage.yields.items():
        # Shadows of arms and chin leave 85 % and more.
        if share < 0.6 and coverage.saturated[name] <= MAX_SATURATED:
            yield Finding(
                "usable",
                f"pair {name} measured {share:.0%} of the skin that it sees and others measured. "
                "Possible causes: an object blocks its view; its images are too dark or out of focus; "
                "it is mounted in the wrong place or upside down",
                frozenset([name]),
            )


def check_rings(scan: ScanEvidence) -> Iterator[Finding]:
    """A surface of which too little was measured round the body for want of pairs."""
    coverage = scan.coverage
    if coverage is None:
        return
    area = coverage.sum_bands(coverage.areas_mm2)
    missed, pairs = _find_missed(scan, coverage)
    # Closed flat, a gap of 15 % costs 4 mm of a girth of 800: its arc less its chord.
    gaping = coverage.sum_bands(coverage.areas_mm2 * missed) > 0.15 * area
    share = float(np.sum(gaping) / np.count_nonzero(area))
    if share > 0.5:
        yield Finding(
            "repeat",
            f"at {share:.0%} of the heights 15 % or more of the girth is unmeasured, where "
            f"{', '.join(sorted(pairs))} should have seen it",
            pairs,
        )


def _find_missed(scan: ScanEvidence, coverage: Coverage) -> tuple[Mask, frozenset[str]]:
    """Faces (N,) that pairs without a range image leave unmeasured, and those pairs. Where a pair that
    was never calibrated looks is not known: any face in a rig that sees all round."""
    uncalibrated = scan.images.failed.keys() - scan.images.absent
    if uncalibrated and not (scan.mesh and _sees_one_side(scan)):
        return coverage.filled, scan.images.absent | uncalibrated
    return coverage.missed, scan.images.absent


def check_gaps(scan: ScanEvidence) -> Iterator[Finding]:
    """The filled share of the whole surface, and of bands of 50 mm in height."""
    coverage = scan.coverage
    measured_mm2 = np.inf if coverage is None else coverage.areas_mm2[~coverage.filled].sum()
    if measured_mm2 < 2000.0:  # less than three fingers
        yield Finding(
            "repeat", f"next to nothing was measured: {measured_mm2 / 100.0:.1f} cm² in all"
        )
    if scan.mesh and _sees_one_side(scan):
        yield Finding(
            "usable",
            "the cameras saw only one side: the other side of the mesh is filled in "
            f"({scan.mesh.filled_share:.0%} of its surface)",
        )
        return
    if coverage is None:
        return
    missed, pairs = _find_missed(scan, coverage)
    mostly = 2.0 * coverage.areas_mm2[missed].sum() > coverage.areas_mm2[coverage.filled].sum()
    # Compression costs stripes anywhere.
    compressed = frozenset(scan.images.compressed)
    everywhere = 2 * len(compressed) > len(scan.rig.boards_mm)
    lost = pairs if mostly else compressed if everywhere else frozenset()
    if coverage.filled_share > MAX_FILLED:
        yield Finding(
            "repeat" if coverage.filled_share > 0.5 else "usable",
            f"{(scan.mesh or coverage).filled_share:.0%} of the surface was not measured and is "
            "filled in",
            lost,
        )
    area = coverage.sum_bands(coverage.areas_mm2)
    filled = coverage.sum_bands(coverage.areas_mm2 * coverage.filled) / np.maximum(area, 1e-9)
    heights = np.maximum(scan.cloud.points[:, 2] / BAND_MM, 0).astype(np.int64)
    points = np.bincount(heights, None, len(area))[: len(area)]
    filled[(area == 0.0) & (points == 0)] = 1.0  # the mesh begins above it
    # Soles are never seen; what is above the highest point is the crown's.
    band = np.arange(len(filled))
    empty = (filled > 0.5) & (BAND_MM * band >= 50.0) & (band < min(heights.max(), band[-1]))
    starts = np.flatnonzero(empty & ~np.roll(empty, 1))
    ends = np.flatnonzero(empty & ~np.roll(empty, -1)) + 1
    for low, high in zip(starts, ends, strict=True):
        yield Finding(
            "usable",
            f"less than half was measured from {BAND_MM * low:.0f} to {BAND_MM * high:.0f} mm. "
            "Possible causes: hair; black cloth; out of view",
            lost,
        )


def check_crown(scan: ScanEvidence) -> Iterator[Finding]:
    """Check that the crown was measured: it may be higher than filled by the 4 mm of ISO 20685-1."""
    coverage = scan.coverage
    if coverage is None or (scan.mesh and _sees_one_side(scan)):
        return
    top = coverage.heights_mm > coverage.heights_mm.max() - 20.0
    if not coverage.filled[top].any():
        return
    crown = Crown.from_cloud(scan.cloud.points, scan.cloud.normals)
    if crown.unknown_mm > 4.0:
        yield Finding(
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
