"""Named measures of a body: landmarks of a fitted template, and what standards define between them.

Each measure is a file in the folder `measures` beside this one: name, standard, clause, definition,
landmarks, the stance that the standard wants (see `posture`), and one kind:

height     of a landmark above the floor
distance   between two landmarks, straight, or along one axis of the body
girth      as a tape runs round one part, level or square to a limb, at a landmark or a share of the way
           between two; or the widest or narrowest between two
breadth, depth   of a part's level section
tape       along the surface from landmark to landmark, straight across hollows
chain      sum of straight distances from landmark to landmark

Sections are of the scan's mesh; the template says where, and which part is which (`sections`).
Intervals hold the noise of the surface, the breath, and the landmarks' uncertainty: `sigma_mm` of a
measure, of the level of a section (times how it changes there), or of the value of any other kind: the
95 % quantile of errors over 1.96 on random bodies (`data/body/landmark_sigmas.py`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from importlib import resources
from itertools import pairwise
from typing import Any

import numpy as np
import yaml
from scipy.spatial import ConvexHull

from bodyscan.arrays import Array
from bodyscan.body_model.fitting import BASIS_MM
from bodyscan.body_model.registered import RegisteredBody, register_body
from bodyscan.files.model import did_you_mean
from bodyscan.measurement.landmarks import LANDMARK_INFLATION, Landmark, find_landmarks
from bodyscan.measurement.posture import Posture, find_posture
from bodyscan.measurement.sections import UP, BodySections, Section
from bodyscan.mesh.body import BodyMesh
from bodyscan.mesh.slices import compute_hull_perimeter

CROWN_MM = 20.0
"""Height of the crown below the top."""
MIN_MEASURED = 0.9
"""Share of a girth that has to be measured for a single number, unless the template closes the rest."""


@dataclass(frozen=True)
class Measure:
    """Value of a measure, mm, with its 95 % interval."""

    name: str
    kind: str  # one of those above
    mm: float
    interval_mm: tuple[float, float]
    # Share of what the tape touches, or of both ends of a breadth or depth, that was measured.
    measured: float
    is_range: bool  # whether too little was measured for a single number: then it is the interval
    standard: str
    clause: str
    definition: str
    stance: str  # what the standard wants otherwise than the person stood; "" if nothing
    path_mm: Array = field(compare=False, repr=False)  # (N, 3), where it runs, rig frame


class Measures(dict[str, Measure]):
    """Measures by name. A KeyError for another name suggests one."""

    def __missing__(self, name: str) -> Measure:
        hint = did_you_mean(name, self) if self else ": measure(..., named=True) takes them"
        raise KeyError(f"no measure {name!r}{hint}")


@dataclass(frozen=True, eq=False)
class NamedMeasures:
    """Landmarks and measures of one body, by name, and why some are missing; how it stood."""

    landmarks: Mapping[str, Landmark]
    measures: Mapping[str, Measure]
    missing: Mapping[str, str]
    posture: Posture
    body: RegisteredBody


@dataclass(frozen=True, eq=False)
class _Body:
    """What measures are taken of: landmarks (3,) mm, body frame."""

    sections: BodySections
    landmarks: Mapping[str, Array]

    def find_length_noise(self, names: Sequence[str]) -> float:
        """Sigma, mm, of the distance between landmarks due to the surface there. Raises _NotThere where
        pairs disagree by more than the template's shapes lack: it may be laid over either."""
        positions, body = np.array([self.landmarks[name] for name in names]), self.sections.body
        sigma_mm = body.mesh.sigma_mm[np.isfinite(body.mesh.sigma_mm)]
        worst = float(sigma_mm[body.measured_tree.query(positions)[1]].max())
        if 2.0 * worst > BASIS_MM:
            raise _NotThere(f"pairs disagree by {2.0 * worst:.0f} mm at its landmarks")
        return float(np.sqrt(2.0)) * max(worst, float(np.median(self.sections.noise_mm)))


@dataclass(frozen=True, eq=False)
class _Taken:
    """A value, the share of it that was measured, sigma due to surface and breath alone, path (N, 3),
    body frame, the least that it can be, and how much (95 %) is open by what was not measured."""

    mm: float
    measured: float
    sigma_mm: float
    path: Array
    min_mm: float = np.inf
    open_mm: float = np.inf


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

    def fill_in(value: Any, side: str) -> Any:
        if isinstance(value, list):
            return [fill_in(one, side) for one in value]
        return value.replace("{side}", side) if isinstance(value, str) else value

    return [{k: fill_in(v, side) for k, v in definition.items()} for side in ("left", "right")]


def measure_by_name(mesh: BodyMesh) -> NamedMeasures:
    """Fit the template to a scanned body that stands, and take every named measure (mean breath).

    Raises BadInput if the template does not fit: nobody stands there, or too little was seen of them.
    """
    return take_measures(register_body(mesh))


def take_measures(registered: RegisteredBody) -> NamedMeasures:
    """Take every named measure of a mesh over which a template lies."""
    sections = BodySections(registered)
    landmarks = find_landmarks(registered)
    to_body = registered.rig_from_body.inverse()
    positions = {name: to_body.apply(np.array(one.position_mm)) for name, one in landmarks.items()}
    body = _Body(sections, positions)
    posture = find_posture(registered.fitted, positions)
    measures, missing = Measures(), {}
    observed = {name: one for name, one in landmarks.items() if one.found != "unseen"}
    for definition in read_definitions():
        try:
            needed = {*definition.get("landmarks", ()), *definition.get("along", ())}
            if names := sorted(needed - observed.keys()):
                raise _NotThere(f"nothing was measured near its landmark {names[0]}")
            measures[definition["name"]] = _take(body, definition, posture)
        except _NotThere as reason:
            missing[definition["name"]] = str(reason)
    return NamedMeasures(observed, measures, missing, posture, registered)


class _NotThere(Exception):
    """Why a measure cannot be taken."""


def _take(body: _Body, definition: Mapping[str, Any], posture: Posture) -> Measure:
    """Take one measure at its landmarks, and again where its level's uncertainty moves it."""
    kind = _KINDS[definition["kind"]]
    taken, sigma_mm = kind(body, definition, 0.0), LANDMARK_INFLATION * definition["sigma_mm"]
    if "part" in definition:  # a section, moved along its normal
        moved = [kind(body, definition, step * sigma_mm).mm for step in (-1.96, -1.0, 1.0, 1.96)]
    else:
        moved = [taken.mm - 1.96 * sigma_mm, taken.mm + 1.96 * sigma_mm]
    # The surface's errors are independent of the landmarks'.
    margin = 1.96 * taken.sigma_mm
    low = taken.mm - float(np.hypot(taken.mm - min([taken.mm, *moved]), margin))
    high = taken.mm + float(np.hypot(max([taken.mm, *moved]) - taken.mm, margin))
    # Gaps that are narrow, or flat, are closed to some millimetres; 8 are what girths may be off by in
    # one case of twenty.
    is_range = taken.measured < MIN_MEASURED and taken.open_mm > 8.0
    if is_range:
        low = min(low, taken.min_mm)
    return Measure(
        definition["name"],
        definition["kind"],
        taken.mm,
        (low, high),
        taken.measured,
        is_range,
        definition["standard"],
        str(definition.get("clause", "")),
        definition["definition"],
        posture.describe_departure(definition.get("stance", [])),
        body.sections.body.rig_from_body.apply(taken.path),
    )


def _height(body: _Body, definition: Mapping[str, Any], shift_mm: float) -> _Taken:
    noise = float(np.median(body.sections.noise_mm))
    if definition.get("top"):
        vertices, mesh = body.sections.body.vertices, body.sections.body.mesh
        position = vertices[int(np.argmax(vertices[:, 2]))]
        crown = vertices[mesh.faces, 2].max(axis=1) > position[2] - CROWN_MM
        # A crown that nobody saw is closed by a guess, which may be off by as much.
        measured = float((~mesh.filled[crown]).mean())
        noise = noise if measured > 0.5 else CROWN_MM / 1.96
    else:
        position = np.mean([body.landmarks[name] for name in definition["landmarks"]], axis=0)
        measured = 1.0
    path = np.array([position * [1.0, 1.0, 0.0], position])
    return _Taken(float(position[2]), measured, noise, path)


def _distance(body: _Body, definition: Mapping[str, Any], shift_mm: float) -> _Taken:
    points = np.array([body.landmarks[name] for name in definition["landmarks"]])
    gaps = np.diff(points, axis=0)
    if axis := definition.get("axis"):
        gaps = gaps[:, ["xyz".index(axis)]]
    length = float(np.linalg.norm(gaps, axis=1).sum())
    return _Taken(length, 1.0, body.find_length_noise(definition["landmarks"]), points)


def locate_section(
    landmarks: Mapping[str, Array], definition: Mapping[str, Any]
) -> tuple[Array, Array]:
    """Where a girth, breadth or depth is taken: the normal (3,) of its plane, and a point of the plane,
    or of those between which it is sought, (S, 3)."""
    first, last = (landmarks[definition["landmarks"][k]] for k in (0, -1))
    axis = UP
    if "along" in definition:
        start, end = (landmarks[name] for name in definition["along"])
        axis = (start - end) / np.linalg.norm(start - end)
    shares = np.array(definition.get("shares", [0.5]))
    return axis, first + shares[:, None] * (last - first)


def _girth(body: _Body, definition: Mapping[str, Any], shift_mm: float) -> _Taken:
    """Convex hull of a section, level or square to a limb; widest or narrowest where requested."""
    axis, centres = locate_section(body.landmarks, definition)
    levels = (centres @ axis).tolist()
    if "find" in definition:
        levels = np.linspace(levels[0], levels[-1], 15).tolist()
    cuts = _cut(body, definition, axis, [level + shift_mm for level in levels])
    best = {"widest": np.argmax, "narrowest": np.argmin}.get(definition.get("find", ""))
    cut = cuts[0 if best is None else int(best([cut.tape_mm for cut in cuts]))]
    hull = ConvexHull(cut.points).vertices
    path = cut.positions[np.append(hull, hull[0])]
    observed, unseen_mm = cut.points[cut.observed], cut.unseen_sigma_mm
    straight_mm = compute_hull_perimeter(observed) if len(observed) else 0.0
    sigma_mm = float(np.hypot(cut.measured_sigma_mm, unseen_mm))
    return _Taken(cut.tape_mm, cut.tape_measured, sigma_mm, path, straight_mm, 1.96 * unseen_mm)


def _extent(body: _Body, definition: Mapping[str, Any], shift_mm: float) -> _Taken:
    """Extent of a part's level section forward, or to the side."""
    up, centres = locate_section(body.landmarks, definition)
    cut = _cut(body, definition, up, [float(centres[0] @ up) + shift_mm])[0]
    axis = 0 if definition["kind"] == "depth" else 1
    values = cut.points[:, axis]
    ends = [int(values.argmin()), int(values.argmax())]
    path = cut.positions[ends]
    path[:, 1 - axis] = path[:, 1 - axis].mean()
    measured = float(cut.observed[ends].mean())
    sigma_mm = np.hypot(cut.measured_sigma_mm / np.pi, 2.0 * BASIS_MM * (1.0 - measured))
    return _Taken(float(np.ptp(values)), measured, float(sigma_mm), path)


def _cut(
    body: _Body, definition: Mapping[str, Any], axis: Array, levels_mm: list[float]
) -> list[Section]:
    """Sections of a measure's part at those levels where there are any. Raises _NotThere if none is."""
    part = definition["part"]
    names = [part] if isinstance(part, str) else part
    if lost := body.sections.body.missing_parts.intersection(names):
        raise _NotThere(f"less than half of its {min(lost)} fits the scan")
    cuts = [body.sections.cut(axis, level, part) for level in levels_mm]
    if found := [cut for cut in cuts if cut is not None]:
        return found
    raise _NotThere(f"no {' or '.join(names)} lies at its landmarks")


def _tape(body: _Body, definition: Mapping[str, Any], shift_mm: float) -> _Taken:
    """Length from landmark to landmark over the surface's hull, in the plane with `outward`."""
    outward = np.array(definition["outward"], float)
    total, paths = 0.0, []
    for a, b in pairwise(body.landmarks[name] for name in definition["landmarks"]):
        length = float(np.linalg.norm(b - a))
        along = (b - a) / length
        out = outward - (outward @ along) * along
        out /= np.linalg.norm(out)
        across = np.cross(along, out)
        cut = body.sections.cut(across, float(across @ a), "trunk")
        surface = np.zeros((0, 3)) if cut is None else cut.positions
        points = (surface - a) @ np.stack([along, out], axis=1)
        # The surface between two points of a trunk bulges by less than half of their distance.
        near = (points[:, 0] > 0.0) & (points[:, 0] < length) & (np.abs(points[:, 1]) < length / 2)
        chain = np.vstack([[[length, 0.0], [0.0, 0.0]], points[near]])
        # Counterclockwise from the end to the start: the outer side of the hull.
        corners = ConvexHull(np.vstack([chain, [length / 2.0, -length]])).vertices
        outer = np.roll(corners, -int(np.argmax(corners == 0)))
        outer = outer[: int(np.argmax(outer == 1)) + 1]
        total += float(np.linalg.norm(np.diff(chain[outer], axis=0), axis=1).sum())
        paths.append(a + chain[outer][::-1] @ np.stack([along, out]))
    return _Taken(
        total, 1.0, body.find_length_noise(definition["landmarks"]), np.concatenate(paths)
    )


_KINDS = {
    "height": _height,
    "distance": _distance,
    "chain": _distance,
    "girth": _girth,
    "breadth": _extent,
    "depth": _extent,
    "tape": _tape,
}
