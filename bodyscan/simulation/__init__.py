"""A rig, a board, a body, lenses, light and noise: images with known truth.

It shares no mathematics with what calibrates and reconstructs, so that an error made there shows.

Read in this order: simulate (a whole data set), settings and presets, layout (the rig as built),
plan (where boards are held), scene, room and artefact, living (the person as a function of time),
clothing and skin; render with view, lens and ray_ends (rays), projector, patterns and gray, lamps,
flicker and inter_reflection (light), sensor and instrument (grey levels), truth, body and board,
files.
"""

from __future__ import annotations

from bodyscan.simulation.presets import settings_for
from bodyscan.simulation.settings import SimulationSettings
from bodyscan.simulation.simulate import simulate

__all__ = ["SimulationSettings", "settings_for", "simulate"]
