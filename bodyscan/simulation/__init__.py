"""A rig, a body, lenses, light and noise: images with known truth.

It shares no mathematics with what calibrates and reconstructs, so that an error made there shows.
simulate makes a data set, or one shot of a board. settings, presets; layout, plan, board, body, living,
scene (what there is); render, rays, lens, projector, patterns, lamps, sensor (its images); files.
"""

from __future__ import annotations

from bodyscan.simulation.presets import compose_settings
from bodyscan.simulation.settings import SimulationSettings
from bodyscan.simulation.simulate import simulate, simulate_board

__all__ = ["SimulationSettings", "compose_settings", "simulate", "simulate_board"]
