"""The person as a function of time: sways on the ankles, breathes, moves arms and head."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import dijkstra

from bodyscan.arrays import Array
from bodyscan.errors import BadInput
from bodyscan.files.atomic import atomic_replacement
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.simulation.scene import Surface
from bodyscan.simulation.settings import Person


@dataclass(frozen=True, eq=False)
class RandomSignal:
    """A smooth random function of time with several components: sums of cosines."""

    hz: Array  # (K,)
    # sizes, phases: (K, n), of n components.
    sizes: Array
    phases: Array

    def at(self, ms: float) -> Array:
        """Values (n,) at a time."""
        turns = 2.0 * np.pi * self.hz[:, None] * (ms / 1000.0)
        return np.sum(self.sizes * np.cos(turns + self.phases), axis=0)


def draw_signal(
    rms: float, components: int, rng: np.random.Generator, *, speed: bool
) -> RandomSignal:
    """Draw a signal whose components together, or with `speed` their rates, have an RMS of `rms`.

    Sizes fall with frequency, so that slow motion dominates.
    """
    # Nearly all power of postural sway is below 1 Hz (Winter 1995, Gait and Posture 3).
    hz = np.geomspace(0.15, 1.2, 6) * rng.uniform(0.9, 1.1, 6)
    sizes = rng.standard_normal((len(hz), components)) / hz[:, None] ** 1.5
    rate = 2.0 * np.pi * hz[:, None] if speed else 1.0
    sizes = sizes * (rms / np.sqrt(0.5 * np.sum((sizes * rate) ** 2)))
    return RandomSignal(hz, sizes, rng.uniform(0.0, 2.0 * np.pi, (len(hz), components)))


@dataclass(frozen=True, eq=False)
class Joint:
    """A part of a body that rotates."""

    weights: Array  # (N,) 1 for vertices that fully rotate with it
    pivot: Array  # (3,) mm
    turn: RandomSignal  # rotation vector, radians

    def rotate(self, vertices: Array, ms: float) -> Array:
        """Rotate vertices (N, 3) by their weights."""
        moved = self.motion(ms).apply(vertices)
        return vertices + self.weights[:, None] * (moved - vertices)

    def motion(self, ms: float) -> RigidTransform:
        """Compute the motion of what fully rotates with it."""
        turn = RigidTransform.from_rotation_vector(self.turn.at(ms), np.zeros(3)).rotation
        return RigidTransform(turn, self.pivot - turn @ self.pivot)


@dataclass(frozen=True)
class Breath:
    """mm: from breathed out to in. period_s. phases: of chest and belly at time 0, radians."""

    mm: float
    period_s: float
    phases: tuple[float, float]

    def at(self, ms: float) -> Array:
        """How far chest and belly stand out (2,), mm; mean 0 over a breath."""
        turns = 2.0 * np.pi * ms / 1000.0 / self.period_s
        return 0.5 * self.mm * np.sin(turns + np.array(self.phases))


@dataclass(frozen=True, eq=False)
class LivingBody:
    """A person who stands as people do."""

    rest: Surface  # at mean breath, upright
    limbs: tuple[Joint, ...]  # both arms, then the head, relative to the trunk
    breath_modes: Array  # (N, 3, 2) motion of each vertex with chest and belly, per mm of breath
    breath: Breath
    ankles: Joint  # the whole body's sway

    def vertices(self, ms: float, *, breathing: bool = True) -> Array:
        """Compute vertices (N, 3) mm, rig frame, at a time since the scan began, or at mean breath."""
        moved = self.rest.vertices
        for limb in self.limbs:
            moved = limb.rotate(moved, ms)
        if breathing:
            moved = moved + self.breath_modes @ self.breath.at(ms)
        return self.ankles.rotate(moved, ms)

    def surface(self, ms: float, *, breathing: bool = True) -> Surface:
        """Build the skin at a time, with normals at rest: nothing rotates more than a degree or so."""
        return replace(self.rest, vertices=self.vertices(ms, breathing=breathing))


def moves(person: Person) -> bool:
    """Whether any part of the person moves while frames are taken."""
    return any((person.sway_mm_s, person.breath_mm, person.arms_deg, person.head_deg))


def animate(still: Surface, person: Person, rng: np.random.Generator) -> LivingBody:
    """Add moving arms and head, breath and sway to a still surface (body heights after ANSUR II).

    Raises BadInput for one without a chest, arms or a head.
    """
    vertices = still.vertices
    height = float(vertices[:, 2].max())
    z = vertices[:, 2] / height
    arms = [_weigh_arm(still, side, height) for side in (-1.0, 1.0)]
    head = _smoothstep(z, 0.835, 0.885) * (1.0 - arms[0]) * (1.0 - arms[1])
    limbs = [(weights, np.radians(person.arms_deg)) for weights in arms]
    limbs += [(head, np.radians(person.head_deg))]
    trunk = (1.0 - arms[0]) * (1.0 - arms[1])
    chest = vertices[(trunk > 0.99) & (z > 0.6) & (z < 0.72)]
    is_flat = len(chest) == 0 or np.ptp(chest[:, :2], axis=0).min() < 0.01 * height
    if is_flat or not all(np.any((weights > 0.3) & (weights < 0.7)) for weights, _ in limbs):
        raise BadInput(
            "the subject has no chest, arms and head that could move",
            remedy="give a standing person, or --subject-preset mannequin",
        )
    joints = tuple(
        # Its joint is where a limb ends.
        Joint(
            weights,
            vertices[(weights > 0.3) & (weights < 0.7)].mean(axis=0),
            draw_signal(rms, 3, rng, speed=False),
        )
        for weights, rms in limbs
    )
    # Leaning forward is a rotation about y, leaning left one about -x; there is none about z.
    pivot = np.array([0.0, 0.0, 0.055 * height])
    lean = draw_signal(person.sway_mm_s / (height - pivot[2]), 2, rng, speed=True)
    flat = np.zeros((len(lean.hz), 1))
    sway = RandomSignal(lean.hz, np.hstack([lean.sizes, flat]), np.hstack([lean.phases, flat]))
    start = float(rng.uniform(0.0, 2.0 * np.pi))
    breath = Breath(
        person.breath_mm,
        person.breath_s * float(rng.uniform(0.95, 1.05)),
        (start, start - 0.6),  # the belly follows the chest
    )
    breath_modes = _compute_breath_modes(vertices, trunk, height)
    return LivingBody(
        still, joints, breath_modes, breath, Joint(_smoothstep(z, 0.035, 0.055), pivot, sway)
    )


def _smoothstep(values: Array, low: float, high: float) -> Array:
    """Interpolate smoothly from 0 below `low` to 1 above `high`."""
    t = np.clip((values - low) / (high - low), 0.0, 1.0)
    return t * t * (3.0 - 2.0 * t)


def _weigh_arm(still: Surface, side: float, height: float) -> Array:
    """Weigh vertices (N,): 1 on the arm towards positive y (side 1) or negative y (-1)."""
    fingertip = int(np.argmax(side * still.vertices[:, 1]))
    along = dijkstra(_build_edges(still), indices=[fingertip], limit=0.6 * height)[0]
    return 1.0 - _smoothstep(along / height, 0.36, 0.46)


def _build_edges(surface: Surface) -> csr_matrix:
    """Build the graph (N, N) of edge lengths between vertices, mm, both directions."""
    ends = surface.triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    lengths = np.linalg.norm(np.diff(surface.vertices[ends], axis=1)[:, 0], axis=1)
    count = len(surface.vertices)
    return csr_matrix((lengths, (ends[:, 0], ends[:, 1])), shape=(count, count))


def _compute_breath_modes(vertices: Array, trunk: Array, height: float) -> Array:
    """Compute motion (N, 3, 2) per mm of chest and belly: front forward, sides out, back not."""
    heights = np.array([0.72, 0.60]) * height
    sigma = 0.065 * height
    rises = np.exp(-0.5 * ((vertices[:, 2:] - heights) / sigma) ** 2)
    level = np.linspace(heights.min(), heights.max(), 50)[:, None]
    rises = rises / np.exp(-0.5 * ((level - heights) / sigma) ** 2).sum(axis=1).max()
    inside = (trunk > 0.99) & (rises.sum(axis=1) > 0.1)
    back, front = np.percentile(vertices[inside, 0], [2.0, 98.0])
    wide = np.percentile(np.abs(vertices[inside, 1]), 98.0)
    forward = _smoothstep((vertices[:, 0] - back) / (front - back), 0.3, 1.0)
    outward = 0.25 * np.clip(vertices[:, 1] / wide, -1.5, 1.5)
    directions = np.stack([forward, outward, np.zeros(len(vertices))], axis=1) * trunk[:, None]
    return directions[:, :, None] * rises[:, None, :]


def describe_motion(body: LivingBody, moment_ms: float) -> dict[str, Any]:
    """Describe for truth.json the moment of the truth's surface and the motion's parameters."""
    return {
        "moment_ms": moment_ms,
        "breath": asdict(body.breath),
        "joints": [
            {"pivot": joint.pivot, **asdict(joint.turn)} for joint in (*body.limbs, body.ankles)
        ],
    }


def save_body(body: LivingBody, path: Path) -> None:
    """Save what does not fit truth.json, for `load_body`; float32 except for positions."""
    weights = [joint.weights for joint in (*body.limbs, body.ankles)]
    with atomic_replacement(path) as temporary, temporary.open("wb") as stream:
        np.savez(
            stream,
            vertices=body.rest.vertices,
            triangles=body.rest.triangles.astype(np.int32),
            weights=np.array(weights, np.float32),
            swells=body.breath_modes.astype(np.float32),
        )


def load_body(motion: dict[str, Any], path: Path) -> LivingBody:
    """Load a simulated body from `motion` in truth.json and truth/body.npz, for any time."""
    with np.load(path) as stored:
        kept = {name: stored[name] for name in stored.files}
    joints = []
    for one, weights in zip(motion["joints"], kept["weights"], strict=True):
        turn = RandomSignal(*(np.array(one[name], float) for name in ("hz", "sizes", "phases")))
        joints.append(Joint(weights.astype(float), np.array(one["pivot"]), turn))
    breath = Breath(**{**motion["breath"], "phases": tuple(motion["breath"]["phases"])})
    rest = Surface(kept["vertices"], kept["triangles"].astype(np.int64))
    return LivingBody(rest, tuple(joints[:-1]), kept["swells"].astype(float), breath, joints[-1])


def load_moving_body(truth: Path) -> LivingBody | None:
    """Load the body of a workspace's folder `truth`; None if it did not move or is unreadable."""
    try:
        motion = json.loads((truth / "truth.json").read_text("utf-8"))["motion"]
        return load_body(motion, truth / "body.npz")
    except (OSError, ValueError, KeyError, TypeError):
        return None
