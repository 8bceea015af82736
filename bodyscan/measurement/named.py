"""Named measures of a body: landmarks of a fitted template, and what standards define between them.

Each measure is a file in the folder `measures` beside this one: name, standard, definition, landmarks,
and one kind:

height     of a landmark above the floor
distance   between two landmarks, straight, or along one axis of the body
girth      as a tape runs round one part, level or square to a limb, at a landmark or a share of the way
           between two; or the widest or narrowest between two
breadth, depth   of a part's level slice
tape       along the surface from landmark to landmark, straight across hollows
chain      sum of straight distances from landmark to landmark

Girths, breadths and depths are of the scan's mesh; the template says where, and which part is which.
Intervals hold the noise of the surface, the breath, and the landmarks' uncertainty times how the
measure changes there.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from importlib import resources
from itertools import pairwise
from typing import Any

import numpy as np
import yaml
from scipy.spatial import ConvexHull, KDTree

from bodyscan.arrays import Array, Bytes, Floats
from bodyscan.body_model.fitting import BASIS_MM, FittedBody, Surface, fit_body
from bodyscan.body_model.template import load_template
from bodyscan.errors import BadInput
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.mesh.body import BodyMesh
from bodyscan.mesh.body_parts import find_body_frame
from bodyscan.mesh.slices import MeshSlicer, hull_perimeter
from bodyscan.mesh.topology import vertex_normals

CROWN_MM = 20.0
"""Height of the crown below the top."""
LANDMARK_INFLATION = 1.7
"""Error over sigma of landmarks on the two people of an independent renderer: they have hair, cloth and
breath, which the bodies that sigmas were measured on lack."""
SAMPLES = 80_000
"""Points of the mesh that the template is fitted to: one in 5 mm."""


@dataclass(frozen=True)
class Landmark:
    """A landmark: position (x, y, z) mm, rig frame, and its standard deviation by axis.

    found: "surface" where the scan was measured there, else "template".
    """

    name: str
    position_mm: tuple[float, float, float]
    sigma_mm: float
    found: str


@dataclass(frozen=True)
class Measure:
    """Value of a measure, mm, with its 95 % interval.

    measured: share of what the tape touches that was measured; with less than 0.9 of it the measure is
        the interval rather than the value.
    """

    name: str
    mm: float
    interval_mm: tuple[float, float]
    measured: float
    standard: str
    definition: str

    @property
    def is_range(self) -> bool:
        """Whether too little was measured for a single number."""
        return self.measured < 0.9


@dataclass(frozen=True, eq=False)
class NamedMeasures:
    """Landmarks and measures of one body, by name, and why some are missing."""

    landmarks: Mapping[str, Landmark]
    measures: Mapping[str, Measure]
    missing: Mapping[str, str]


@dataclass(frozen=True, eq=False)
class _Body:
    """A scan's mesh in the body frame with the part of each vertex, and the landmarks there.

    noise_mm, breath_mm: (V,), sigma of the surface, and of its displacement to mean breath.
    slicers: by the direction that is level, made when they are needed.
    """

    vertices: Array
    mesh: BodyMesh
    parts: Bytes
    part_names: tuple[str, ...]
    landmarks: Mapping[str, Array]
    sigma_mm: Mapping[str, float]
    noise_mm: Array
    breath_mm: Array
    slicers: dict[tuple[float, ...], MeshSlicer]


@cache
def read_definitions() -> tuple[dict[str, Any], ...]:
    """Read the definitions of all measures, in the order of their names."""
    folder = resources.files("bodyscan.measurement").joinpath("measures")
    files = sorted((f for f in folder.iterdir() if f.name.endswith(".yaml")), key=lambda f: f.name)
    found = [yaml.safe_load(file.read_text("utf-8")) for file in files]
    return tuple(side for one in found for side in _expand_sides(one))


def _expand_sides(definition: dict[str, Any]) -> list[dict[str, Any]]:
    """One definition for each side, with `{side}` replaced, if it is of both sides."""
    if not definition.get("sides"):
        return [definition]

    def name(value: Any, side: str) -> Any:
        if isinstance(value, list):
            return [name(one, side) for one in value]
        return value.replace("{side}", side) if isinstance(value, str) else value

    return [{k: name(v, side) for k, v in definition.items()} for side in ("left", "right")]


def measure_by_name(mesh: BodyMesh) -> NamedMeasures:
    """Fit the template to a scanned body that stands, and take every named measure (mean breath).

    Raises BadInput if the template does not fit: nobody stands there, or too little was seen of them.
    """
    breath, mesh = mesh.breath, mesh.at_mean_breath()
    rig_from_body = find_body_frame(mesh.vertices).rig_from_body
    template = load_template()
    fitted = fit_body(template, _sample(mesh, rig_from_body.inverse()))
    known = np.isfinite(fitted.distance_mm[~template.hidden])
    if known.mean() < 0.65 or not fitted.rms_mm < 2.0 * BASIS_MM:
        raise BadInput(
            f"no standing body fits the scan: {100.0 * known.mean():.0f} % of one lies on its surface,"
            f" {fitted.rms_mm:.0f} mm off in shape",
            remedy="Named measures need a person who stands with arms and legs apart.",
        )
    rig_from_body, fitted = _face_forward(rig_from_body, fitted)
    return take_measures(mesh, rig_from_body, fitted, None if breath is None else breath.sigma_mm)


def take_measures(
    mesh: BodyMesh,
    rig_from_body: RigidTransform,
    fitted: FittedBody,
    breath_mm: Floats | None = None,
) -> NamedMeasures:
    """Take every named measure of a mesh over which a template lies (body frame).

    breath_mm: (V,), sigma of the vertices' displacement to mean breath.
    """
    template = fitted.template
    body = _locate(mesh, rig_from_body, fitted, breath_mm)
    measures, missing = {}, {}
    for definition in read_definitions():
        try:
            measures[definition["name"]] = _take(body, definition)
        except _NotThere as reason:
            missing[definition["name"]] = str(reason)
    landmarks = {
        name: Landmark(
            name,
            tuple(rig_from_body.apply(at[None])[0].tolist()),
            body.sigma_mm[name],
            "surface" if np.isfinite(fitted.distance_mm[template.landmarks[name]]) else "template",
        )
        for name, at in body.landmarks.items()
    }
    return NamedMeasures(landmarks, measures, missing)


def _face_forward(
    rig_from_body: RigidTransform, fitted: FittedBody
) -> tuple[RigidTransform, FittedBody]:
    """Turn the body frame about its z to where pelvis and chest face."""
    names = fitted.template.joint_names
    facing = sum(fitted.posed.rotations[names.index(name)][:2, 0] for name in ("pelvis", "thorax"))
    x, y = facing / np.linalg.norm(facing)
    turn = RigidTransform(np.array([[x, -y, 0.0], [y, x, 0.0], [0.0, 0.0, 1.0]]), np.zeros(3))
    vertices = turn.inverse().apply(fitted.vertices)
    return rig_from_body @ turn, replace(fitted, vertices=vertices)


class _NotThere(Exception):
    """Why a measure cannot be taken."""


def _sample(mesh: BodyMesh, body_from_rig: RigidTransform) -> Surface:
    measured = np.flatnonzero(np.isfinite(mesh.sigma_mm))
    some = measured[:: max(1, len(measured) // SAMPLES)]
    normals = mesh.normals[some].astype(np.float64) @ body_from_rig.rotation.T
    return Surface(body_from_rig.apply(mesh.vertices[some]), normals)


def _locate(
    mesh: BodyMesh,
    rig_from_body: RigidTransform,
    fitted: FittedBody,
    breath_mm: Floats | None = None,
) -> _Body:
    """Name every vertex after the closest part of the template, as its normal goes."""
    template = fitted.template
    vertices = rig_from_body.inverse().apply(mesh.vertices)
    normals = mesh.normals.astype(np.float64) @ rig_from_body.rotation
    facing = 40.0 * vertex_normals(fitted.vertices, template.faces).astype(np.float64)
    _, nearest = KDTree(np.hstack([fitted.vertices, facing])).query(
        np.hstack([vertices, 40.0 * normals])
    )
    landmarks = {name: fitted.vertices[at] for name, at in template.landmarks.items()}
    parts = template.parts[nearest]
    sigmas = (LANDMARK_INFLATION * template.landmark_sigma_mm).tolist()
    sigma = dict(zip(template.landmarks, sigmas, strict=True))
    noise = mesh.sigma_mm.astype(np.float64)
    noise[~np.isfinite(noise)] = np.nanmedian(noise)
    breath = np.zeros(len(vertices)) if breath_mm is None else breath_mm.astype(np.float64)
    return _Body(vertices, mesh, parts, template.part_names, landmarks, sigma, noise, breath, {})


def _take(body: _Body, definition: Mapping[str, Any]) -> Measure:
    """Take one measure at its landmarks, and again where its level's uncertainty moves it."""
    kind = _KINDS[definition["kind"]]
    value, measured, noise_mm = kind(body, definition, 0.0)
    sigma_mm = float(np.max([body.sigma_mm[name] for name in definition["landmarks"]]))
    if definition["kind"] in ("girth", "breadth", "depth"):
        moved = [kind(body, definition, step * sigma_mm)[0] for step in (-1.96, -1.0, 1.0, 1.96)]
    else:
        count = len(definition["landmarks"])
        half_width = 1.96 * sigma_mm * (np.sqrt(2.0) if count > 1 else 1.0)
        moved = [value - half_width, value + half_width]
    margin = 1.96 * noise_mm
    low, high = min([value, *moved]) - margin, max([value, *moved]) + margin
    source = definition.get("standard", "")
    return Measure(
        definition["name"], value, (low, high), measured, source, definition["definition"]
    )


Taken = tuple[float, float, float]
"""Value, share of it that was measured, sigma due to surface and breath alone, mm."""


def _height(body: _Body, definition: Mapping[str, Any], shift_mm: float) -> Taken:
    if definition.get("top"):
        top = float(body.vertices[:, 2].max())
        crown = body.vertices[body.mesh.faces, 2].max(axis=1) > top - CROWN_MM
        # A crown that nobody saw is closed by a guess, which may be off by as much.
        measured = float((~body.mesh.filled[crown]).mean())
        noise = float(np.median(body.noise_mm))
        return top, measured, noise if measured > 0.5 else CROWN_MM / 1.96
    heights = [body.landmarks[name][2] for name in definition["landmarks"]]
    return float(np.mean(heights)), 1.0, float(np.median(body.noise_mm))


def _distance(body: _Body, definition: Mapping[str, Any], shift_mm: float) -> Taken:
    one, other = (body.landmarks[name] for name in definition["landmarks"])
    axis = definition.get("axis")
    gap = other - one if axis is None else (other - one)["xyz".index(axis)]
    return float(np.linalg.norm(gap)), 1.0, float(np.sqrt(2.0) * np.median(body.noise_mm))


def _chain(body: _Body, definition: Mapping[str, Any], shift_mm: float) -> Taken:
    points = [body.landmarks[name] for name in definition["landmarks"]]
    length = sum(float(np.linalg.norm(b - a)) for a, b in pairwise(points))
    return length, 1.0, float(np.sqrt(2.0) * np.median(body.noise_mm))


def _girth(body: _Body, definition: Mapping[str, Any], shift_mm: float) -> Taken:
    """Convex hull of one part's slice, level or square to a limb; widest or narrowest where asked."""
    points = [body.landmarks[name] for name in definition["landmarks"]]
    axis = np.array([0.0, 0.0, 1.0])
    if "along" in definition:
        start, end = (body.landmarks[name] for name in definition["along"])
        axis = (start - end) / np.linalg.norm(start - end)
    first, last = points[0], points[-1]
    shares = definition.get("shares", [0.5])
    levels = [float(axis @ (first + share * (last - first))) for share in shares]
    if "find" in definition:
        levels = np.linspace(levels[0], levels[-1], 15).tolist()
    part = definition["part"]
    cuts = [_slice(body, axis, part, level + shift_mm) for level in levels]
    taken = [cut for cut in cuts if cut is not None]
    if not taken:
        raise _NotThere(f"no {part} lies at its landmarks")
    girths = [hull_perimeter(piece) for piece, _, _ in taken]
    best = {"widest": np.argmax, "narrowest": np.argmin}.get(definition.get("find", ""))
    chosen = 0 if best is None else int(best(girths))
    return girths[chosen], taken[chosen][1], taken[chosen][2]


def _extent(body: _Body, definition: Mapping[str, Any], shift_mm: float) -> Taken:
    """Extent of a part's level slice forward, or to the side."""
    level = float(np.mean([body.landmarks[name][2] for name in definition["landmarks"]]))
    up = np.array([0.0, 0.0, 1.0])
    cut = _slice(body, up, definition["part"], level + shift_mm)
    if cut is None:
        raise _NotThere(f"no {definition['part']} lies at its landmarks")
    piece, measured, girth_sigma = cut
    axis = 0 if definition["kind"] == "depth" else 1
    return float(np.ptp(piece[:, axis])), measured, girth_sigma / np.pi


def _tape(body: _Body, definition: Mapping[str, Any], shift_mm: float) -> Taken:
    """Length from landmark to landmark over the surface's hull, in the plane with `outward`."""
    total, outward = 0.0, np.array(definition["outward"], float)
    trunk = [body.part_names.index(name) for name in ("trunk", "neck")]
    on_trunk = np.isin(body.parts[body.mesh.faces], trunk).sum(axis=1) >= 2
    for a, b in pairwise(body.landmarks[name] for name in definition["landmarks"]):
        length = float(np.linalg.norm(b - a))
        along = (b - a) / length
        out = outward - (outward @ along) * along
        out /= np.linalg.norm(out)
        frame = np.stack([along, out, np.cross(along, out)])
        local = (body.vertices - a) @ frame.T
        loops = MeshSlicer(local, body.mesh.faces, body.mesh.filled).slice(0.0)
        points = np.vstack(
            [np.zeros((0, 2))] + [loop.segments[on_trunk[loop.faces], 0] for loop in loops]
        )
        # The surface between two points of a trunk bulges by less than half of their distance.
        near = (points[:, 0] > 0.0) & (points[:, 0] < length) & (np.abs(points[:, 1]) < length / 2)
        chain = np.vstack([[[length, 0.0], [0.0, 0.0]], points[near]])
        # Counterclockwise from the end to the start: the outer side of the hull.
        corners = ConvexHull(np.vstack([chain, [length / 2.0, -length]])).vertices
        outer = np.roll(corners, -int(np.argmax(corners == 0)))
        outer = outer[: int(np.argmax(outer == 1)) + 1]
        total += float(np.linalg.norm(np.diff(chain[outer], axis=0), axis=1).sum())
    return total, 1.0, float(np.sqrt(2.0) * np.median(body.noise_mm))


_KINDS = {
    "height": _height,
    "distance": _distance,
    "chain": _chain,
    "girth": _girth,
    "breadth": _extent,
    "depth": _extent,
    "tape": _tape,
}


def _slice(
    body: _Body, axis: Array, part: str | Sequence[str], level_mm: float
) -> tuple[Array, float, float] | None:
    """Points (N, 2) of a part in a slice square to an axis, the share of its length that was measured,
    and the sigma of its girth, of the largest loop that has it; None if none has.
    """
    key = tuple(axis.tolist())
    if key not in body.slicers:
        aside = np.cross(axis, [1.0, 0.0, 0.0])
        aside /= np.linalg.norm(aside)
        rotated = body.vertices @ np.stack([np.cross(aside, axis), aside, axis]).T
        body.slicers[key] = MeshSlicer(rotated, body.mesh.faces, body.mesh.filled)
    names = [part] if isinstance(part, str) else part
    wanted = [body.part_names.index(name) for name in names]
    for loop in body.slicers[key].slice(level_mm):
        corners = body.mesh.faces[loop.faces]
        mine = np.isin(body.parts[corners], wanted).sum(axis=1) >= 2
        # A limb by itself has some vertices named after its neighbours.
        if loop.lengths[mine].sum() > 0.8 * loop.girth_mm:
            mine[:] = True
        length = float(loop.lengths[mine].sum())
        # Less is a stray rim of the part.
        if length > 50.0:
            share = float(loop.lengths[mine & loop.measured].sum()) / length
            # Noise is alike over a quarter of the girth, breath all around it.
            noise = np.pi * body.noise_mm[corners[mine]].mean()
            breath = 2.0 * np.pi * body.breath_mm[corners[mine]].mean()
            sigma_mm = float(np.hypot(noise, breath))
            return loop.segments[mine].reshape(-1, 2), share, sigma_mm
    return None
