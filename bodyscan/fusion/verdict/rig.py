"""Checks of the pairs, of the rig's calibration, and of the floor, from which heights count."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Container, Iterator, Mapping, Sequence
from itertools import permutations

import cv2
import numpy as np
from scipy.spatial import cKDTree

from bodyscan.arrays import Array
from bodyscan.errors import group_reasons
from bodyscan.fusion.cleaning import find_inside
from bodyscan.fusion.verdict.evidence import Finding, ScanEvidence
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.reconstruction.range_image import RangeImage
from bodyscan.reconstruction.scan_volume import compute_volume_interval
from bodyscan.rig.rig import Volume
from bodyscan.verdict import LEFT_OUT


def check_pairs(scan: ScanEvidence) -> Iterator[Finding]:
    """Pairs without a range image."""
    for names, reason in group_reasons(scan.images.failed.items()):
        lost = frozenset(names)
        yield Finding("usable", f"{LEFT_OUT}{', '.join(names)}: {reason}", lost, lost)


def find_exchanged(
    images: Sequence[RangeImage],
    rig_from_camera: Mapping[str, RigidTransform],
    volume: Volume,
    read_as: Callable[[str, str], RangeImage | None],
) -> dict[str, str]:
    """Pairs whose images another pair took, and which: what exchanged cables or folders leave.

    images: as decoded. read_as: one pair's read with another's calibration, None if they cannot be.

    Of a pair that is right, 20 % and more of the points lie within 10 mm of what the others
    measured; of a wrong one some 5 %, by chance.
    """
    inside = {image.pair: _select_points_inside(image, rig_from_camera, volume) for image in images}

    def share_near(points: Array, left_out: Collection[str]) -> float:
        rest = [inside[name] for name in inside if name not in left_out]
        if not rest or not len(points):
            return 0.0
        near = cKDTree(np.concatenate(rest)).query(points, distance_upper_bound=10.0)[0]
        return float(np.isfinite(near).mean())

    shares = {name: share_near(points, [name]) for name, points in inside.items()}
    # Six are 30 to read again; if more are wrong, so is what they are compared with.
    doubtful = [name for name, share in shares.items() if share < 0.3]
    suspects = sorted(doubtful, key=lambda name: shares[name])[:6]
    found = {}
    for one, other in permutations(suspects, 2):
        image = read_as(one, other)
        points = (
            _select_points_inside(image, rig_from_camera, volume) if image else np.empty((0, 3))
        )
        if share_near(points, suspects) > max(0.2, 3.0 * share_near(inside[one], suspects)):
            found[one] = other
    return found if set(found) == set(found.values()) else {}


def _select_points_inside(
    image: RangeImage, rig_from_camera: Mapping[str, RigidTransform], volume: Volume
) -> Array:
    """Points (N, 3) of one pixel in 16 that are in the scan volume and not on the floor, rig frame."""
    above = Volume.model_construct(radius_mm=volume.radius_mm, bottom_mm=30.0, top_mm=volume.top_mm)
    some, pose = image.subsample(4), rig_from_camera[image.pair]
    points = image.points[some][find_inside(image, pose, above)[some]]
    return pose.apply(points.astype(np.float64))


def check_exchanged(scan: ScanEvidence) -> Iterator[Finding]:
    """Pairs that have each other's images: nothing else needs to be wrong."""
    taken = scan.images.exchanged
    if not taken:
        return
    swapped = sorted({tuple(sorted(two)) for two in taken.items() if taken[two[1]] == two[0]})
    names = [f"{one} and {other} are swapped" for one, other in swapped]
    names += [f"{one} are those of {of}" for one, of in taken.items() if taken[of] != one]
    yield Finding(
        "repeat",
        f"the images of {', '.join(names)}: with that corrected, they agree with the other pairs. "
        "Exchange the cables, or the names of the folders, and scan again",
        frozenset(taken),
        frozenset(taken),
        spoils=True,
    )


def check_refused(scan: ScanEvidence) -> Iterator[Finding]:
    """Pairs that alignment refused."""
    for name in scan.alignment.refused if scan.alignment else ():
        yield Finding(
            "repeat",
            f"pair {name} does not fit the others. Possible causes: it was moved since the "
            "calibration; the person moved far between the captures",
            frozenset([name]),
        )


def find_silent_poles(
    poles: Mapping[str, str], working: Sequence[str], seeing: Sequence[str]
) -> tuple[str, ...]:
    """Poles of which no pair saw anybody, though several were to; one may look over a child's head.

    poles: the pole of each pair. working: pairs that took part. seeing: those that saw the subject.
    """
    count = Counter(poles[name] for name in working if name in poles)
    seeing_poles = {poles.get(name) for name in seeing}
    return tuple(pole for pole, n in count.items() if n > 1 and pole not in seeing_poles)


def find_misplaced(
    images: Sequence[RangeImage],
    seeing: Container[str],
    rig_from_camera: Mapping[str, RigidTransform],
    volume: Volume,
) -> dict[str, str]:
    """Pairs that saw nothing of the subject and, by their pose or their points, should have; with the
    reason. A pair that looks over a child's head measures nothing, or what is farther away.

    images: as decoded. seeing: the pairs that saw the subject.
    """
    found = {}
    for image in images:
        if image.overexposed or image.pair in seeing:
            continue
        pose, camera = rig_from_camera[image.pair], image.camera
        axes = np.linspace(0.0, camera.width - 1.0, 20), np.linspace(0.0, camera.height - 1.0, 20)
        rays = camera.rays(np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2))
        enter, leave = compute_volume_interval(rays, pose, volume, raised_mm=0.0)
        causes = (
            "Possible causes: its pose is wrong; its images are another pair's. Calibrate again"
        )
        if np.mean(enter < leave) < 0.2:
            found[image.pair] = f"its calibrated pose points it away from the scan volume. {causes}"
            continue
        count = int(np.count_nonzero(image.valid))
        axis_mm = float(np.linalg.norm(pose.translation[:2]))
        depth_mm = float(np.median(image.points[image.valid][:, 2])) if count >= 1000 else np.inf
        if abs(depth_mm - axis_mm) < volume.radius_mm:
            found[image.pair] = (
                f"none of its {count} points is in the scan volume, though they are as far away. "
                f"{causes}"
            )
    return found


def find_compressed(images: Sequence[RangeImage]) -> tuple[str, ...]:
    """Pairs in whose lit image grey levels step between blocks of 8 x 8 pixels, as JPEG leaves them.

    The mean step between neighbours is compared over the eight places in a block, both ways, without
    the largest: a border is one step, often at a multiple of 8. By images of six sets: 1.00 to 1.10
    without compression, 1.26 and more with it.
    """
    found = []
    for image in images:
        ratios = []
        for lines in (image.lit, image.lit.T):
            steps = cv2.absdiff(lines[1:], lines[:-1]).mean(axis=1)
            blocks = np.sort(steps[: len(steps) // 8 * 8].reshape(-1, 8), axis=0)
            phases = blocks[: len(blocks) - max(2, len(blocks) // 16)].mean(axis=0)
            ratios.append(phases.max() / max(float(np.median(phases)), 0.1))  # less is no picture
        if min(ratios) > 1.2:
            found.append(image.pair)
    return tuple(found)


def check_pictures(scan: ScanEvidence) -> Iterator[Finding]:
    """Images that were changed on their way from the sensor: no fault by itself, but the likely cause
    where surfaces disagree."""
    changes = {
        "compressed as JPEG (blocks of 8 x 8 pixels show)": scan.images.compressed,
        "given a video gamma (half of the light is brighter than half)": scan.images.nonlinear,
    }
    found = {change: pairs for change, pairs in changes.items() if pairs}
    if found:
        words = "; ".join(
            f"{change} in {', '.join(p) if len(p) < 5 else f'{len(p)} pairs'}"
            for change, p in found.items()
        )
        yield Finding(
            "good",
            f"images were {words}: save them as the camera delivers them, PNG or TIFF, gamma 1",
            explains=frozenset().union(*found.values()),
        )


def check_silent_poles(scan: ScanEvidence) -> Iterator[Finding]:
    """Poles that saw nobody; `check_gaps` reports how much of the body is missing."""
    for name in scan.images.silent:
        yield Finding(
            "usable",
            f"pole {name} saw nobody where the others saw a person. Possible causes: the person left, "
            "or came, while poles took turns; the pole's projector was off",
            explains=scan.images.absent.difference(scan.images.failed),
        )


def check_calibration(scan: ScanEvidence) -> Iterator[Finding]:
    """Imported calibrations, whose accuracy is unknown."""
    if scan.rig.unjudged:
        yield Finding(
            "usable",
            f"the calibration of {', '.join(scan.rig.unjudged)} was imported, and its accuracy is "
            "unknown: sigmas cover decoding noise only",
        )


def check_nominal_size(scan: ScanEvidence) -> Iterator[Finding]:
    """The rig's size, because whoever scans need not have read the notes on the calibration."""
    size, cameras, points = scan.rig.nominal, scan.rig.cameras, scan.cloud.points
    if size is not None and size.mark != "good":
        yield Finding(
            "repeat" if size.mark == "bad" else "usable",
            f"{size.words}, and every girth may be wrong by the same share: {size.remedy}",
        )
    elif size is None and cameras is not None:
        extent = float(np.ptp(points, axis=0).max())
        distance = float(np.median(np.linalg.norm(cameras - points.mean(axis=0), axis=1)))
        if extent < 230.0 and distance < 250.0:  # tenths of a person, and of what shows all of one
            yield Finding(
                "usable",
                f"the body is {extent:.0f} mm large and seen from {distance:.0f} mm, as a person is in "
                "cm: is square_mm of the boards in mm? Calibrate again with its right value",
                spoils=True,
            )


def check_stripe_directions(scan: ScanEvidence) -> Iterator[Finding]:
    """Depths from stripes of two directions that differ by more than noise."""
    for name, agreement in scan.images.agreements.items():
        if agreement.unusual:
            yield Finding(
                "usable",
                f"pair {name}: depths from the two stripe directions differ by "
                f"{agreement.description}. Its calibration is off by this much; sigmas do not "
                "include it",
            )


def find_floor(
    images: Sequence[RangeImage], rig_from_camera: Mapping[str, RigidTransform], volume: Volume
) -> float | None:
    """Height z of the floor, mm, rig frame.

    The median over the pairs that see level ground within the volume; None if fewer than two do.

    images: as decoded, not cleaned.
    rig_from_camera: as calibrated; a floor does not sway.
    """
    heights = [
        _measure_floor_heights(image, rig_from_camera[image.pair], volume) for image in images
    ]
    # 300 points, of one pixel in 16, are a patch of about 10 x 10 cm.
    medians = [float(np.median(some)) for some in heights if len(some) >= 300]
    return float(np.median(medians)) if len(medians) >= 2 else None


def _measure_floor_heights(
    image: RangeImage, rig_from_camera: RigidTransform, volume: Volume
) -> Array:
    """Heights (N,) of points that face upwards near z = 0, of one pixel in 4 along each axis."""
    some = image.subsample(4)
    valid = image.valid[some]
    points = rig_from_camera.apply(image.points[some][valid].astype(np.float64))
    upward = image.normals[some][valid].astype(np.float64) @ rig_from_camera.rotation[2]
    low = np.abs(points[:, 2]) < 60.0  # higher is an instep, or a step to stand on
    inside = np.hypot(points[:, 0], points[:, 1]) < volume.radius_mm
    level = upward > 0.985  # within 10 degrees: only spots of a foot are as level
    return np.asarray(points[low & inside & level, 2])


def check_floor(scan: ScanEvidence) -> Iterator[Finding]:
    """A floor farther from z = 0 than the 4 mm that ISO 20685-1 allows for stature.

    If poles were aligned, perhaps to others that moved, nothing is known of the heights.
    """
    floor_mm = scan.images.floor_mm
    if floor_mm is None or abs(floor_mm) <= 4.0:
        return
    yield Finding(
        "repeat" if scan.person_alignment and scan.person_alignment.displaced else "usable",
        f"the floor is at {floor_mm:.0f} mm, not at 0: the stature is wrong by as much, and girths are "
        f"taken {abs(floor_mm):.0f} mm too {'low' if floor_mm > 0.0 else 'high'}. Possible causes: "
        "poles were lifted or lowered since the calibration; `rig_frame` is that of another floor; the "
        "person stands on something",
    )
