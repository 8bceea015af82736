"""Checks of the shape: more than one person, other things in the volume, parts that are cut off."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy import ndimage
from scipy.spatial import cKDTree

from bodyscan.fusion.verdict.evidence import Finding, ScanEvidence
from bodyscan.mesh.slices import MeshSlicer
from bodyscan.mesh.topology import find_handles

SECOND_BODY = 0.4
"""of the first one's height: as tall, it is a body and not a thing beside one."""


def check_pieces(scan: ScanEvidence) -> Iterator[Finding]:
    """Bodies that stand beside each other, and pieces that nothing joins, by cells of 50 mm."""
    points = scan.cloud.points
    lowest = points.min(axis=0)
    cells = tuple(((points[:, k] - lowest[k]) / 50.0).astype(np.int64) for k in range(3))
    occupied = np.zeros([int(index.max()) + 1 for index in cells], bool)
    occupied[cells] = True
    labels, count = ndimage.label(occupied, np.ones((3, 3, 3)))
    if count == 1:
        return
    label = labels[cells]
    share = np.bincount(label)[1:] / len(label)
    order = np.argsort(-share)
    extents = [np.percentile(points[label == k + 1, 2], [1, 99]) for k in order[:4]]
    low, high = extents[0]
    for k, (bottom, top) in zip(order[1:4], extents[1:], strict=True):
        overlap = min(top, high) - max(bottom, low)
        if overlap > SECOND_BODY * (high - low):
            yield "repeat", f"two bodies stand in the scan volume ({share[k]:.0%} in the second)"
        elif share[k] > 0.01:
            yield (
                "usable",
                f"a piece between {bottom:.0f} and {top:.0f} mm ({share[k]:.0%} of the points) is "
                "not joined to the rest by anything measured",
            )


def check_limbs(scan: ScanEvidence) -> Iterator[Finding]:
    """More trunks, legs or arms side by side than one person has, and things beside the legs."""
    mesh = scan.shape
    if mesh is None:
        return
    top = float(mesh.vertices[:, 2].max())
    slicer = MeshSlicer(mesh.vertices, mesh.faces)
    bodies, limbs, things = [], [], []
    for share in np.arange(0.08, 0.95, 0.03):  # every 50 mm of an adult
        level = share * top
        areas = np.array([loop.area_mm2 for loop in slicer.slice(level)])
        if not areas.size:
            continue
        # An arm has 0.2 of the trunk's area, a hand 0.1 of a thigh's; arms raised beside a neck
        # are as large as the neck, but not as a trunk.
        large = int(np.sum(areas > 0.35 * areas.max()))
        legs = share < 0.62  # even if hair hides some of the stature
        if large > (2 if legs else 1) and (legs or areas.max() > 25_000.0):
            bodies.append(level)
        elif np.sum(areas > 1500.0) > (4 if legs else 3):  # a wrist; fingers are smaller
            limbs.append(level)
        elif share < 0.33 and np.sum(areas > 300.0) > 2:  # below hanging hands; a stick of 20 mm
            things.append(level)
    if len(bodies) > 1:
        yield (
            "repeat",
            f"more than one person: at heights from {min(bodies):.0f} to {max(bodies):.0f} mm there "
            "are more trunks or legs than one has",
        )
    if len(limbs) > 1:
        yield (
            "usable",
            f"more limbs than one person has at heights from {min(limbs):.0f} to {max(limbs):.0f} mm. "
            "Possible causes: somebody or something else is in the volume; a pair is misaligned",
        )
    if len(things) > 1:
        yield (
            "usable",
            f"more than two legs at heights from {min(things):.0f} to {max(things):.0f} mm. Possible "
            "causes: a stick, a rail, a chair or an animal. What touches the body is measured as body",
        )


def check_posture(scan: ScanEvidence) -> Iterator[Finding]:
    """A body less than 0.8 times as tall as wide does not stand; held out arms make it square."""
    if scan.shape is None:
        return
    width = float(np.ptp(scan.shape.vertices[:, :2], axis=0).max())
    height = float(scan.shape.vertices[:, 2].max())
    if height < 0.8 * width:
        yield (
            "usable",
            f"the body is {width:.0f} mm wide and {height:.0f} mm tall. Possible causes: the person "
            "lies or bends. Girths are of level sections",
        )


def check_volume(scan: ScanEvidence) -> Iterator[Finding]:
    """Points within 10 mm of the scan volume's top or side, where the body is cut off."""
    x, y, z = scan.cloud.points.T
    volume = scan.rig.volume
    if np.mean(z > volume.top_mm - 10.0) > 3e-4:
        yield "usable", f"cut off at the scan volume's top, {volume.top_mm:.0f} mm: no stature"
    if np.mean(np.hypot(x, y) > volume.radius_mm - 10.0) > 3e-4:
        yield "usable", f"cut off at the scan volume's side, {volume.radius_mm:.0f} mm"


def check_omissions(scan: ScanEvidence) -> Iterator[Finding]:
    """Points farther than 15 mm from the mesh, which is one closed piece."""
    mesh = scan.mesh
    if mesh is None:
        return
    points = scan.cloud.points[:: max(1, len(scan.cloud.points) // 20_000)]
    distance = cKDTree(mesh.vertices).query(points, distance_upper_bound=15.0)[0]
    outside = np.isinf(distance)
    share = float(np.mean(outside))
    if share > 0.01:
        low, high = np.percentile(points[outside, 2], [1, 99])
        tall = high - low > SECOND_BODY * float(mesh.vertices[:, 2].max())
        yield (
            "repeat" if share > 0.2 else "usable",
            f"{share:.0%} of the points, between {low:.0f} and {high:.0f} mm, are not in the mesh, "
            f"which is one piece. Possible causes: {'two people in the volume; ' if tall else ''}"
            "something else in `volume`; a gap that nothing measured bridges",
        )


def check_contacts(scan: ScanEvidence) -> Iterator[Finding]:
    """Closed rings of the body: a hand on the hip, one knee against the other."""
    mesh = scan.shape
    if mesh is None:
        return
    middle = 0.5 * (mesh.vertices[:, 1].min() + mesh.vertices[:, 1].max())
    found = find_handles(mesh.vertices, mesh.faces)
    # Both hands on the hips or holding each other, and touching thighs, knees and heels make five.
    if len(found) > 5:
        yield (
            "usable",
            f"{len(found)} closed rings, more than touching parts of a body form. Possible causes: "
            "something else is in the volume; pairs are misaligned",
        )
        return
    for ring in found:
        side = "left" if ring.y_mm > middle else "right"
        yield (
            "usable",
            f"parts of the body touch: a closed ring on the {side} from {ring.low_mm:.0f} to "
            f"{ring.high_mm:.0f} mm, such as a hand on the hip; girths there hold both parts",
        )
