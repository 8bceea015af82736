"""A rig, a board, a body, lenses, light and noise: images with known truth.

It shares no mathematics with what calibrates and reconstructs, so that an error made there shows.
"""

from __future__ import annotations

from dataclasses import replace

from bodyscan.errors import BadInput
from bodyscan.simulation.settings import Person, Projection, SimulationSettings
from bodyscan.simulation.simulate import simulate

__all__ = ["SimulationSettings", "settings_for", "simulate"]


def settings_for(projector: str, *, sway_mm: float = 0.0) -> SimulationSettings:
    """The default settings with one kind of projector, `mirror` or `pinhole`, and a person's sway."""
    settings = SimulationSettings(person=Person(sway_mm=sway_mm))
    if projector == "mirror":
        return settings
    if projector == "pinhole":
        return replace(settings, projection=Projection(kind="pinhole"))
    raise BadInput(
        f"there is no projector of kind {projector!r} to simulate",
        remedy="Choose mirror or pinhole.",
    )
