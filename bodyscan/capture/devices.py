"""The devices that a rig file names: its `capture` key checked, and all of them open."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, TypeVar

import numpy as np
from pydantic import ValidationError

from bodyscan.capture.cameras import CAMERAS, Camera, Place
from bodyscan.capture.projectors import PROJECTORS, Projector
from bodyscan.captures.pattern_files import name_patterns
from bodyscan.errors import BadInput, RigFileError
from bodyscan.files.model import (
    Model,
    Problem,
    did_you_mean,
    format_alternatives,
    make_problem_error,
)
from bodyscan.files.model_file import load_model
from bodyscan.files.registry import Registry
from bodyscan.rig.devices import CapturePlan
from bodyscan.rig.rig import Rig
from bodyscan.stripes.stripe_code import StripeCode

Kind = TypeVar("Kind", bound=Model)


@dataclass(frozen=True, eq=False)
class Devices:
    """A rig's open devices, by pair; a camera alone has no projector."""

    rig: Rig
    plan: CapturePlan
    cameras: Mapping[str, Camera]
    projectors: Mapping[str, Projector]


def load_capture_rig(path: Path) -> Rig:
    """Read a rig file and check its devices too. Raises RigFileError, by line."""
    remedy = "Correct the rig file; docs/station.md explains the key `capture`."
    return load_model(Path(path), Rig, RigFileError, remedy=remedy, also=find_device_problems)


def require_capture(rig: Rig) -> CapturePlan:
    """The rig's capture plan. Raises BadInput if there is none, or its images cannot be taken here."""
    where = f"rig {rig.name}"
    if rig.capture is None:
        remedy = "add the key `capture` to the rig file: docs/station.md shows how"
        raise BadInput("it does not say which devices take its images", where=where, remedy=remedy)
    if rig.exposures:
        raise BadInput(
            "`capture` does not support several exposures per image",
            where=where,
            remedy="take one exposure, or let the cameras' own program fill the folder",
        )
    instruments = [p.name for p in rig.pairs if p.projector and not p.projector.is_projected]
    if instruments:
        raise BadInput(
            f"pair {instruments[0]} is an instrument that projects stripes of its own",
            where=where,
            remedy="let the instrument's own program fill the folder",
        )
    return rig.capture


def find_device_problems(rig: Rig) -> Iterator[Problem]:
    """What is wrong with the keys of the rig's devices, each mistake once."""
    if rig.capture is None:
        return
    found: list[Problem] = []
    for pair in rig.pairs:
        found += _find_key_problems(rig.capture, pair.name, "camera", CAMERAS)
        if pair.projector:
            found += _find_key_problems(rig.capture, pair.name, "projector", PROJECTORS)
    yield from dict.fromkeys(found)


def _find_key_problems(
    plan: CapturePlan, pair: str, role: Literal["camera", "projector"], kinds: Registry[type[Kind]]
) -> Iterator[Problem]:
    keys = getattr(plan.pairs.get(pair), role, {})
    try:
        _parse(kinds, plan.device(role, pair))
    except ValidationError as refused:
        errors = [(each["loc"], each["msg"]) for each in refused.errors(include_url=False)]
        for loc, text in errors:
            in_pair = "kind" in keys or loc[0] in keys
            inside = ("pairs", pair, role) if in_pair else (role,)
            yield ("capture", *inside, *loc), text[:1].lower() + text[1:]


@contextmanager
def open_devices(rig: Rig, base: Path) -> Iterator[Devices]:
    """Open all devices of a rig, and close them at the end.

    base: the folder of the rig file.

    Raises BadInput, which names the pair, for a device that is not there.
    """
    plan = require_capture(rig)
    problems = [f"{'.'.join(map(str, where))}: {text}" for where, text in find_device_problems(rig)]
    if problems:
        raise BadInput("\n".join(problems), where=f"rig {rig.name}")
    cameras: dict[str, Camera] = {}
    projectors: dict[str, Projector] = {}
    shared: dict[str, Any] = {}
    with ExitStack() as closing:
        for pair in rig.pairs:
            place = Place(rig, pair, base, shared, closing)
            kind = _parse(CAMERAS, plan.device("camera", pair.name))
            cameras[pair.name] = camera = kind.open(place)
            closing.callback(camera.close)
            if plan.exposure_ms is not None and camera.exposure_ms is not None:
                camera.expose(plan.exposure_ms)
            if pair.projector:
                projectors[pair.name] = projector = _open_projector(plan, place, pair.projector)
                closing.callback(projector.close)
        yield Devices(rig, plan, cameras, projectors)


def _open_projector(plan: CapturePlan, place: Place, code: StripeCode) -> Projector:
    """Open a pair's projector, with the images that it shows by frame."""
    kind = _parse(PROJECTORS, plan.device("projector", place.pair.name))
    projector, frames = kind.open(place), place.rig.frames
    if kind.delay_ms is not None:
        projector.delay_ms = kind.delay_ms
    patterns = name_patterns(frames, code, code.pattern_images(kind.width, kind.height))
    if frames.board is not None:  # under the room's light
        patterns[frames.board] = np.zeros((kind.height, kind.width), np.uint8)
    projector.load(patterns)
    return projector


def _parse(registry: Registry[type[Kind]], keys: Mapping[str, Any]) -> Kind:
    """Check the keys of a device. Raises pydantic's ValidationError."""
    name = str(keys.get("kind"))
    if name not in registry.names():
        hint = did_you_mean(name, registry.names())
        wrong = f"must be {format_alternatives(registry.names())}{hint} (got {name!r})"
        error = make_problem_error((("kind",), wrong))
        raise ValidationError.from_exception_data("device", [error])
    return registry.find(name).model_validate_json(json.dumps(keys), strict=True)
