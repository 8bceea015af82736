"""Basic measurements of a body mesh, in the pose in which the body stood."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from bodyscan.arrays import Array, Bytes, Mask
from bodyscan.errors import BadInput
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.measurement.head import HeadTop, estimate_head_top
from bodyscan.measurement.named import CROWN_MM, Measure, Measures, NamedMeasures, measure_by_name
from bodyscan.measurement.outline import Range, bound_girths, compute_girth_sigma
from bodyscan.mesh.body import (
    HAIR,
    REGION_NAMES,
    SKIN,
    UNSURE,
    BodyMesh,
    BreathAt,
    compute_region_shares,
    select_regions,
)
from bodyscan.mesh.body_frame import find_body_frame, is_upright
from bodyscan.mesh.sliced_parts import Piece, find_parts
from bodyscan.mesh.slices import MeshSlicer
from bodyscan.mesh.topology import compute_face_areas, compute_signed_volume


@dataclass(frozen=True)
class Girth:
    """One part of the body in a horizontal slice."""

    # Trunk, head (above the neck), left leg, right leg, left arm, right arm, other; "trunk and left
    # arm" where the outline goes round both and nothing tells them apart.
    part: str
    girth_mm: float  # along the surface, closed straight where the part touches others
    tape_mm: float  # as a tape runs (convex hull)
    # width_mm, depth_mm: extent to the side and forward.
    width_mm: float
    depth_mm: float
    area_mm2: float
    centre_mm: tuple[float, float]  # (x, y), body frame
    measured: float  # share of girth_mm that was measured, not filled
    # girth_range_mm, tape_range_mm: least and most, given noise and motion (95 %), what was not
    # measured, and what touches: see `bound_girths`.
    girth_range_mm: Range
    tape_range_mm: Range
    # Sigma of girth_mm and tape_mm due to the breath's uncertainty, for the mean breath or the
    # scan's moment; None if that is not known.
    breath_sigma_mm: float | None = None
    # Shares of girth_mm over skin, hair, dark cloth and unsure, by name; None if not known.
    regions: dict[str, float] | None = None
    touches: tuple[str, ...] = ()  # parts that it touches, skin on skin

    @property
    def measured_skin(self) -> float:
        """Share of girth_mm that was measured and is not hair."""
        return self.measured - (self.regions[REGION_NAMES[HAIR]] if self.regions else 0.0)


@dataclass(frozen=True)
class Slice:
    """The parts of the body at one height above the floor."""

    height_mm: float
    girths: tuple[Girth, ...]

    def find_girth(self, part: str) -> Girth | None:
        """Find the largest loop of a part, None if the slice has none."""
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
    facing_known: whether the feet tell front from back, and so left from right; else that is assumed.
    named: landmarks and measures by name; None if they were not asked for.
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
    facing_known: bool = True
    named: NamedMeasures | None = None

    @property
    def measures(self) -> Mapping[str, Measure]:
        """Measures by name, such as "waist girth"; empty if they were not asked for."""
        return Measures() if self.named is None else self.named.measures

    def to_records(self) -> list[dict[str, Any]]:
        """One record for each part of each slice, as tables take them: `pandas.DataFrame(records)`.

        Lengths in mm; ranges as `girth_low_mm`, `girth_high_mm`, `tape_low_mm`, `tape_high_mm`.
        """
        whole = {name: getattr(self, name) for name in ("stature_mm", "volume_l", "area_m2")}
        whole["at_mean_breath"] = self.at_mean_breath
        part = ("part", "girth_mm", "tape_mm", "width_mm", "depth_mm", "area_mm2", "measured")
        ends = ("girth_low_mm", "girth_high_mm", "tape_low_mm", "tape_high_mm")
        return [
            whole
            | {"height_mm": level.height_mm}
            | {name: getattr(girth, name) for name in part}
            | dict(zip(ends, (*girth.girth_range_mm, *girth.tape_range_mm), strict=True))
            for level in self.slices
            for girth in level.girths
        ]


def measure(
    mesh: BodyMesh,
    heights_mm: Sequence[float] | None = None,
    *,
    mean_breath: bool = True,
    named: bool = False,
    anyway: bool = False,
) -> Measurements:
    """Measure stature, volume, area, slices at some heights, and on request measures by name.

    heights_mm: heights of the slices; every 100 mm of the body if None.
    mean_breath: measure a breathing person as at mean breath, instead of at the scan's moment.
    named: whether to lay a body over the scan (seconds), for landmarks and measures by name.

    Raises BadInput for a height without a body, if none fits the scan, or, unless `anyway`, it lies.
    """
    if not anyway and not is_upright(mesh.vertices, mesh.faces):
        what = "the body does not stand: it lies or bends, or much of it is missing"
        raise BadInput(what, remedy="Scan again, or turn the mesh so that z is up.")
    by_name = measure_by_name(mesh) if named else None
    breath, breathes = mesh.breath, mean_breath and mesh.breath is not None
    mesh = mesh.at_mean_breath() if breathes else mesh
    stature = float(mesh.vertices[:, 2].max())
    frame = find_body_frame(mesh.vertices)
    vertices = frame.rig_from_body.inverse().apply(mesh.vertices)
    # If only part of a body was seen, whatever there is of it.
    given = np.arange(100.0, stature, 100.0).tolist() if heights_mm is None else heights_mm
    heights = [float(height) for height in given]
    parts = find_parts(MeshSlicer(vertices, mesh.faces, mesh.filled), heights)
    missing = [height for height in heights if not parts.slices[height]]
    if heights_mm is not None and missing:
        low, high = vertices[:, 2].min(), vertices[:, 2].max()
        remedy = f"Give heights between {low:.0f} and {high:.0f} mm."
        raise BadInput(f"there is no body at a height of {missing[0]:g} mm", remedy=remedy)
    slices = []
    for height in (height for height in heights if height not in missing):
        pieces = sorted(parts.slices[height], key=lambda piece: piece.part)
        slices.append(Slice(height, tuple(_describe_loop(piece, mesh, breath) for piece in pieces)))
    areas = compute_face_areas(mesh.vertices, mesh.faces)
    crown = mesh.vertices[mesh.faces, 2].max(axis=1) > stature - CROWN_MM
    kinds, crown_measured = mesh.face_regions, _compute_share(areas, ~mesh.filled, crown)
    top = _find_crown_region(areas, kinds, crown & ~mesh.filled)
    head = _find_head_top(vertices, mesh, stature, top) if crown_measured > 0.5 else None
    return Measurements(
        stature,
        crown_measured,
        compute_signed_volume(mesh.vertices, mesh.faces) / 1e6,
        float(areas.sum()) / 1e6,
        _compute_share(areas, ~mesh.filled, np.ones_like(crown)),
        tuple(slices),
        frame.rig_from_body,
        breathes,
        top,
        head,
        None if kinds is None else compute_region_shares(kinds, areas),
        frame.known,
        by_name,
    )


def _find_crown_region(areas: Array, kinds: Bytes | None, crown: Mask) -> str | None:
    """The region that makes up more than half of the crown, or "unsure"."""
    if kinds is None or not crown.any():
        return None
    found = compute_region_shares(kinds[crown], areas[crown])
    return next((name for name, share in found.items() if share > 0.5), REGION_NAMES[UNSURE])


def _find_head_top(
    vertices: Array, mesh: BodyMesh, stature: float, crown: str | None
) -> HeadTop | None:
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


def parse_heights(text: str) -> list[float]:
    """Heights written as "800,1050", mm. Raises BadInput if one is not a number, or seems to be the
    decimals of the one before."""
    words = text.split(",")
    try:
        heights = [float(word) for word in words]
    except ValueError as error:
        remedy = "Write mm with commas between: 800,1050."
        raise BadInput(f"{text!r} is not a list of heights", remedy=remedy) from error
    for k in range(1, len(words)):
        if heights[k] < 100.0 <= heights[k - 1]:
            what = f"{text!r}: is {words[k]} the decimals of {words[k - 1]}?"
            remedy = f"Write {words[k - 1]}.{words[k]} with a point, or the lower height first."
            raise BadInput(what, remedy=remedy)
    return heights


def _compute_share(areas: Array, which: Mask, among: Mask) -> float:
    return float(areas[which & among].sum() / max(areas[among].sum(), 1e-12))


def _describe_loop(piece: Piece, mesh: BodyMesh, breath: BreathAt | None) -> Girth:
    """Girth, tape, width, depth, area, 95 % ranges and shares of regions of a slice's loop."""
    loop, kinds = piece.loop, mesh.face_regions
    known = loop.faces >= 0
    corners = mesh.faces[loop.faces]
    # What moves along the normal of a slope, as of a shoulder, moves farther in a level slice.
    level = mesh.normals[corners, :2].mean(axis=1)
    aslant = 1.0 / np.clip(np.linalg.norm(level, axis=1), 0.1, 1.0)
    noise = np.where(known, mesh.sigma_mm[corners].mean(axis=1) * aslant, np.nan)
    sigma, breath_sigma = compute_girth_sigma(loop, noise, sectors=4), None
    if breath is not None:
        lean = np.where(known, breath.sigma_mm[corners].mean(axis=1) * aslant, np.nan)
        breath_sigma = compute_girth_sigma(loop, lean, sectors=1)
    lows, highs = bound_girths(loop)
    depth, width = np.ptp(loop.segments[:, 0], axis=0).tolist()
    x, y = loop.centre.tolist()
    values = loop.girth_mm, loop.tape_mm
    girths, tapes = (
        (max(min(value, low) - 1.96 * sigma, 0.0), max(value, high) + 1.96 * sigma)
        for value, low, high in zip(values, lows, highs, strict=True)
    )
    shares = None if kinds is None else select_regions(kinds, loop.faces)
    return Girth(
        piece.part,
        *values,
        width,
        depth,
        loop.area_mm2,
        (x, y),
        loop.measured_share,
        girths,
        tapes,
        breath_sigma,
        None if shares is None else compute_region_shares(shares, loop.lengths),
        piece.touches,
    )
