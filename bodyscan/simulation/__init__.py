"""A rig, a board, a body, lenses, light and noise: images with known truth.

It shares no mathematics with what calibrates and reconstructs, so that an error made there shows.
"""

from __future__ import annotations

from dataclasses import replace

from bodyscan.errors import BadInput
from bodyscan.simulation.settings import Projection, SimulationSettings
from bodyscan.simulation.simulate import simulate

__all__ = ["SimulationSettings", "settings_for", "simulate"]


def settings_for(projector: str) -> SimulationSettings:
    """The default settings with one kind of projector: `mirror` or `pinhole`."""
    if projector == "mirror":
        return SimulationSettings()
    if projector == "pinhole":
        return replace(SimulationSettings(), projection=Projection(kind="pinhole"))
    raise BadInput(
        f"there is no projector of kind {projector!r} to simulate",
        remedy="Choose mirror or pinhole.",
    )
