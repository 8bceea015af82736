"""Sequences that cannot be decoded, each cause said once; range images, and when they were taken."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from stripe_rendering import code_light, render

from bodyscan.arrays import Array
from bodyscan.boards.view import BoardView
from bodyscan.calibration.boundary_points import compute_box, crop_around, select_boundaries_near
from bodyscan.captures.folder import ImageSequence, open_scan
from bodyscan.errors import BadInput, BodyscanError, CaptureError, DecodingFailed, ImageError
from bodyscan.geometry.camera import Camera
from bodyscan.geometry.lenses.opencv import Radial
from bodyscan.reconstruction.range_image import RangeImage
from bodyscan.rig.frame_names import FrameNames
from bodyscan.rig.rig import Rig, load_rig
from bodyscan.stripes.codes.gray import Gray
from bodyscan.workflows import decode, range_images
from bodyscan.workflows.decode import decode_sequence, describe_failures, list_fault_notes
from bodyscan.workflows.range_images import reconstruct_range_images, reconstruct_sequence
from bodyscan.workflows.scan_person import require_single_shot

TWO_WAYS = """
version: 1
name: two-ways
pairs:
  - name: p1
    camera: {width: 200, height: 160}
    projector: {code: gray, stripes: 64, direction: vertical, crossing: {stripes: 32}}
rig_frame: {pair: p1}
files: "{frame}.png"
frames: {crossing: {pattern: "row{bit}", inverse: "row{bit}-inverse"}}
"""


def failures(pair: str, what: str, *shots: str) -> dict[ImageSequence, BodyscanError]:
    return {
        ImageSequence(pair, shot, Path("lit.png"), None, (), ()): DecodingFailed(
            what, where=f"pair {pair}, shot {shot}", remedy="do something"
        )
        for shot in shots
    }


def test_a_pair_whose_stripes_all_run_the_other_way_fails_for_that_reason() -> None:
    same = failures("p1", "the stripes run vertically", "a", "b", "c")
    mixed = failures("p2", "one (bit 1)", "a") | failures("p2", "one (bit 2, twice)", "b")
    mixed |= failures("p2", "other", "c")
    found, notes = describe_failures(same | mixed, {"p3"})
    assert found["p1"] == "the stripes run vertically\n  do something"
    several = "no stripe sequence can be decoded: one (bit 1); or: other\n  do something"
    assert found["p2"] == several, "what to do stands once"
    assert (notes, describe_failures(same, {"p1"})[0]) == ([], {})


def test_a_fault_is_one_whatever_its_share_of_the_pixels() -> None:
    both = failures("p1", "27% of the codes lie beyond", "a")
    both |= failures("p1", "31% of the codes lie beyond", "b")
    assert describe_failures(both, ())[0] == {"p1": "27% of the codes lie beyond\n  do something"}


def test_many_shots_with_one_fault_share_a_note() -> None:
    notes = describe_failures(failures("p1", "too dark", "a", "b", "c", "d"), {"p1"})[1]
    assert notes == ["p1: too dark\n  do something\n  in 4 shots: a, b, c, d"]


def test_a_crop_shows_the_same_boundaries_as_the_whole(tmp_path: Path) -> None:
    rig, sequence, _ = a_scan_one_way(tmp_path)
    corners = np.array([[60.0, 40.0], [140.0, 40.0], [60.0, 90.0], [140.0, 90.0]])
    view = BoardView("p1", "s1", "board", np.arange(4), corners)
    box = compute_box(view)
    crop = crop_around([box])
    assert crop == (slice(15, 116), slice(20, 181))  # half a corner box more on each side
    whole = select_boundaries_near(decode_sequence(sequence, rig.pairs[0]), box)
    cut = select_boundaries_near(decode_sequence(sequence, rig.pairs[0], crop=crop), box, crop)
    inside = np.all((whole.pixels > [22, 17]) & (whole.pixels < [178, 113]), axis=1)
    assert inside.sum() > 1500
    found = {(i, round(v)): u for i, (u, v) in zip(cut.index, cut.pixels, strict=True)}
    off = [
        found[i, round(v)] - u
        for i, (u, v) in zip(whole.index[inside], whole.pixels[inside], strict=True)
    ]
    # The blur, of which edges of brightness are freed, is measured on other pixels.
    assert np.abs(off).max() < 0.01


def a_scan_one_way(tmp_path: Path) -> tuple[Rig, ImageSequence, Array]:
    """A rig whose code counts both ways, a scan with the images of one, and its true s."""
    (tmp_path / "rig.yaml").write_text(TWO_WAYS, "utf-8")
    rig, scan = load_rig(tmp_path / "rig.yaml"), tmp_path / "scan"
    scan.mkdir()

    def s_at(u: np.ndarray, v: np.ndarray) -> np.ndarray:
        return 2.0 + 0.3 * u

    lit, dark, coded, s = render(s_at, code_light("gray", 64), stripes=64, shape=(160, 200))
    projector = rig.pairs[0].projector
    assert projector is not None
    names = ["lit", "dark", *rig.frames.code_names(projector)]  # those of rows follow
    for name, image in zip(names, [lit, dark, *coded], strict=False):
        cv2.imwrite(str(scan / f"{name}.png"), image)
    (sequence,) = open_scan(rig, scan).sequences
    return rig, sequence, s


def test_a_shot_without_its_crossing_images_keeps_the_others(tmp_path: Path) -> None:
    rig, sequence, s = a_scan_one_way(tmp_path)
    found = decode_sequence(sequence, rig.pairs[0])
    assert found.crossing is None
    known = np.isfinite(found.s)
    assert known.mean() > 0.9
    assert np.median(np.abs(found.s - s)[known]) < 0.1  # stripes; they are 3 pixels wide
    (note,) = list_fault_notes({sequence: found.faults})
    assert "row0.png" in note
    scan, projector = tmp_path / "scan", rig.pairs[0].projector
    assert projector is not None
    files = [scan / f"{name}.png" for name in rig.frames.code_names(projector)]
    for file in files:
        if not file.exists():
            file.write_bytes(b"not an image")
    (sequence,) = open_scan(rig, scan).sequences
    damaged = decode_sequence(sequence, rig.pairs[0])
    np.testing.assert_array_equal(damaged.s, found.s)
    assert "row0.png" in damaged.crossing_fault
    files[0].unlink()
    (sequence,) = open_scan(rig, scan).sequences
    with pytest.raises(ImageError):
        decode_sequence(sequence, rig.pairs[0])


def test_a_sequence_that_fails_is_a_note_and_notes_are_in_the_order_of_shots(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    pairs: Any = {name: SimpleNamespace(name=name, camera=None) for name in ("p1", "p2")}
    sequences = [
        ImageSequence(pair, shot, Path("lit.png"), None, (Path("a.png"),), ())
        for shot in "ab"
        for pair in ("p2", "p1")
    ]
    rig: Any = SimpleNamespace(pair=pairs.__getitem__, pairs=[])
    captures: Any = SimpleNamespace(
        sequences=sequences, pair_sequences=lambda pair: [s for s in sequences if s.pair == pair]
    )

    def decoded(sequence: ImageSequence, *_: object, **__: object) -> Any:
        if sequence.pair == "p2" and sequence.shot == "a":
            raise DecodingFailed("is bad", where="pair p2, shot a")
        return SimpleNamespace(faults=("an image is missing",), crossing=None)

    monkeypatch.setattr(decode, "decode_sequence", decoded)
    monkeypatch.setattr(decode, "select_boundaries_near", lambda *_: "boundaries")
    views = [BoardView(s.pair, s.shot, "board", np.arange(4), np.zeros((4, 2))) for s in sequences]
    every = decode.decode_on_boards(rig, captures, views)
    assert list(every.value) == [("p1", "a", "board"), ("p2", "b", "board"), ("p1", "b", "board")]
    assert every.notes[0].startswith("pair p2, shot a: is bad")
    assert "shots a, b: an image is missing" in every.notes[1]
    assert every.failures == {}


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
    monkeypatch.setattr(range_images, "find_stripes_in_volume", lambda *_: None)
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

    require_single_shot(captured(("a", "s1"), ("b", "s2")))  # poles one after another
    with pytest.raises(CaptureError, match=r"scans/anna: pair a .* 2 shots \(s1, s2\)") as caught:
        require_single_shot(captured(("a", "s1"), ("b", "s1"), ("a", "s2")))
    assert "name: s1" in caught.value.remedy


def test_a_pair_that_measured_nothing_in_the_volume_is_named() -> None:
    points = np.full((4, 5, 3), np.nan, np.float32)
    one = ImageSequence("p", "s", None, None, (Path(),), ())
    image = replace(range_image(), points=points)
    rig = SimpleNamespace(pairs=[SimpleNamespace(name=name, projector=True) for name in "pq"])
    calibration: Any = SimpleNamespace(rig=rig, pairs={"p": None}, failed={"q": "saw none\n  it"})
    captures: Any = SimpleNamespace(sequences=[one], pair_sequences=lambda _: [one], relative=str)
    found = reconstruct_range_images(calibration, captures, made={one: (image, ())})
    assert "p: nothing that it measured lies inside" in found.notes[0]
    assert found.failures == {"q": "is not calibrated: saw none"}
