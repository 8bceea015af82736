"""Checks of the overlaps: whether surfaces of two pairs continue each other and agree.

Alignment searches a few millimetres far, and does not see what it leaves out: a pair displaced by
more overlaps with nothing, or with something that is not the same spot. Seams compare pairs nearly
up to their rims and over centimetres, by the median of every patch, which noise hardly moves.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from bodyscan.alignment.displaced_poles import group_by_pole
from bodyscan.alignment.matching import (
    NARROW_MARGIN_PX,
    Matches,
    SampledPoints,
    match_projected,
    sample_points,
)
from bodyscan.arrays import Array
from bodyscan.fusion.verdict.evidence import GIRTH_PER_MM, Finding, ScanEvidence, Seam, SeamReport
from bodyscan.geometry.robust import SIGMAS_PER_MEDIAN, group_medians
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.progress import map_threads
from bodyscan.reconstruction.range_image import RangeImage
from bodyscan.rig.rig import find_connected_groups

MAX_DISAGREEMENT_MM = 0.4
"""RMS distance of overlapping surfaces in a good scan, if their sigmas do not predict more."""
SEAM_REACH_MM = 40.0
"""A pole displaced by more shares no surface any more; an arm is farther from the trunk."""


def find_seams(
    images: Sequence[RangeImage],
    rig_from_camera: Mapping[str, RigidTransform],
    poles: Mapping[str, str],
) -> SeamReport:
    """Compare the surfaces of every two pairs by patches, after alignment.

    images: cleaned.
    poles: the pole of each pair that stands on one.
    """
    points = map_threads(lambda im: sample_points(im, 3.0, (NARROW_MARGIN_PX,))[0], images)
    compared = map_threads(
        lambda two: _compare_pairs(*two, rig_from_camera), combinations(points, 2)
    )
    seams = tuple(seam for seam in compared if len(seam.distances_mm))
    names = [image.pair for image in images]
    count = {image.pair: np.count_nonzero(image.valid) for image in images}
    # A pair that measured less than a hundredth of everything affects no girth.
    relevant = [name for name in names if count[name] > 0.01 * sum(count.values())]
    shared = [seam.pairs for seam in seams if set(seam.pairs) <= set(relevant)]
    groups = sorted(
        find_connected_groups(relevant, shared), key=lambda group: (-len(group), min(group))
    )
    isolated = tuple(tuple(sorted(group)) for group in groups[1:])
    return SeamReport(seams, group_by_pole(names, poles), isolated)


def _compare_pairs(
    one: SampledPoints, other: SampledPoints, rig_from_camera: Mapping[str, RigidTransform]
) -> Seam:
    here, there = rig_from_camera[one.image.pair], rig_from_camera[other.image.pair]
    both = (
        match_projected(one, other, here, there, SEAM_REACH_MM),
        match_projected(other, one, there, here, SEAM_REACH_MM),
    )
    patches = [compute_patch_medians(matches) for matches in both]
    distances, sigma = (np.concatenate(part) for part in zip(*patches, strict=True))
    return Seam((one.image.pair, other.image.pair), distances, sigma)


def compute_patch_medians(matches: Matches) -> tuple[Array, Array]:
    """Median distances of patches of 8 matches or more, and their sigmas from the scatter."""
    # In mm, a limb's width: anything narrower affects no girth.
    x, y, z = np.floor(matches.points / 40.0).astype(np.int64).T
    # 4096 patches reach from one end of any volume to the other.
    key = (x * 4096 + y) * 4096 + z
    _, number, count = np.unique(key, return_inverse=True, return_counts=True)
    median = group_medians(matches.distances, number, len(count))
    deviation = group_medians(np.abs(matches.distances - median[number]), number, len(count))
    # 1.2533: sigma of a median over that of a mean. 5 neighbouring matches share their errors.
    independent = np.maximum(count / 5.0, 1.0)
    sigma = 1.2533 * SIGMAS_PER_MEDIAN * deviation / np.sqrt(independent)
    enough = count >= 8
    return np.abs(median[enough]), sigma[enough]


@dataclass(frozen=True)
class Misalignment:
    """A pole or a pair whose surfaces are displaced by `step_mm` where they meet the others'."""

    name: str
    step_mm: float


def find_misaligned(
    seams: Sequence[Seam], groups: Mapping[str, frozenset[str]], limit_mm: float
) -> tuple[Misalignment, ...]:
    """The fewest groups of pairs without which all other steps are within the limit, worst first."""
    found: list[Misalignment] = []
    while _find_largest_step(groups, seams) > limit_mm:
        without = {
            name: [seam for seam in seams if not group.intersection(seam.pairs)]
            for name, group in groups.items()
        }
        steps = {name: _estimate_step_around(group, seams) for name, group in groups.items()}
        worst = min(
            (name for name in groups if steps[name] > limit_mm),
            key=lambda n: (
                max(_find_largest_step(groups, without[n]), limit_mm),
                len(groups[n]),
                -steps[n],
            ),
        )
        found.append(Misalignment(worst, steps[worst]))
        seams = without[worst]
    return tuple(sorted(found, key=lambda one: -one.step_mm))


def estimate_step(seams: Sequence[Seam]) -> float:
    """Step that three of four patches do not exceed, less what noise alone would give, mm.

    One patch in four may show something else, such as hair or a hand that moved.
    """
    distance = np.concatenate([seam.distances_mm for seam in seams])
    sigma = np.concatenate([seam.sigma_mm for seam in seams])
    return float(np.sqrt(max(np.percentile(distance**2 - sigma**2, 75.0), 0.0)))


def _find_largest_step(groups: Mapping[str, frozenset[str]], seams: Sequence[Seam]) -> float:
    return max((_estimate_step_around(group, seams) for group in groups.values()), default=0.0)


def _estimate_step_around(group: frozenset[str], seams: Sequence[Seam]) -> float:
    around = [seam for seam in seams if len(group.intersection(seam.pairs)) == 1]
    return estimate_step(around) if around else 0.0


def check_seams(scan: ScanEvidence) -> Iterator[Finding]:
    """Poles and pairs whose surfaces do not continue where the others' end."""
    report = scan.images.seams
    if report is None:
        return
    limit_mm = scan.use.good_girth_mm / GIRTH_PER_MM
    for group in find_misaligned(report.seams, report.groups, limit_mm):
        yield Finding(
            "repeat" if group.step_mm * GIRTH_PER_MM > scan.use.usable_girth_mm else "usable",
            f"{group.name} does not fit the others: its surface is displaced by {group.step_mm:.2g} mm "
            "where it meets theirs. Possible causes: the person turned or stepped aside meanwhile; it "
            "was moved since the calibration; its images are of another scan or person; cables or "
            "folders were exchanged",
            report.groups[group.name],
            report.groups[group.name],
            spoils=group.step_mm * GIRTH_PER_MM > scan.use.usable_girth_mm,
        )
    for names in report.isolated:
        yield Finding(
            "usable",
            f"{', '.join(names)} shares no surface with the others: if the person, or a pole, moved in "
            "between captures, it would go undetected",
            frozenset(names),
        )


def check_disagreement(scan: ScanEvidence) -> Iterator[Finding]:
    """Noise that sigmas do not include; seams are judged without noise."""
    if scan.alignment is None:
        return
    rms_mm, expected_mm = scan.alignment.rms_after_mm, scan.alignment.expected_mm
    if rms_mm > max(MAX_DISAGREEMENT_MM, 2.0 * expected_mm):
        yield Finding(
            "usable",
            f"the pairs disagree by {rms_mm:.2f} mm RMS where they overlap; their sigmas predict "
            f"{expected_mm:.2f} mm. Possible causes: the calibration is another "
            "rig's; something was moved since; the person did not stand still",
            frozenset(scan.alignment.rig_from_camera),
        )


def check_contradictions(scan: ScanEvidence) -> Iterator[Finding]:
    """Pairs that see through each other's surfaces, which nearby points alone do not show.

    Aligning displaced poles should have ended that. Below 0.001 where all is well.
    """
    found, report = scan.images.contradictions, scan.images.seams
    # Double surfaces in three cubes of 60 mm are more than a hand, which no girth goes round.
    if found is None or (found.beyond_noise <= 0.005 and found.double < 3):
        return
    if scan.poses_corrected and found.beyond_noise > 0.005:
        yield Finding(
            "repeat",
            f"the pairs disagree at {found.share:.1%} of their common points, even with "
            "the displaced poles aligned. Possible causes: a lens or a projector was touched; the "
            "calibration was edited",
        )
        return
    outlier = found.find_outlier(report.groups) if report else ""
    yield Finding(
        "repeat" if found.beyond_noise > 0.02 else "usable",
        f"{f'{outlier} and the others' if outlier else 'the pairs'} disagree: at "
        f"{found.share:.1%} of the pairs' common points one sees no surface where the other does, "
        f"mostly from {found.heights_mm[0]:.0f} to {found.heights_mm[1]:.0f} mm. "
        "Possible causes: an arm or the head moved; "
        + (
            f"the person turned or stepped aside meanwhile; {outlier} was moved since the calibration, "
            "or is from another scan; "
            if outlier
            else "the calibration is another rig's; something was moved since; "
        )
        + "cables or folders were exchanged",
        report.groups[outlier] if report and outlier else frozenset(found.pairs),
    )
