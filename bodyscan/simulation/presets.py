"""Named settings: whom to scan, and with which devices; and changes of single numbers."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import asdict
from typing import Any

from pydantic import TypeAdapter, ValidationError

from bodyscan.errors import BadInput
from bodyscan.files.model import did_you_mean, format_alternatives
from bodyscan.simulation.settings import SimulationSettings

SUBJECTS: Mapping[str, Mapping[str, Any]] = {
    # Nobody stands like that.
    "mannequin": {},
    # Quiet standing: the head moves at 7 mm/s, as measured with force plates and markers (Winter
    # 1995), breath moves the chest by 4 mm, arms hang free.
    "standing": {"sway_mm_s": 7.0, "breath_mm": 4.0, "arms_deg": 0.5, "head_deg": 0.3},
    # Twice all of it, and quicker breath.
    "restless": {
        "sway_mm_s": 14.0,
        "breath_mm": 8.0,
        "breath_s": 3.0,
        "arms_deg": 1.0,
        "head_deg": 0.6,
    },
    # Six years old: 0.72 as tall, breathes 20 times a minute, looks about.
    "child": {
        "size": 0.72,
        "sway_mm_s": 12.0,
        "breath_mm": 3.0,
        "breath_s": 3.0,
        "arms_deg": 1.5,
        "head_deg": 2.0,
    },
}


_SKIN: Mapping[str, Any] = {
    # Light leaves skin 1.8 mm RMS from where it entered; a little oil shines, as on a dry back.
    "spread_mm": 0.67,
    "gloss": 0.3,
    "mottling": 0.03,
    "moles": 40,
}
LOOKS: Mapping[str, Mapping[str, Any]] = {
    "matt": {},
    "skin": _SKIN,
    # With dark hair, and shorts of dark cotton.
    "dressed": {**_SKIN, "hair": 0.03, "shorts": 0.05},
}

IDEAL, WORKSHOP = "ideal", "workshop"

_WORKSHOP: Mapping[str, Mapping[str, Any]] = {
    "optics": {
        # 8 mm at f/2.8 and 1.3 m: the circle of confusion at half the distance is 3 px wide, which
        # equals the width of a Gaussian with a quarter of that.
        "defocus_px": 0.8,
        # Natural light loss of a lens, slightly corrected.
        "vignetting": 0.8,
        # Half a pixel in the corners, typical of calibrated machine-vision lenses.
        "p_spread": 3e-4,
        "k3_spread": 0.01,
    },
    "lighting": {
        # A window, and lamps with ballasts on 50 Hz mains.
        "window_grey": 6.0,
        "mains_depth": 0.2,
    },
    "noise": {
        # 12,000 electrons at white, EMVA 1288 figures of common sensors.
        "photons": 1.0 / 3.0,
        "pixel_gain": 0.005,
        "pixel_grey": 0.3,
        "gain_flicker": 0.003,
    },
    "board": {
        # An aluminium composite sheet of 0.6 to 1 m, and a large-format printer.
        "warp_mm": (0.1, 1.0),
        "print_error_mm": 0.02,
    },
}
"""A scanner as people build it: the laboratory's real light, and more."""

_WORKSHOP_LIGHT: Mapping[str, Mapping[str, Any]] = {
    # The laboratory's real light: a galvanometer's jitter, the bow of a laser line, speckle
    # averaged over a pixel, a sheet that is sharp at one distance.
    "mirror": {
        "jitter_stripes": 0.01,
        "smile_stripes": 0.2,
        "speckle": 0.06,
        "defocus_stripes": 1.0,
        "flicker": 0.005,
    },
    # No speckle and nothing that turns, but the gamma of video.
    "pinhole": {"defocus_stripes": 1.0, "flicker": 0.005, "gamma": 2.2},
}


def compose_settings(
    projector: str,
    *,
    preset: str = IDEAL,
    subject: str = "mannequin",
    look: str = "matt",
    changes: Iterable[str] = (),
) -> SimulationSettings:
    """Compose settings of a kind of projector, a preset of devices, a person, and single changes.

    projector: `mirror` or `pinhole`.
    preset: `ideal` or `workshop`.
    subject, look: names in `SUBJECTS` and `LOOKS`.
    changes: such as `person.breath_mm=5`.

    Raises BadInput for unknown names and invalid values.
    """
    for what, name, known in (
        ("projector of kind", projector, _WORKSHOP_LIGHT),
        ("preset", preset, (IDEAL, WORKSHOP)),
        ("subject", subject, SUBJECTS),
        ("look", look, LOOKS),
    ):
        if name not in known:
            raise BadInput(
                f"there is no {what} {name!r} to simulate",
                remedy=f"Choose {format_alternatives(known)}.",
            )
    values = asdict(SimulationSettings())
    values["projection"]["kind"] = projector
    values["person"] |= SUBJECTS[subject]
    values["skin"] |= LOOKS[look]
    if preset == WORKSHOP:
        for part, changed in _WORKSHOP.items():
            values[part] |= changed
        values["projection"] |= _WORKSHOP_LIGHT[projector]
    for text in changes:
        _change(values, text)
    try:
        return TypeAdapter(SimulationSettings).validate_python(values)
    except ValidationError as refused:
        first = refused.errors(include_url=False)[0]
        where = ".".join(str(part) for part in first["loc"][:2])
        raise BadInput(f"{where}: {first['msg']} (got {first['input']!r})") from None


def _change(values: Mapping[str, dict[str, Any]], text: str) -> None:
    """Change a number as `person.breath_mm=5` says; BadInput if there is none of that name."""
    key, _, value = text.partition("=")
    part, _, name = key.strip().partition(".")
    for word, known in ((part, values), (name, values.get(part, {}))):
        if word not in known:
            raise BadInput(
                f"--set {key}: {word} is not a setting{did_you_mean(word, known)}",
                remedy="write --set PART.KEY=VALUE, such as person.breath_mm=5; there are "
                f"{', '.join(known)}",
            )
    try:
        values[part][name] = json.loads(value)
    except ValueError:
        values[part][name] = value.strip()
