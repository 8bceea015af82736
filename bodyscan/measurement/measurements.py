"""Basic measurements of a body mesh, in the pose in which the body stood."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from bodyscan.arrays import Array, Bytes, Mask
from bodyscan.errors import BadInput
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.measurement.head import HeadTop, estimate_head_top
from bodyscan.measurement.outline import Range, find_outline, holds_middle
from bodyscan.mesh.body import HAIR, REGION_NAMES, SKIN, UNSURE, BodyMesh, compute_region_shares
from bodyscan.mesh.slices import Loop, MeshSlicer
from bodyscan.mesh.topology import LAYER_MM, face_areas, find_handles, signed_volume

CROWN_MM = 20.0
"""Height of the crown below the top."""


@dataclass(frozen=True)
class Girth:
    """One part of the body in a horizontal slice.

    part: trunk (neck and head too), left leg, right leg, left arm, right arm; "trunk and left arm"
        where a hand touches the trunk and the outline goes round both.
    girth_mm: along the surface. A trunk joined to arms by filled surface is cut there, and closed
        straight.
    tape_mm: as a tape runs (convex hull).
    width_mm, depth_mm: extent to the side and forward.
    centre_mm: (x, y), body frame.
    measured: share of girth_mm that was measured, not filled.
    girth_range_mm, tape_range_mm: possible values, given what was not measured: see `Outline`.
    breath_sigma_mm: sigma of girth_mm and tape_mm due to the breath's uncertainty; None if that
        is not known.
    regions: shares of girth_mm over skin, hair, dark cloth and unsure, by name; None if not known.
    """

    part: str
    girth_mm: float
    tape_mm: float
    width_mm: float
    depth_mm: float
    area_mm2: float
    centre_mm: tuple[float, float]
    measured: float
    girth_range_mm: Range
    tape_range_mm: Range
    breath_sigma_mm: float | None = None
    regions: dict[str, float] | None = None

    @property
    def measured_skin(self) -> float:
        """Share of girth_mm that was measured and is not hair."""
        return self.measured - (self.regions[REGION_NAMES[HAIR]] if self.regions else 0.0)


@dataclass(frozen=True)
class Slice:
    """The parts of the body at one height above the floor."""

    height_mm: float
    girths: tuple[Girth, ...]

    def of(self, part: str) -> Girth | None:
        """The largest loop of that part, None if the slice has none."""
        found = [girth for girth in self.girths if girth.part == part]
        return max(found, key=lambda girth: girth.area_mm2) if found else None


@dataclass(frozen=True, eq=False)
class Measurements:
    """Measurements of a body.

    stature_mm: highest point above the floor, in pose, including hair.
    stature_measured: share of the crown's surface (its top 20 mm) that was measured.
    measured: share of the whole surface that was measured.
    at_mean_breath: whether the breath of the scan's own moment was removed.
    crown: the region of most of the measured crown; None if not known.
    head: where the head ends, even under hair; None if unknown.
    regions: shares of the area.
    """

    stature_mm: float
    stature_measured: float
    volume_l: float
    area_m2: float
    measured: float
    slices: tuple[Slice, ...]
    rig_from_body: RigidTransform
    at_mean_breath: bool = False
    crown: str | None = None
    head: HeadTop | None = None
    regions: dict[str, float] | None = None


def measure(
    mesh: BodyMesh, heights_mm: Sequence[float] | None = None, *, mean_breath: bool = True
) -> Measurements:
    """Measure stature, volume, area, and slices at some heights.

    heights_mm: heights of the slices; every 100 mm of the body if None.
    mean_breath: measure a breathing person as at mean breath, instead of at the scan's moment.

    Raises BadInput for a height at which there is no body.
    """
    breathes = mean_breath and mesh.breath is not None
    mesh, fuller = (mesh.at_mean_breath(), mesh.at_mean_breath(1.0)) if breathes else (mesh, None)
    stature = float(mesh.vertices[:, 2].max())
    frame = rig_from_body(mesh.vertices)
    vertices = frame.inverse().apply(mesh.vertices)
    slicer = MeshSlicer(vertices, mesh.faces, mesh.filled, mesh.face_regions)
    contacts = _contacts(slicer)
    # If only part of a body was seen, whatever there is of it.
    heights = np.arange(100.0, stature, 100.0).tolist() if heights_mm is None else heights_mm
    slices = [_slice(slicer, float(height), contacts) for height in heights]
    if heights_mm is not None and None in slices:
        low, high = vertices[:, 2].min(), vertices[:, 2].max()
        raise BadInput(
            f"there is no body at a height of {heights_mm[slices.index(None)]:g} mm",
            remedy=f"Give heights between {low:.0f} and {high:.0f} mm.",
        )
    if fuller is not None:
        more = replace(slicer, vertices=frame.inverse().apply(fuller.vertices))
        slices = [
            found and _add_breath_sigmas(found, _slice(more, found.height_mm, contacts))
            for found in slices
        ]
    areas = face_areas(mesh.vertices, mesh.faces)
    crown = mesh.vertices[mesh.faces, 2].max(axis=1) > stature - CROWN_MM
    kinds, crown_measured = mesh.face_regions, _share(areas, ~mesh.filled, crown)
    top = _crown_region(areas, kinds, crown & ~mesh.filled)
    head = _head_top(vertices, mesh, stature, top) if crown_measured > 0.5 else None
    return Measurements(
        stature,
        crown_measured,
        signed_volume(mesh.vertices, mesh.faces) / 1e6,
        float(areas.sum()) / 1e6,
        _share(areas, ~mesh.filled, np.ones_like(crown)),
        tuple(found for found in slices if found is not None),
        frame,
        breathes,
        top,
        head,
        None if kinds is None else compute_region_shares(kinds, areas),
    )


def _crown_region(areas: Array, kinds: Bytes | None, crown: Mask) -> str | None:
    """The region that makes up more than half of the crown, or "unsure"."""
    if kinds is None or not crown.any():
        return None
    found = compute_region_shares(kinds[crown], areas[crown])
    return next((name for name, share in found.items() if share > 0.5), REGION_NAMES[UNSURE])


def _head_top(vertices: Array, mesh: BodyMesh, stature: float, crown: str | None) -> HeadTop | None:
    """Top of the head: the crown itself if it is bare, or an estimate from the skin around.

    vertices: body frame.
    """
    if mesh.regions is None or crown is None:
        return None
    top = vertices[:, 2] > stature - CROWN_MM
    if crown == REGION_NAMES[SKIN]:
        return HeadTop(stature, float(np.nanmedian(mesh.sigma_mm[top])))
    # A head reaches 150 mm sideways from its crown, and 250 mm down to the chin.
    radius = np.linalg.norm(vertices[:, :2] - np.median(vertices[top, :2], axis=0), axis=1)
    skin = (mesh.regions == SKIN) & (radius < 150.0) & (vertices[:, 2] > stature - 250.0)
    return estimate_head_top(vertices[skin], stature)


def _add_breath_sigmas(level: Slice, fuller: Slice | None) -> Slice:
    """The slice with sigmas: how much longer girths are on a body one sigma of breath fuller."""
    girths = []
    for girth in level.girths:
        other = fuller.of(girth.part) if fuller and girth is level.of(girth.part) else None
        sigma = None if other is None else abs(other.tape_mm - girth.tape_mm)
        girths.append(replace(girth, breath_sigma_mm=sigma))
    return replace(level, girths=tuple(girths))


def heights_from(text: str) -> list[float]:
    """Heights written as "800,1050", mm. Raises BadInput if one is not a number."""
    try:
        return [float(word) for word in text.split(",")]
    except ValueError as error:
        raise BadInput(
            f"{text!r} is not a list of heights", remedy="Write mm with commas between: 800,1050."
        ) from error


def _share(areas: Array, which: Mask, among: Mask) -> float:
    return float(areas[which & among].sum() / max(areas[among].sum(), 1e-12))


@dataclass(frozen=True)
class _Contact:
    """An arm whose hand touches the trunk at heights from low_mm to high_mm; y_mm: of the arm's
    middle just above, body frame. Below the first touch, the hand may keep touching for 200 mm."""

    side: str
    low_mm: float
    high_mm: float
    y_mm: float

    def joins(self, loop: Loop, height_mm: float) -> bool:
        """Whether a trunk's outline goes round the arm as well."""
        reach = loop.segments[..., 1]
        beyond = reach.max() > self.y_mm if self.y_mm > 0 else reach.min() < self.y_mm
        return self.low_mm <= height_mm <= self.high_mm and bool(beyond)


def _contacts(slicer: MeshSlicer) -> list[_Contact]:
    found = []
    for ring in find_handles(slicer.vertices, slicer.faces):
        above = ring.low_mm + 1.5 * LAYER_MM
        loops = _loops(slicer, above)
        side = "left" if ring.y_mm > 0 else "right"
        for part, loop in zip(name_parts(loops), loops, strict=True):
            if part == f"{side} arm":
                y = float(loop.centre[1])
                found.append(_Contact(side, ring.low_mm - 200.0, above, y))
                break
    return found


def _loops(slicer: MeshSlicer, height_mm: float) -> list[Loop]:
    return [loop for loop in slicer.slice(height_mm) if loop.area_mm2 > 50.0]  # less: a fingertip


def _slice(slicer: MeshSlicer, height_mm: float, contacts: Sequence[_Contact]) -> Slice | None:
    """The slice at one height, None if there is no body."""
    loops = _loops(slicer, height_mm)
    if not loops:
        return None
    girths = []
    for part, loop in zip(name_parts(loops), loops, strict=True):
        arms = [one.side for one in contacts if part == "trunk" and one.joins(loop, height_mm)]
        joined = "".join(f" and {side} arm" for side in dict.fromkeys(arms))
        girths.append(_girth(part + joined, loop))
    return Slice(height_mm, tuple(sorted(girths, key=lambda girth: (girth.part, -girth.area_mm2))))


def name_parts(loops: Sequence[Loop]) -> list[str]:
    """Which part of the body each loop of a slice is; body frame, largest loop first.

    A loop with the middle (y = 0) well inside is the trunk, and then all others are arms. If there
    is none, the largest on each side is a leg.
    """
    reach = [(loop.segments[..., 1].min(), loop.segments[..., 1].max()) for loop in loops]
    is_trunk = [holds_middle(loop.segments[..., 1]) for loop in loops]
    names: list[str] = []
    for (low, high), trunk in zip(reach, is_trunk, strict=True):
        side = "left" if low + high > 0 else "right"
        leg = not any(is_trunk) and f"{side} leg" not in names
        names.append("trunk" if trunk else f"{side} leg" if leg else f"{side} arm")
    return names


def _girth(part: str, meshed: Loop) -> Girth:
    found = find_outline(meshed)
    loop = found.loop
    corners = loop.segments[:, 0]
    depth, width = np.ptp(corners, axis=0)
    x, y = loop.centre
    return Girth(
        part,
        loop.girth_mm,
        loop.tape_mm,
        float(width),
        float(depth),
        loop.area_mm2,
        (float(x), float(y)),
        loop.measured_share,
        found.girth_range_mm,
        found.tape_range_mm,
        regions=loop.region_shares,
    )


def rig_from_body(vertices: Array) -> RigidTransform:
    """Estimate the pose of a standing body in the rig frame from evenly spread vertices (V, 3) mm:
    z = 0 on the floor, origin under the body, x where it faces, y to its left.

    The upper body is widest from side to side; it faces the direction nearer to the rig's x.
    """
    # Hips, trunk and arms, which together are wider than deep.
    upper = vertices[vertices[:, 2] > 0.45 * vertices[:, 2].max(), :2]
    middle = 0.5 * (np.percentile(upper, 2, axis=0) + np.percentile(upper, 98, axis=0))
    _, axes = np.linalg.eigh(np.cov((upper - upper.mean(axis=0)).T))
    forward = axes[:, 0] * (1.0 if axes[0, 0] >= 0 else -1.0)
    rotation = np.eye(3)
    rotation[:2, 0], rotation[:2, 1] = forward, [-forward[1], forward[0]]
    return RigidTransform(rotation, np.array([middle[0], middle[1], 0.0]))
