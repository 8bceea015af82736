"""Which stripe map of a sequence is believed: with what seems to move taken out, or as it is."""

from __future__ import annotations

from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import pytest

from bodyscan.errors import BadInput
from bodyscan.reconstruction.two_ways import Agreement
from bodyscan.stripes.one_moment import Moments
from bodyscan.workflows import range_images
from bodyscan.workflows.range_images import reconstruct_range_images, reconstruct_sequence


@dataclass
class Seen:
    """Of a stripe map and of a range image: what the choice looks at."""

    motion: Any = None
    agreement: Agreement | None = None
    crossing: None = None
    response: None = None
    crossing_fault: str = ""


def agreement(apart_mm: float) -> Agreement:
    return Agreement(1000, apart_mm, 3.0, 0)


@pytest.mark.parametrize(("moved_mm", "believed"), [(0.4, True), (1.6, False)])
def test_motion_that_makes_both_directions_disagree_is_none(
    monkeypatch: pytest.MonkeyPatch, moved_mm: float, believed: bool
) -> None:
    """0.9 mm as it is. In `gray-jpeg` a statue stands; faults of its patterns look like motion."""
    motion: Any = SimpleNamespace(is_significant=True, velocity=None)

    def decode(*_: Any, moments: tuple[Moments, ...] = (), **__: Any) -> Seen:
        return Seen(motion) if moments else Seen()

    def reconstruct(pair: Any, stripes: Seen) -> Seen:
        return Seen(agreement=agreement(moved_mm if stripes.motion else 0.9))

    monkeypatch.setattr(range_images, "decode_sequence", decode)
    monkeypatch.setattr(range_images, "reconstruct_range_image", reconstruct)
    monkeypatch.setattr(range_images, "stripes_in_volume", lambda *_: None)
    monkeypatch.setattr(range_images, "sequence_moments", lambda *_: ("moments",))
    spec = SimpleNamespace(projector=SimpleNamespace())
    rig = SimpleNamespace(volume=None, pair=lambda _: spec, frames=None)
    calibration: Any = SimpleNamespace(pairs={"p": None}, rig_from_camera={"p": None}, rig=rig)
    captures: Any = SimpleNamespace(frame_ms=lambda *_: None)
    image, _, told, _ = reconstruct_sequence(
        calibration,
        captures,
        SimpleNamespace(pair="p", shot="s"),  # type: ignore[arg-type]
    )
    assert (told is motion) == believed
    assert image.agreement is not None
    assert image.agreement.apart_mm == (moved_mm if believed else 0.9)


def test_cameras_alone_are_told_what_they_lack() -> None:
    rig = SimpleNamespace(name="stereo", pairs=[SimpleNamespace(name="a", projector=None)])
    calibration: Any = SimpleNamespace(rig=rig, pairs={"a": None}, failed={})
    captures: Any = SimpleNamespace(sequences=[])
    with pytest.raises(BadInput, match="rig stereo: no pair has a projector") as caught:
        reconstruct_range_images(calibration, captures)
    assert "export-rig" in caught.value.remedy
