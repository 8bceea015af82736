"""Landmarks of a registered body: where the template has them, then refined by the surface.

Where a standard defines a landmark by the surface it is moved to where the surface has it: the most
prominent point, the end of a limb. What is defined by bones under the skin, as a waist is by the
lowest rib and the hip bone, stays where the template has it: the level at which a trunk is narrowest
from the front was tried for the waist and is wrong by four times as much.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from bodyscan.arrays import Array, Indices
from bodyscan.body_model.registered import RegisteredBody
from bodyscan.body_model.template import drop_side

PROMINENT = {
    "bust point": (1.0, 0.0, 0.0),
    "gluteal point": (-1.0, 0.0, 0.0),
    "calf": (-1.0, 0.0, 0.0),
    "lateral malleolus": (0.0, 1.0, 0.0),
    "medial malleolus": (0.0, -1.0, 0.0),
    "pronasale": (1.0, 0.0, 0.0),
}
"""Landmarks that are a most prominent point, and the direction in which: forward, outward, up."""
LANDMARK_INFLATION = 1.5
"""Error over sigma on the two people of an independent renderer, where 90 % of the measures' intervals
hold with it: they have hair, cloth and breath, which most bodies that sigmas were measured on lack."""
SEARCH_MM = 5.0
"""How far from the template's landmark a prominence lies (standard deviation): what an expert's hand
finds again."""
SLOPE = 0.05
"""Slope of what lies on a prominence's smooth surface: muscles and folds of 1 mm over 20. It moves the
top of a breast, 60 mm in radius, by 3 mm, and of a chest, 200 mm in radius, by 10: there the template
has the greater weight."""
WINDOW_MM = 25.0
"""Radius within which a prominence is a quadratic."""


@dataclass(frozen=True)
class Landmark:
    """A landmark: position (x, y, z) mm, rig frame, and its standard deviation by axis.

    found: "surface" where the scan was measured there, "refined" if it was moved to what the surface
        shows, "unseen" where nothing was measured within 40 mm or a part is missing, else "template".
    """

    name: str
    position_mm: tuple[float, float, float]
    sigma_mm: float
    found: str


@dataclass(frozen=True, eq=False)
class _Spot:
    """A landmark on its way: position (3,) mm, body frame."""

    position: Array
    found: str


def find_landmarks(body: RegisteredBody) -> dict[str, Landmark]:
    """Find all landmarks, refined where the surface defines them (rig frame)."""
    template = body.fitted.template
    spots = {
        name: _Spot(
            body.fitted.vertices[vertex], "surface" if body.measured[vertex] else "template"
        )
        for name, vertex in template.landmarks.items()
    }
    for name, vertex in template.landmarks.items():
        base = drop_side(name)
        outward = -1.0 if name.startswith("right ") else 1.0
        if base in PROMINENT and spots[name].found == "surface":
            direction = np.array(PROMINENT[base]) * [1.0, outward, 1.0]
            part = int(template.parts[vertex])
            spots[name] = _climb(body, part, direction, spots[name])
    spots |= _find_ends(body, spots)
    positions = np.array([one.position for one in spots.values()])
    away_mm = np.asarray(body.measured_tree.query(positions)[0])
    # Sigmas were measured with 36 mm and less between a landmark and what was measured.
    lost = [name in body.missing_parts for name in template.joint_names]
    moved = template.weights[list(template.landmarks.values())][:, lost].sum(axis=1)
    unseen = np.array(list(spots))[(away_mm > 40.0) | (moved > 0.2)].tolist()
    spots |= {name: replace(spots[name], found="unseen") for name in unseen}
    sigmas = dict(zip(template.landmarks, template.landmark_sigma_mm.tolist(), strict=True))
    return {
        name: Landmark(
            name,
            tuple(body.rig_from_body.apply(spot.position[None])[0].tolist()),
            LANDMARK_INFLATION * sigmas[name],
            spot.found,
        )
        for name, spot in spots.items()
    }


def _select_near(body: RegisteredBody, part: int, centre: Array, radius_mm: float) -> Indices:
    """Measured vertices of a part of the scan within a radius."""
    close = np.abs(body.vertices - centre).max(axis=1) < radius_mm
    close &= np.isfinite(body.mesh.sigma_mm) & (body.parts == part)
    found = np.flatnonzero(close)
    return found[np.linalg.norm(body.vertices[found] - centre, axis=1) < radius_mm]


def _climb(body: RegisteredBody, part: int, direction: Array, start: _Spot) -> _Spot:
    """Move a landmark to the most prominent point near it.

    In a window the surface is a quadratic h(u) over the plane square to the direction. Its top is where
    the gradient is 0, known to SLOPE, and lies within SEARCH_MM of the template's landmark; where the
    surface is flat, or hollow, only the latter counts.
    """
    along = np.eye(3)[int(np.argmin(np.abs(direction)))]
    first = np.cross(direction, along)
    tangents = np.stack([first, np.cross(direction, first)])
    position = start.position
    for _ in range(3):
        near = _select_near(body, part, position, WINDOW_MM)
        if len(near) < 30:
            return start
        offset = body.vertices[near] - position
        (u, v), height = tangents @ offset.T, offset @ direction
        columns = np.stack([np.ones_like(u), u, v, 0.5 * u**2, u * v, 0.5 * v**2], axis=1)
        level, a, b, uu, uv, vv = np.linalg.lstsq(columns, height, rcond=None)[0]
        curvatures, axes = np.linalg.eigh(np.array([[uu, uv], [uv, vv]]))
        curvatures = np.minimum(curvatures, 0.0)
        slope, home = axes.T @ (a, b), axes.T @ tangents @ (start.position - position)
        gradient = home / SEARCH_MM**2 - curvatures * slope / SLOPE**2
        step = gradient / (SEARCH_MM**-2 + (curvatures / SLOPE) ** 2)
        size = float(np.linalg.norm(step))
        step *= min(1.0, 0.6 * WINDOW_MM / max(size, 1e-9))
        rise = level + step @ slope + 0.5 * step**2 @ curvatures
        position = position + (axes @ step) @ tangents + rise * direction
        if size < 0.5:
            break
    return _Spot(position, "refined")


def _find_ends(body: RegisteredBody, spots: Mapping[str, _Spot]) -> dict[str, _Spot]:
    """Ends of the feet: the farthest measured points along the line from heel to toes."""
    found = {}
    template = body.fitted.template
    for side in ("left", "right"):
        heel, toe = (spots[f"{side} {name}"].position for name in ("pternion", "acropodion"))
        along = (toe - heel) * [1.0, 1.0, 0.0]
        along /= np.linalg.norm(along)
        part = template.part_names.index(f"{side} foot")
        for name, direction in (("pternion", -along), ("acropodion", along)):
            spot = spots[f"{side} {name}"]
            near = _select_near(body, part, spot.position, 2.0 * WINDOW_MM)
            if spot.found == "surface" and len(near):
                far = near[int(np.argmax(body.vertices[near] @ direction))]
                found[f"{side} {name}"] = _Spot(body.vertices[far], "refined")
    return found
