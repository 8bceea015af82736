"""Checks of the shape: more than one person, other things in the volume, parts that are cut off."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise

import numpy as np
from scipy import ndimage
from scipy.spatial import cKDTree

from bodyscan.fusion.verdict.evidence import Finding, ScanEvidence
from bodyscan.mesh.body_frame import ARMPIT, is_upright

SECOND_BODY = 0.4
"""of the first one's height: as tall, it is a body and not a thing beside one."""


def check_pieces(scan: ScanEvidence) -> Iterator[Finding]:
    """Check for several bodies, and for pieces that nothing joins, by cells of 50 mm."""
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
            yield Finding(
                "repeat", f"two bodies stand in the scan volume ({share[k]:.0%} in the second)"
            )
        elif share[k] > 0.01:
            yield Finding(
                "usable",
                f"a piece between {bottom:.0f} and {top:.0f} mm ({share[k]:.0%} of the points) is "
                "not joined to the rest by anything measured",
            )


def check_limbs(scan: ScanEvidence) -> Iterator[Finding]:
    """What is no trunk, leg or arm of one person: another one, or a thing beside the legs."""
    if scan.parts is None:
        return
    slices = scan.parts.slices.items()
    areas = {h: [(p.part, p.loop.area_mm2) for p in pieces] for h, pieces in slices if pieces}
    largest = {h: max(area for _, area in some) for h, some in areas.items()}
    other = {h: max((a for p, a in some if p == "other"), default=0.0) for h, some in areas.items()}
    # An arm has 0.2 of the trunk's area; a stick of 20 mm has 300 mm2.
    bodies = [height for height, area in other.items() if area > 0.35 * largest[height]]
    things = [height for height, area in other.items() if area > 300.0]
    if bodies and max(bodies) - min(bodies) > SECOND_BODY * max(largest):
        yield Finding(
            "repeat",
            f"more than one person: at heights from {min(bodies):.0f} to {max(bodies):.0f} mm there "
            "are more trunks or legs than one has",
        )
    elif len(things) > 3:  # 50 mm of an adult
        yield Finding(
            "usable",
            f"besides one person's trunk, legs and arms there is something from {min(things):.0f} to "
            f"{max(things):.0f} mm. Possible causes: a stool, a stick, a rail or an animal; somebody's "
            "arm; a pair is misaligned. What touches the body is measured as body",
        )


def check_posture(scan: ScanEvidence) -> Iterator[Finding]:
    """A body that does not extend farthest upwards does not stand, see `is_upright`."""
    if scan.shape is not None and not is_upright(scan.shape.vertices, scan.shape.faces):
        x, y, height = np.ptp(scan.shape.vertices, axis=0)
        yield Finding(
            "usable",
            f"the body is {max(x, y):.0f} mm wide and {height:.0f} mm tall. Possible causes: the "
            "person lies or bends. Girths are horizontal sections",
        )


def check_volume(scan: ScanEvidence) -> Iterator[Finding]:
    """Points within 10 mm of the scan volume's top or side, where the body is cut off."""
    x, y, z = scan.cloud.points.T
    volume = scan.rig.volume
    if np.mean(z > volume.top_mm - 10.0) > 3e-4:
        yield Finding(
            "usable", f"cut off at the scan volume's top, {volume.top_mm:.0f} mm: no stature"
        )
    if np.mean(np.hypot(x, y) > volume.radius_mm - 10.0) > 3e-4:
        yield Finding("usable", f"cut off at the scan volume's side, {volume.radius_mm:.0f} mm")


def check_omissions(scan: ScanEvidence) -> Iterator[Finding]:
    """Points farther than 15 mm from the mesh, which is one closed piece."""
    mesh = scan.mesh
    if mesh is None:
        return
    points = scan.cloud.points[:: max(1, len(scan.cloud.points) // 20_000)]
    # A tree that is not balanced is built in half the time.
    tree = cKDTree(mesh.vertices, compact_nodes=False, balanced_tree=False)
    distance = tree.query(points, distance_upper_bound=15.0)[0]
    outside = np.isinf(distance)
    share = float(np.mean(outside))
    if share > 0.01:
        low, high = np.percentile(points[outside, 2], [1, 99])
        tall = high - low > SECOND_BODY * float(mesh.vertices[:, 2].max())
        yield Finding(
            "repeat" if share > 0.2 else "usable",
            f"{share:.0%} of the points, between {low:.0f} and {high:.0f} mm, are not in the mesh, "
            f"which is one piece. Possible causes: {'two people in the volume; ' if tall else ''}"
            "something else in `volume`; a gap that nothing measured bridges",
        )


def check_contacts(scan: ScanEvidence) -> Iterator[Finding]:
    """Arms that touch the trunk or a leg, beyond the last centimetres below an armpit."""
    if scan.parts is None:
        return
    top = max(scan.parts.slices)
    for arm in ("left arm", "right arm"):
        mine = sorted((c for c in scan.parts.contacts if arm in c.parts), key=lambda c: c.low_mm)
        # From a leg to the trunk above it is one contact.
        gaps = [above.low_mm - below.high_mm > 0.02 * top for below, above in pairwise(mine)]
        for some in np.split(np.array(mine, object), np.flatnonzero(gaps) + 1) if mine else ():
            low, high = some[0].low_mm, some[-1].high_mm
            others = dict.fromkeys(part for one in some for part in one.parts if part != arm)
            if high - low > (0.06 if high > (ARMPIT - 0.06) * top else 0.01) * top:
                yield Finding(
                    "usable",
                    f"the {arm} touches the {' and '.join(others)} from {low:.0f} to {high:.0f} mm: "
                    "hold the arms off. Girths there are given as a range, or of both parts together",
                )
