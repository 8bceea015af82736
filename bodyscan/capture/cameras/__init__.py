"""Cameras by kind: each is one file in this folder, with its FORMAT, or another package's entry
point in the group `bodyscan.capture.cameras`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field
from pathlib import Path
from time import monotonic_ns
from typing import Any

from bodyscan.arrays import Bytes
from bodyscan.errors import FailedWork
from bodyscan.files.model import Model
from bodyscan.files.registry import Registry
from bodyscan.rig.pair import Pair
from bodyscan.rig.rig import Rig

HOST = "host"
"""The name of the clock that this computer's own `now_ms` reads."""


class FrameLost(FailedWork):
    """A camera did not deliver a frame, or delivered a damaged one."""


@dataclass(frozen=True, eq=False)
class Picture:
    """One image as a camera delivered it."""

    image: Bytes  # (height, width) uint8 or uint16
    began_ms: float  # when its exposure began, by `clock`
    received_ms: float  # when it arrived, by this computer's monotonic clock
    exposure_ms: float = 0.0  # how long it was exposed; 0 if that is not known
    clock: str = HOST  # its name; pictures of one clock can be compared


@dataclass(frozen=True, eq=False)
class Place:
    """Where a device is: its rig and pair, and the folder to which its paths are relative."""

    rig: Rig
    pair: Pair
    base: Path
    # What devices of a rig make once and use together, by name.
    shared: dict[str, Any] = field(default_factory=dict)
    closing: ExitStack = field(default_factory=ExitStack)  # what is to be closed after all devices


class Camera(ABC):
    """An open camera.

    exposure_ms: as it is set; None if this camera's cannot be.
    has_clock: whether it is known when its pictures were taken.
    is_simulated: whether its images are rendered.
    """

    exposure_ms: float | None = None
    has_clock: bool = True
    is_simulated: bool = False

    def expose(self, exposure_ms: float) -> None:
        """Set the exposure; gain and white balance stay as they were when it was opened."""
        self.exposure_ms = exposure_ms

    def begin(self, shot: str, frames: Sequence[str]) -> None:  # noqa: B027  # most need nothing
        """Prepare for these frames of a shot, in that order; whatever was not taken is dropped."""

    @abstractmethod
    def trigger(self, frame: str) -> None:
        """Take the frame that is shown now. A camera that the projector triggers does nothing."""

    @abstractmethod
    def take(self, timeout_s: float) -> Picture:
        """Hand over the frame that was triggered. Raises FrameLost if it is missing or damaged."""

    def close(self) -> None:  # noqa: B027
        """Release the device."""


class CameraKind(Model):
    """What a rig file says of a camera: its keys below `capture.camera`. Subclasses name theirs."""

    kind: str

    @abstractmethod
    def open(self, place: Place) -> Camera:
        """Open the camera of a pair. Raises BadInput if it is not there, or its library is not."""


def fix_nodes(nodes: Any, value: str, line: str | None, **fixed: object) -> None:
    """Put a GenICam camera into trigger mode and switch off what it would change by itself.

    value: what a node's value is called. line: the input of triggers; None: by software.
    fixed: more nodes and their values, such as Gain, which can be set once GainAuto is off. What a
        model does not have is passed over.
    """
    automatics = dict.fromkeys(("ExposureAuto", "GainAuto", "BalanceWhiteAuto"), "Off")
    trigger = {"TriggerSelector": "FrameStart", "TriggerMode": "On"}
    for name, wanted in {
        **automatics,
        **fixed,
        **trigger,
        "TriggerSource": line or "Software",
    }.items():
        with suppress(Exception):
            setattr(getattr(nodes, name), value, wanted)


def now_ms() -> float:
    """The host's monotonic clock."""
    return monotonic_ns() / 1e6


CAMERAS: Registry[type[CameraKind]] = Registry(__name__, "a camera", "cannot be of kind")
