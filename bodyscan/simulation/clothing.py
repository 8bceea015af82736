"""What covers a subject: mottled skin with moles, hair on the scalp, a pair of shorts."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from bodyscan.arrays import Array, Mask
from bodyscan.simulation.scene import Surface
from bodyscan.simulation.settings import Skin

MOLE_MM = (1.5, 5.0)
"""Radii; the surface's vertices are 3 mm apart."""
MOLE_ALBEDO = 0.45
"""Relative to the skin around."""

# As shares of the stature.
HAIRLINE, NAPE, SLANT = 0.945, 0.885, 0.5
"""Height of the hairline above the head's middle, height at the nape, rise towards the face."""
KNEE_END, WAIST, HIPS = 0.41, 0.565, 0.15
"""Of shorts; the hands hang farther out than the hips."""


def dress(bare: Surface, skin: Skin, rng: np.random.Generator) -> Surface:
    """The surface covered as `skin` says. Hair is rough: its surface is the truth as well."""
    vertices, albedo = bare.vertices.copy(), np.array(bare.albedo, float)
    if skin.mottling > 0:
        albedo *= 1.0 + skin.mottling * _mottles(vertices, rng)
    for place in rng.integers(len(vertices), size=skin.moles):
        away = np.linalg.norm(vertices - vertices[place], axis=1)
        albedo[away < rng.uniform(*MOLE_MM)] *= MOLE_ALBEDO
    lets_in = np.ones(len(vertices))
    if skin.shorts > 0:
        cloth = wears_shorts(vertices)
        albedo[cloth], lets_in[cloth] = skin.shorts, 0.0
    if skin.hair > 0 and bare.normals is not None:
        hair = grows_hair(vertices)
        albedo[hair], lets_in[hair] = skin.hair, 0.0
        rough = skin.hair_mm * np.abs(rng.standard_normal((int(hair.sum()), 1)))
        vertices[hair] += rough * bare.normals[hair]
    has_effect = skin.spread_mm > 0 or skin.gloss > 0 or skin.oblique_mm > 0
    return replace(bare, vertices=vertices, albedo=albedo, skin=lets_in if has_effect else None)


def waves_through(
    vertices: Array, shortest_mm: float, longest_mm: float, rng: np.random.Generator
) -> Array:
    """(N,) at vertices (N, 3): eight waves in random directions, standard deviation 2."""
    waves = np.zeros(len(vertices))
    for length in np.geomspace(shortest_mm, longest_mm, 8):
        way = rng.standard_normal(3)
        phase = vertices @ (way / np.linalg.norm(way)) * (2.0 * np.pi / length)
        waves += np.cos(phase + rng.uniform(0.0, 2.0 * np.pi))
    return waves


def _mottles(vertices: Array, rng: np.random.Generator) -> Array:
    """(N,) waves 8 to 40 mm long, standard deviation 1."""
    return waves_through(vertices, 8.0, 40.0, rng) / 2.0


def grows_hair(vertices: Array) -> Mask:
    """Vertices (N,) on the scalp: above a line that rises from the nape to the forehead."""
    height = float(vertices[:, 2].max())
    head = vertices[:, 2] > NAPE * height
    middle = 0.5 * (vertices[head, 0].min() + vertices[head, 0].max())
    line = HAIRLINE * height + SLANT * (vertices[:, 0] - middle)
    return head & (vertices[:, 2] > line)


def wears_shorts(vertices: Array) -> Mask:
    """Vertices (N,) from above the knees to the waist."""
    z, y = vertices[:, 2] / vertices[:, 2].max(), vertices[:, 1] / vertices[:, 2].max()
    return (z > KNEE_END) & (z < WAIST) & (np.abs(y) < HIPS)
