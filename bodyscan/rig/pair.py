"""A pair: its camera, its projector, and where both are meant to stand."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, Literal

from pydantic import Field

from bodyscan.files.model import Model, Name, Problem
from bodyscan.rig.known import Known
from bodyscan.rig.rig_frame import Vector
from bodyscan.stripes.codes import AnyStripeCode

Pixels = Annotated[int, Field(gt=0, le=32767)]


AUTO = "auto"
"""Lets held-out boards choose the lens."""


class CameraSpec(Model):
    """A camera's image size in pixels, its kind of lens, and what its files hold.

    lens: a kind of lens; auto: held-out boards choose.
    bits: per grey level, where 16-bit files hold fewer and their numbers do not show it.
    channel: which channel of a colour image is used; grey: all of them, as luma.
    """

    width: Pixels
    height: Pixels
    bits: Annotated[int, Field(ge=8, le=16)] | None = None
    channel: Literal["grey", "red", "green", "blue"] = "grey"
    lens: str = AUTO

    def problems(self) -> Iterator[Problem]:
        if self.lens == AUTO:
            return
        from bodyscan.geometry.lenses import LENSES  # imported here: heavier than a rig file needs

        if self.lens not in LENSES:
            yield ("lens",), f"must be one of {', '.join((AUTO, *LENSES))} (got {self.lens!r})"


class NominalPose(Model):
    """Where something is meant to stand, rig frame: at `position_mm`, looking at `look_at_mm`."""

    position_mm: Vector
    look_at_mm: Vector

    def problems(self) -> Iterator[Problem]:
        if self.position_mm == self.look_at_mm:
            yield ("look_at_mm",), "must differ from position_mm, or it looks nowhere"


class Pair(Model):
    """One camera and one projector, or a camera alone.

    known: what another program has calibrated of it.
    """

    name: Name
    pole: Name | None = None
    camera: CameraSpec
    projector: AnyStripeCode | None = None
    nominal: NominalPose | None = None
    projector_nominal: NominalPose | None = None
    known: Known | None = None

    def problems(self) -> Iterator[Problem]:
        if self.projector_nominal and not self.projector:
            yield ("projector_nominal",), "needs a projector: this pair is a camera alone"
        if self.known and self.known.projector and not self.projector:
            yield ("known", "projector"), "needs a projector: this pair is a camera alone"
