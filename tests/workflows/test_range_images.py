"""The time of a range image, and rigs that give none."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from bodyscan.captures.folder import ImageSequence
from bodyscan.errors import BadInput, CaptureError
from bodyscan.geometry.camera import Camera
from bodyscan.geometry.lenses.opencv import Radial
from bodyscan.reconstruction.range_image import RangeImage
from bodyscan.rig.frame_names import FrameNames
from bodyscan.stripes.codes.gray import Gray
from bodyscan.workflows import range_images
from bodyscan.workflows.range_images import reconstruct_range_images, reconstruct_sequence
from bodyscan.workflows.scan_person import require_one_moment

STRIPES = SimpleNamespace(crossing=None, faults=())


def range_image() -> RangeImage:
    points, grey = np.ones((4, 5, 3), np.float32), np.zeros((4, 5), np.uint8)
    camera = Camera(400.0, 400.0, 0.0, 2.0, 1.5, Radial(), 5, 4)
    return RangeImage("p", camera, points, points, points[..., 0], grey)


def test_a_range_image_holds_at_the_time_of_the_finest_pattern(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    code = Gray(stripes=4, direction="vertical")
    frames = FrameNames()
    # Two bits: pattern and inverse of the finer one are taken at 20 and 50 ms.
    frame_ms = dict(zip(frames.code_names(code), (10.0, 20.0, 30.0, 50.0), strict=True))
    found = range_image()
    monkeypatch.setattr(range_images, "decode_sequence", lambda *_, **__: STRIPES)
    monkeypatch.setattr(range_images, "reconstruct_range_image", lambda *_: found)
    monkeypatch.setattr(range_images, "stripes_in_volume", lambda *_: None)
    monkeypatch.setattr(range_images, "read_colours", lambda *_: found.points.astype(np.uint8))
    rig = SimpleNamespace(
        volume=None, pair=lambda _: SimpleNamespace(projector=code, camera=None), frames=frames
    )
    calibration: Any = SimpleNamespace(pairs={"p": None}, rig_from_camera={"p": None}, rig=rig)
    for times, expected in ((frame_ms, 35.0), (None, None)):
        captures: Any = SimpleNamespace(frame_ms=lambda *_, times=times: times)
        sequence: Any = SimpleNamespace(pair="p", shot="s")
        image, _ = reconstruct_sequence(calibration, captures, sequence)
        assert image.time_ms == expected
        assert image.rgb is not None


def test_cameras_alone_are_told_what_they_lack() -> None:
    rig = SimpleNamespace(name="stereo", pairs=[SimpleNamespace(name="a", projector=None)])
    calibration: Any = SimpleNamespace(rig=rig, pairs={"a": None}, failed={})
    captures: Any = SimpleNamespace(sequences=[])
    with pytest.raises(BadInput, match="rig stereo: no pair has a projector") as caught:
        reconstruct_range_images(calibration, captures)
    assert "export-rig" in caught.value.remedy


def test_two_shots_of_a_pair_are_no_one_person() -> None:
    def captured(*taken: tuple[str, str]) -> Any:
        sequences = [SimpleNamespace(pair=p, shot=s, has_stripes=True) for p, s in taken]
        return SimpleNamespace(sequences=sequences, folders=["scans/anna"])

    require_one_moment(captured(("a", "s1"), ("b", "s2")))  # poles one after another
    with pytest.raises(CaptureError, match=r"scans/anna: pair a .* 2 shots \(s1, s2\)") as caught:
        require_one_moment(captured(("a", "s1"), ("b", "s1"), ("a", "s2")))
    assert "name: s1" in caught.value.remedy


def test_a_pair_that_measured_nothing_in_the_volume_is_named() -> None:
    points = np.full((4, 5, 3), np.nan, np.float32)
    taken = ImageSequence("p", "s", None, None, (Path(),), ())
    image = replace(range_image(), points=points)
    rig = SimpleNamespace(pairs=[SimpleNamespace(name="p", projector=True)])
    calibration: Any = SimpleNamespace(rig=rig, pairs={"p": None}, failed={})
    every = [taken]
    captures: Any = SimpleNamespace(sequences=every, pair_sequences=lambda _: every, relative=str)
    found = reconstruct_range_images(calibration, captures, made={taken: (image, ())})
    assert "p: nothing that it measured lies inside" in found.notes[0]
