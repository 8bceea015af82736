"""Settings by name: whom to scan, and by which projector; and every number by itself."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import asdict, fields, replace
from typing import Any

from pydantic import TypeAdapter, ValidationError

from bodyscan.errors import BadInput
from bodyscan.files.model import alternatives, did_you_mean
from bodyscan.simulation.settings import Projection, SimulationSettings

SUBJECTS: Mapping[str, Mapping[str, Any]] = {
    # Nobody stands like that.
    "mannequin": {},
    # Quiet standing: a head's speed of 7 mm/s, as force plates and markers have it (Winter 1995),
    # breath that moves the chest by 4 mm, arms that hang free.
    "standing": {"sway_mm_s": 7.0, "breath_mm": 4.0, "arms_deg": 0.5, "head_deg": 0.3},
    # Twice all of it, and a quicker breath.
    "restless": {
        "sway_mm_s": 14.0,
        "breath_mm": 8.0,
        "breath_s": 3.0,
        "arms_deg": 1.0,
        "head_deg": 0.6,
    },
    # Of six years: 0.72 as tall, breathes 20 times a minute, looks about.
    "child": {
        "size": 0.72,
        "sway_mm_s": 12.0,
        "breath_mm": 3.0,
        "breath_s": 3.0,
        "arms_deg": 1.5,
        "head_deg": 2.0,
    },
}


def settings_for(
    projector: str,
    *,
    subject: str = "mannequin",
    sway_mm: float = 0.0,
    changes: Iterable[str] = (),
) -> SimulationSettings:
    """Settings with one kind of projector, `mirror` or `pinhole`, a person of `SUBJECTS`, and
    `changes` such as `person.breath_mm=5`.

    Raises BadInput for names and values that there are not.
    """
    if projector not in ("mirror", "pinhole"):
        raise BadInput(
            f"there is no projector of kind {projector!r} to simulate",
            remedy="Choose mirror or pinhole.",
        )
    if subject not in SUBJECTS:
        raise BadInput(
            f"there is no subject {subject!r} to simulate",
            remedy=f"Choose {alternatives(SUBJECTS)}.",
        )
    settings = SimulationSettings()
    if projector == "pinhole":
        settings = replace(settings, projection=Projection(kind="pinhole"))
    person = replace(settings.person, sway_mm=sway_mm, **SUBJECTS[subject])
    return with_changes(replace(settings, person=person), changes)


def with_changes(settings: SimulationSettings, changes: Iterable[str]) -> SimulationSettings:
    """Settings with single numbers changed, such as `person.breath_mm=5`.

    Raises BadInput for a setting that there is not, or a value that it cannot have.
    """
    values = asdict(settings)
    for text in changes:
        key, equals, value = text.partition("=")
        part, dot, name = key.strip().partition(".")
        if not (equals and dot):
            raise BadInput(
                f"--set {text} is not a change",
                remedy="write --set PART.KEY=VALUE, such as person.breath_mm=5",
            )
        for word, known in ((part, values), (name, values.get(part, {}))):
            if word not in known:
                raise BadInput(
                    f"--set {key}: {word} is not a setting{did_you_mean(word, known)}",
                    remedy=f"there are {', '.join(known)}",
                )
        values[part][name] = _value(value.strip())
    return settings_of(values)


def settings_of(values: Mapping[str, Any]) -> SimulationSettings:
    """What `dataclasses.asdict` made of settings, read back; parts that are missing are as they are
    by default. Raises BadInput for a value that a setting cannot have."""
    known = {field.name for field in fields(SimulationSettings)}
    own = {name: part for name, part in values.items() if name in known}
    try:
        return TypeAdapter(SimulationSettings).validate_python(own)
    except ValidationError as refused:
        first = refused.errors(include_url=False)[0]
        where = ".".join(str(part) for part in first["loc"][:2])
        raise BadInput(f"{where}: {first['msg']} (got {first['input']!r})") from None


def _value(text: str) -> Any:
    try:
        return json.loads(text)
    except ValueError:
        return text
