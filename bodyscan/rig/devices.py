"""The key `capture` of a rig file: which devices take the images, and in which order."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Literal

from pydantic import Field, PositiveFloat

from bodyscan.files.model import Model, Name, Problem

Order = Literal["one-after-another", "poles", "interleaved"]
Keys = dict[str, Any]


class PairDevices(Model):
    """Keys of one pair's devices, where they differ from those that all pairs share."""

    camera: Keys = Field(default_factory=dict)
    projector: Keys = Field(default_factory=dict)


class CapturePlan(Model):
    """The devices of a rig.

    camera, projector: `kind`, and keys of that kind, which its own file checks (see
        `bodyscan.capture.cameras` and `projectors`).
    pairs: what differs, by pair.
    order: one-after-another: one pair, then the next; poles: all poles at once, the pairs of a pole
        one after another; interleaved: every pair takes its first frame, then every pair its second.
    exposure_ms: of all cameras; None: found on the first subject.
    """

    camera: Keys
    projector: Keys = Field(default_factory=lambda: {"kind": "elsewhere"})
    pairs: dict[Name, PairDevices] = Field(default_factory=dict)
    order: Order = "one-after-another"
    exposure_ms: PositiveFloat | None = None

    def device(self, role: Literal["camera", "projector"], pair: str) -> Keys:
        """The keys of one pair's device; a pair with another kind shares no keys with the rest."""
        shared: Keys = getattr(self, role)
        given: Keys = getattr(self.pairs.get(pair, PairDevices()), role)
        differs = given.get("kind", shared.get("kind")) != shared.get("kind")
        return dict(given) if differs else {**shared, **given}

    def problems(self) -> Iterator[Problem]:
        for role, keys in (("camera", self.camera), ("projector", self.projector)):
            if not isinstance(keys.get("kind"), str):
                yield (role, "kind"), "is missing: which kind of device it is, such as opencv"
