"""Grade a scan: good, usable for some purposes, or to be repeated."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy import ndimage
from scipy.spatial import cKDTree

from bodyscan.alignment.body_parts import PersonMotion
from bodyscan.alignment.icp import Alignment
from bodyscan.alignment.place_evidence import SizeStep
from bodyscan.alignment.pole_steps import STILL_MM, PoleStep, StepSearch
from bodyscan.alignment.sway_prior import centre_sigmas
from bodyscan.alignment.together import Together
from bodyscan.arrays import Array
from bodyscan.fusion.contradictions import Contradictions
from bodyscan.fusion.crown import Crown
from bodyscan.fusion.seams import SeamReport, find_misfits
from bodyscan.fusion.surface_check import SurfaceCheck
from bodyscan.mesh.body import BodyCloud, BodyMesh
from bodyscan.mesh.slices import MeshSlicer
from bodyscan.mesh.topology import find_handles
from bodyscan.optional import optional
from bodyscan.reconstruction.two_ways import Agreement
from bodyscan.registration.nominal_size import NominalSize, nominal_size
from bodyscan.registration.rig_calibration import RigCalibration
from bodyscan.rig.rig import Volume
from bodyscan.settings import UseLimits
from bodyscan.verdict import LEFT_OUT, Grade, Verdict

Finding = tuple[Grade, str]
GRADES: tuple[Grade, ...] = ("good", "usable", "repeat")

SOME_FILLED, MOST_FILLED = 0.12, 0.5
SOME_DISAGREEMENT_MM, DISAGREEMENT_SIGMAS = 0.4, 2.0
GIRTH_PER_MM = 2.0 * np.pi
"""mm by which a girth is wrong if its surface is 1 mm off all round."""
SOME_CONTRADICTED, MOST_CONTRADICTED = 0.005, 0.02  # below 0.001 where all is well
CALIBRATED_SIGMAS = 3.0
"""Motions of pairs smaller than this may be errors that the boards left open: nobody moved."""
LEFT_OF_MOTION = 0.2
"""Share of a pair's motion that no motion of the whole body explains: arms and breath."""
TWICE, THRICE = 2.0, 3.0
"""Times the usable girth error: for the whole motion; for what following a person left."""
SOME_MOTION_MM = UseLimits().usable_girth_mm / GIRTH_PER_MM / LEFT_OF_MOTION
SOME_LEFT_MM = UseLimits().usable_girth_mm / GIRTH_PER_MM
CAMERA_MM, TURNED_DEG, STAYED = 1000.0, 5.0, 0.25
"""A bumped pole turns about its foot and takes its view of the body with it. If the body's middle
stays within a quarter of that, and the turn is too large for a bump, the body turned. Few cameras
stand nearer to it than this."""
FLOOR_MM = CROWN_MM = 4.0
"""What ISO 20685-1 allows for stature, for all errors; floors are flat to 2 mm over a metre."""
TOP_MM = 20.0  # of a head: if it goes on higher, the mesh is filled there
CELL_MM = 50.0
SIDE_BY_SIDE = 0.4  # of the taller one's height
SMALL_PIECE = 0.01
LEVELS = np.arange(0.08, 0.95, 0.03)
"""of the height: every 50 mm of an adult."""
LEGS = 0.62
"""of the height: below it a person may stand on two legs, even if hair hides some stature."""
BULKY = 0.35
"""of the largest outline at a height: an arm is 0.2 of the trunk, a hand 0.1 of a thigh."""
TRUNK_MM2 = 25_000.0
"""An outline this large is not an arm: arms raised beside a neck are as large as the neck."""
LIMB_MM2 = 1500.0
"""A wrist; fingers are smaller."""
FINGERTIPS = 0.33
"""of the height: hanging hands end at 0.37."""
THING_MM2 = 300.0
"""A stick of 20 mm."""
MOST_RINGS = 5
"""Both hands on the hips or holding each other, and touching thighs, knees and heels: five."""
OUTSIDE_MM = 15.0
SOME_OUTSIDE, MOST_OUTSIDE = 0.01, 0.2
RIM_MM, AT_RIM = 10.0, 3e-4
BAND_MM = 50.0
SOLES_MM = 50.0
ONE_SIDE = 0.7
"""Cosine to the cameras' mean direction: within 45 degrees of it, all of them see the same half."""
UNKNOWN_BAND = 0.5
SOME_SATURATED = 0.05
"""of the skin: highlights on nose and forehead are less."""
LEAST_YIELD = 0.6
"""of the skin: shadows of arms and chin leave 0.85 and more."""


@dataclass(frozen=True, eq=False)
class RigEvidence:
    """What a verdict takes from the rig and its calibration.

    unjudged: pairs with an imported calibration of unknown accuracy.
    nominal: distances between cameras compared with their nominal positions, if known.
    cameras: positions (N, 3) of all the rig's cameras; None for all round. What none of them could
        see is no reason to repeat.
    boards_mm: how well each pair's pose is known, see `centre_sigmas`.
    """

    volume: Volume
    unjudged: tuple[str, ...] = ()
    nominal: NominalSize | None = None
    cameras: Array | None = None
    boards_mm: Mapping[str, float] = field(default_factory=dict)

    @staticmethod
    def of(calibration: RigCalibration) -> RigEvidence:
        pairs, placed = calibration.pairs, calibration.rig_from_camera
        return RigEvidence(
            calibration.rig.volume,
            tuple(name for name, pair in pairs.items() if pair.quality.unjudged),
            nominal_size(calibration.rig, placed),
            np.array([at.translation for at in placed.values()]),
            centre_sigmas(calibration.covariance),
        )


@dataclass(frozen=True, eq=False)
class ImageEvidence:
    """What a verdict takes from the range images.

    failed: pairs that gave none, with the reason.
    silent: poles of which no pair saw anybody.
    agreements: of pairs that project stripes of two directions.
    seams: see `judge_seams`.
    contradictions: see `merge`.
    floor_mm: height at which the floor is seen, see `find_floor`.
    """

    failed: Mapping[str, str] = field(default_factory=dict)
    silent: tuple[str, ...] = ()
    agreements: Mapping[str, Agreement] = field(default_factory=dict)
    seams: SeamReport | None = None
    contradictions: Contradictions | None = None
    floor_mm: float | None = None


def silent_poles(
    poles: Mapping[str, str], asked: Sequence[str], seeing: Sequence[str]
) -> tuple[str, ...]:
    """Poles of which no pair saw anybody. One pair alone may look over a child's head."""
    count = Counter(poles[name] for name in asked if name in poles)
    seen = {poles.get(name) for name in seeing}
    return tuple(pole for pole, pairs in count.items() if pairs > 1 and pole not in seen)


def grade_scan(
    cloud: BodyCloud,
    rig: RigEvidence,
    images: ImageEvidence,
    use: UseLimits,
    *,
    together: Together | None = None,
    person: PersonMotion | None = None,
    mesh: BodyMesh | None = None,
    surface: SurfaceCheck | None = None,
) -> Verdict:
    """Grade a scan by the worst of all findings; the reasons come worst first.

    use: how wrong a girth may be.
    together: what alignment made of the images; None if it took no part.
    person: how a moving body moved.
    mesh: None while there is none; findings that need it are then left out.
    surface: see `check_surface`.

    A check that itself fails leaves the scan usable at best, and says so.
    """
    alignment = together.alignment if together else None
    shifted = together.shifted if together else ()
    size = together.size if together else None
    seams, contradictions = images.seams, images.contradictions
    # Filled surface touches anything and has any shape.
    filled = surface.filled_share if surface else mesh.filled_share if mesh else 1.0
    shape = mesh if filled <= MOST_FILLED else None
    checks: dict[str, Callable[[], Iterable[Finding]]] = {
        "pairs": lambda: _pairs(images.failed, alignment),
        "presence": lambda: _silent(images.silent),
        "calibration": lambda: _calibration(rig.unjudged),
        "nominal places": lambda: _rig_size(rig.nominal),
        "directions": lambda: _directions(images.agreements),
        "seams": lambda: _seams(seams, use),
        "poles": lambda: _shifted(shifted),
        "size": lambda: _size(size, use),
        "floor": lambda: _floor(images.floor_mm, moved=bool(shifted)),
        "places": lambda: _own_places(together.search, use, rig.boards_mm) if together else (),
        "disagreement": lambda: _disagreement(alignment),
        "motion": lambda: _motion(
            None if shifted or size else alignment, person, use, rig.boards_mm
        ),
        "contradictions": lambda: _contradictions(
            contradictions, seams, explained=bool(shifted or size)
        ),
        "pieces": lambda: _company(cloud),
        "limbs": lambda: _limbs(shape) if shape else (),
        "posture": lambda: _posture(shape) if shape else (),
        "cuts": lambda: _cuts(cloud, rig.volume),
        "omissions": lambda: _omissions(cloud, mesh) if mesh else (),
        "contacts": lambda: _contacts(shape) if shape else (),
        "yields": lambda: _yields(surface),
        "gaps": lambda: (
            _other_side(mesh)
            if mesh and _see_one_side(cloud, rig.cameras)
            else _gaps(cloud, surface)
        ),
    }
    return _worst_of(checks)


def _worst_of(checks: Mapping[str, Callable[[], Iterable[Finding]]]) -> Verdict:
    findings: list[Finding] = []
    failures: list[str] = []
    for what, check in checks.items():
        with optional(f"verdict on {what}", failures.append):
            findings += check()
    findings += [("usable", line) for line in failures]
    worst_first = sorted(findings, key=lambda finding: -GRADES.index(finding[0]))
    grade = worst_first[0][0] if worst_first else "good"
    return Verdict(grade, tuple(reason for _, reason in worst_first))


def _pairs(failed: Mapping[str, str], alignment: Alignment | None) -> Iterator[Finding]:
    alike: dict[str, list[str]] = {}
    for name, reason in failed.items():
        alike.setdefault(reason.replace(name, "*"), []).append(name)
    for names in alike.values():
        yield "usable", f"{LEFT_OUT}{', '.join(names)}: {failed[names[0]]}"
    for name in alignment.refused if alignment else ():
        yield (
            "repeat",
            f"pair {name} does not fit the others: it was moved since the calibration, or the "
            "person moved far",
        )


def _silent(poles: Sequence[str]) -> Iterator[Finding]:
    """Poles that saw nobody; `_gaps` says how much of the body is missing."""
    for name in poles:
        yield (
            "usable",
            f"pole {name} saw nobody where the others saw a person: did the person leave, or come, "
            "while poles took turns, or was its projector off?",
        )


def _calibration(unjudged: Sequence[str]) -> Iterator[Finding]:
    if unjudged:
        yield (
            "usable",
            f"the calibration of {', '.join(unjudged)} was made elsewhere and does not say how exact "
            "it is: sigmas hold the decoding alone",
        )


def _rig_size(size: NominalSize | None) -> Iterator[Finding]:
    """The rig's size, because whoever scans need not have read the remarks on the calibration."""
    if size is None or size.mark == "good":
        return
    yield (
        "repeat" if size.mark == "bad" else "usable",
        f"{size.words}, and every girth may be wrong by as much: {size.remedy}",
    )


def _directions(agreements: Mapping[str, Agreement]) -> Iterator[Finding]:
    for name, agreement in agreements.items():
        if agreement.moderate:
            yield (
                "usable",
                f"pair {name}: stripes of both directions disagree by {agreement.words}: its "
                "calibration is off by that, which sigmas do not hold",
            )


def _seams(seams: SeamReport | None, use: UseLimits) -> Iterator[Finding]:
    """Poles and pairs whose surfaces do not continue where the others' end."""
    if seams is None:
        return
    for misfit in find_misfits(seams.seams, seams.groups, use.good_girth_mm / GIRTH_PER_MM):
        yield (
            "repeat" if misfit.step_mm * GIRTH_PER_MM > use.usable_girth_mm else "usable",
            f"{misfit.name} does not fit the others: where their surfaces meet it stands "
            f"{misfit.step_mm:.2g} mm off; did the person turn or step aside meanwhile, was it moved "
            "since the calibration, is it from another scan or another person, were cables or folders "
            "exchanged?",
        )
    for group in seams.untied:
        yield (
            "usable",
            f"nothing ties {', '.join(group)} to the others: they share no surface, so that a person "
            "who moved in between, or a pole that did, would not be seen",
        )


def _shifted(steps: Sequence[PoleStep]) -> Iterator[Finding]:
    """Poles and pairs that alignment found shifted, and corrected.

    What the correction left is for the seams to say. But whether a single pair stands elsewhere or
    measures wrongly (another lens, rows lost), which no pose corrects, cannot be told. And if
    several moved, only the overlaps determine the body's size.
    """
    for step in steps:
        gone = np.radians(step.turn_deg) * CAMERA_MM
        if step.turn_deg > TURNED_DEG and step.shift_mm < STAYED * gone:
            yield (
                "repeat",
                f"the person turned by {step.turn_deg:.0f} degrees before or after {step.name} fired: "
                f"a pole that moved would have gone {gone:.0f} mm round the body's middle for that",
            )
            continue
        yield (
            "repeat" if len(step.pairs) == 1 or len(steps) > 1 or step.all_moved else "usable",
            f"{step.name} stands {step.shift_mm:.1f} mm from where the calibration has it, turned by "
            f"{step.turn_deg:.2f} degrees, by itself and at once, as no person moves: it was moved "
            "since, and brought to the others here; calibrate again, unless `timing` of captures.yaml "
            "is wrong",
        )


def _size(size: SizeStep | None, use: UseLimits) -> Iterator[Finding]:
    """A common step outwards, corrected too; only overlaps then determine the body's size."""
    if size is None:
        return
    costs = abs(size.out_mm) * GIRTH_PER_MM
    where, wrong = ("farther from", "small") if size.out_mm > 0.0 else ("nearer to", "large")
    yield (
        "repeat" if costs > use.usable_girth_mm else "usable",
        f"all poles stand {abs(size.out_mm):.1f} mm (known to {size.sigma_mm:.1f}) {where} the body "
        f"than the calibration has them, as no person moves: girths would be {costs:.0f} mm too "
        f"{wrong}, and now nothing but overlaps holds the body's size; calibrate again",
    )


def _floor(height_mm: float | None, *, moved: bool) -> Iterator[Finding]:
    """The floor's height; moved: whether poles were aligned, perhaps to others that moved."""
    if height_mm is None or abs(height_mm) <= FLOOR_MM:
        return
    yield (
        "repeat" if moved else "usable",
        f"the floor is seen at {height_mm:.0f} mm, heights are counted from 0: a stature is wrong by "
        "as much, and a girth is another height's; were poles lifted or lowered since the calibration, "
        "is `rig_frame` that of this floor, does the person stand on something?",
    )


def _own_places(
    search: StepSearch | None, use: UseLimits, boards_mm: Mapping[str, float]
) -> Iterator[Finding]:
    """Pairs off by more than sway and the boards' own errors explain.

    A person's head and arms may cause that by moving by themselves.
    """
    if search is None:
        return
    boards = np.array(list(boards_mm.values()) or [0.0])
    expected = float(np.sqrt(np.mean(boards**2) / 3.0))  # along one axis
    off = float(np.sqrt(max(search.own_mm**2 - expected**2, 0.0))) * GIRTH_PER_MM
    if off <= use.good_girth_mm:
        return
    sways = search.sway_mm > STILL_MM
    yield (
        "repeat" if off > use.usable_girth_mm and not sways else "usable",
        f"pairs stand {search.own_mm:.1f} mm off the places that the calibration has, otherwise than a "
        f"person sways{': did head or arms move' if sways else ''}, was the rig moved since?",
    )


def _disagreement(alignment: Alignment | None) -> Iterator[Finding]:
    """Noise that sigmas do not include; seams are judged without noise."""
    if alignment is None:
        return
    rms, expected = alignment.rms_after_mm, alignment.expected_mm
    if rms > max(SOME_DISAGREEMENT_MM, DISAGREEMENT_SIGMAS * expected):
        yield (
            "usable",
            f"the pairs disagree by {rms:.2f} mm where they overlap, {expected:.2f} mm is what their "
            "sigmas say: is this the calibration of this rig, has nothing moved since, did the "
            "person stand still?",
        )


def _motion(
    alignment: Alignment | None,
    person: PersonMotion | None,
    use: UseLimits,
    boards_mm: Mapping[str, float],
) -> Iterator[Finding]:
    """The effect of motion on girths.

    If the person was followed, what that left; otherwise how far the pairs were moved, beyond what
    their own pose errors explain.
    """
    for part in person.parts if person else ():
        costs = part.left_mm * GIRTH_PER_MM
        if costs > use.usable_girth_mm:
            yield (
                "repeat" if costs > THRICE * use.usable_girth_mm else "usable",
                f"the {part.name} moved by {part.moved_mm:.1f} mm while it was scanned; corrected "
                f"to {part.left_mm:.1f} mm: repeat if you need it better",
            )
    if person or alignment is None or not alignment.motion_mm:
        return
    beyond = {
        name: np.sqrt(max(mm**2 - (CALIBRATED_SIGMAS * boards_mm.get(name, 0.0)) ** 2, 0.0))
        for name, mm in alignment.motion_mm.items()
    }
    name = max(beyond, key=lambda one: beyond[one])
    costs = beyond[name] * LEFT_OF_MOTION * GIRTH_PER_MM
    if costs > use.usable_girth_mm:
        yield (
            "repeat" if costs > TWICE * use.usable_girth_mm else "usable",
            f"the person moved by {alignment.motion_mm[name]:.1f} mm (pair {name}) between the pairs' "
            "captures",
        )


def _contradictions(
    found: Contradictions | None, seams: SeamReport | None, *, explained: bool
) -> Iterator[Finding]:
    """Pairs that see through each other's surfaces, which nearby points alone do not show.

    explained: whether poles were found to have moved and were aligned, which should have ended
        that.
    """
    if found is None or found.beyond_noise <= SOME_CONTRADICTED:
        return
    if explained:
        yield (
            "repeat",
            f"the pairs contradict each other, {found.share:.1%} of what they say of one another's "
            "points, though poles were brought to the others: it is something else that is wrong, a "
            "pair's own camera or light; has a lens been touched, was the calibration edited?",
        )
        return
    blamed = found.blamed(seams.groups) if seams else ""
    yield (
        "repeat" if found.beyond_noise > MOST_CONTRADICTED else "usable",
        f"{f'{blamed} and the others' if blamed else 'the pairs'} contradict each other: "
        f"{found.share:.1%} of what pairs say of one another's points is that there is no surface; "
        + (
            f"did the person turn or step aside meanwhile, was {blamed} moved since the calibration, "
            "is it from another scan, "
            if blamed
            else "is this the calibration of this rig, has nothing moved since, "
        )
        + "were cables or folders exchanged?",
    )


def _company(cloud: BodyCloud) -> Iterator[Finding]:
    """Bodies that stand beside each other, and pieces that nothing joins."""
    low = cloud.points.min(axis=0)
    cells = tuple(((cloud.points[:, k] - low[k]) / CELL_MM).astype(np.int64) for k in range(3))
    taken = np.zeros([int(place.max()) + 1 for place in cells], bool)
    taken[cells] = True
    labels, count = ndimage.label(taken, np.ones((3, 3, 3)))
    if count == 1:
        return
    label = labels[cells]
    share = np.bincount(label)[1:] / len(label)
    order = np.argsort(-share)
    extents = [np.percentile(cloud.points[label == k + 1, 2], [1, 99]) for k in order[:4]]
    low, high = extents[0]
    for k, (bottom, top) in zip(order[1:4], extents[1:], strict=True):
        beside = min(top, high) - max(bottom, low)
        if beside > SIDE_BY_SIDE * (high - low):
            yield "repeat", f"two bodies stand in the scan volume ({share[k]:.0%} in the second)"
        elif share[k] > SMALL_PIECE:
            yield (
                "usable",
                f"a piece between {bottom:.0f} and {top:.0f} mm ({share[k]:.0%} of the points) is "
                "not joined to the rest by anything measured",
            )


def _limbs(mesh: BodyMesh) -> Iterator[Finding]:
    """More trunks, legs or arms side by side than one person has, and things beside the legs."""
    top = float(mesh.vertices[:, 2].max())
    slicer = MeshSlicer(mesh.vertices, mesh.faces)
    doubled, many, beside = [], [], []
    for share in LEVELS:
        level = share * top
        areas = np.array([loop.area_mm2 for loop in slicer.slice(level)])
        if not areas.size:
            continue
        bulky = int(np.sum(areas > BULKY * areas.max()))
        legs = share < LEGS
        if bulky > (2 if legs else 1) and (legs or areas.max() > TRUNK_MM2):
            doubled.append(level)
        elif np.sum(areas > LIMB_MM2) > (4 if legs else 3):
            many.append(level)
        elif share < FINGERTIPS and np.sum(areas > THING_MM2) > 2:
            beside.append(level)
    if len(doubled) > 1:
        yield (
            "repeat",
            f"more than one person: at heights from {min(doubled):.0f} to {max(doubled):.0f} mm there "
            "are more trunks or legs than one has",
        )
    if len(many) > 1:
        yield (
            "usable",
            f"more limbs than one person has at heights from {min(many):.0f} to {max(many):.0f} mm: is "
            "somebody or something else in the volume, or a pair that does not belong?",
        )

    if len(beside) > 1:
        yield (
            "usable",
            f"more than two legs at heights from {min(beside):.0f} to {max(beside):.0f} mm: is a "
            "stick, a rail, a chair or an animal in the volume? What touches the body is taken for it",
        )


def _posture(mesh: BodyMesh) -> Iterator[Finding]:
    """A body less than 0.8 times as tall as wide does not stand; held out arms make it square."""
    across = float(np.ptp(mesh.vertices[:, :2], axis=0).max())
    top = float(mesh.vertices[:, 2].max())
    if top < 0.8 * across:
        yield (
            "usable",
            f"the body is {across:.0f} mm wide and {top:.0f} mm tall. Possible causes: the person lies "
            "or bends. Girths are of level sections",
        )


def _cuts(cloud: BodyCloud, volume: Volume) -> Iterator[Finding]:
    x, y, z = cloud.points.T
    if np.mean(z > volume.top_mm - RIM_MM) > AT_RIM:
        yield "usable", f"cut off at the scan volume's top, {volume.top_mm:.0f} mm: no stature"
    if np.mean(np.hypot(x, y) > volume.radius_mm - RIM_MM) > AT_RIM:
        yield "usable", f"cut off at the scan volume's side, {volume.radius_mm:.0f} mm"


def _omissions(cloud: BodyCloud, mesh: BodyMesh) -> Iterator[Finding]:
    """Points for which the mesh, one closed piece, has no surface."""
    some = cloud.points[:: max(1, len(cloud.points) // 20_000)]
    distance = cKDTree(mesh.vertices).query(some, distance_upper_bound=OUTSIDE_MM)[0]
    outside = np.isinf(distance)
    share = float(np.mean(outside))
    if share > SOME_OUTSIDE:
        low, high = np.percentile(some[outside, 2], [1, 99])
        tall = high - low > SIDE_BY_SIDE * float(mesh.vertices[:, 2].max())
        yield (
            "repeat" if share > MOST_OUTSIDE else "usable",
            f"{share:.0%} of the points, between {low:.0f} and {high:.0f} mm (z), are not in the mesh,"
            f" which is one piece: {'do two people stand in the volume? S' if tall else 's'}ee whether "
            "`volume` holds anything else",
        )


def _contacts(mesh: BodyMesh) -> Iterator[Finding]:
    middle = 0.5 * (mesh.vertices[:, 1].min() + mesh.vertices[:, 1].max())
    found = find_handles(mesh.vertices, mesh.faces)
    if len(found) > MOST_RINGS:
        yield (
            "usable",
            f"{len(found)} closed rings, more than parts of a body that touch make: is something "
            "else in the volume, do pairs not fit the others?",
        )
        return
    for ring in found:
        side = "left" if ring.y_mm > middle else "right"
        yield (
            "usable",
            f"parts of the body touch: a closed ring on the {side} from {ring.low_mm:.0f} to "
            f"{ring.high_mm:.0f} mm (a hand on the hip?); where they do, girths hold both parts",
        )


def _see_one_side(cloud: BodyCloud, cameras: Array | None) -> bool:
    """Whether all cameras stand on the same side of what was measured."""
    if cameras is None:
        return False
    way = cameras - cloud.points.mean(axis=0)
    way = way / np.linalg.norm(way, axis=1, keepdims=True)
    middle = way.sum(axis=0)
    return bool(np.all(way @ middle >= ONE_SIDE * np.linalg.norm(middle)))


def _other_side(mesh: BodyMesh) -> Iterator[Finding]:
    yield (
        "usable",
        "one side only was seen, as the cameras stand: the mesh's other side is filled "
        f"({mesh.filled_share:.0%} of its surface)",
    )


def _yields(surface: SurfaceCheck | None) -> Iterator[Finding]:
    """Pairs that measured less than they looked at, as shown by what others measured there."""
    if surface is None:
        return
    for name, share in surface.saturated.items():
        if share > SOME_SATURATED:
            yield (
                "usable",
                f"pair {name} is overexposed: {share:.0%} of the skin that it looks at is white in its "
                "lit image; shorten its exposure or dim its projector",
            )
    for name, share in surface.yields.items():
        if share < LEAST_YIELD and surface.saturated[name] <= SOME_SATURATED:
            yield (
                "usable",
                f"pair {name} measured {share:.0%} of the skin that it looks at and others measured: "
                "is it too dark, out of focus, in the wrong place or upside down, is something before "
                "it?",
            )


def _gaps(cloud: BodyCloud, surface: SurfaceCheck | None) -> Iterator[Finding]:
    """The filled share of the whole, and of each height."""
    if surface is None:
        return
    filled = surface.filled_share
    if filled > SOME_FILLED:
        yield (
            "repeat" if filled > MOST_FILLED else "usable",
            f"{filled:.0%} of the surface is filled: nothing was measured there",
        )
    area = surface.areas_mm2
    band = np.maximum(surface.heights_mm / BAND_MM, 0.0).astype(np.int64)
    own = np.bincount(band, area)
    share = np.bincount(band, area * surface.filled) / np.maximum(own, 1e-9)
    seen = np.bincount(np.maximum(cloud.points[:, 2] / BAND_MM, 0).astype(np.int64), None, len(own))
    share[(own == 0.0) & (seen[: len(own)] == 0)] = 1.0  # the mesh begins above it
    unknown = (share > UNKNOWN_BAND) & (BAND_MM * np.arange(len(share)) >= SOLES_MM)
    starts = np.flatnonzero(unknown & ~np.roll(unknown, 1))
    ends = np.flatnonzero(unknown & ~np.roll(unknown, -1)) + 1
    for low, high in zip(starts, ends, strict=True):
        yield (
            "usable",
            f"next to nothing was measured from {BAND_MM * low:.0f} to {BAND_MM * high:.0f} mm "
            "(hair, black cloth, or out of view)",
        )
    # Curls that were measured are not convex: no plane holds them, and none has to.
    top = surface.heights_mm > surface.heights_mm.max() - TOP_MM
    if not surface.filled[top].any():
        return
    crown = Crown.of(cloud.points, cloud.normals)
    if crown.unknown_mm > CROWN_MM:
        yield (
            "usable",
            f"nothing was measured of the crown, and perhaps of all above {crown.highest[2]:.0f} mm "
            "(hair, a cap, or out of view): the stature is a guess",
        )
