"""Sequences projected and photographed: by cameras made here, by Basler's emulator, from files."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
import pytest
import yaml
from required import missing

from bodyscan.capture.cameras import CAMERAS, Camera, CameraKind, FrameLost, Picture, Place, now_ms
from bodyscan.capture.devices import load_capture_rig, open_devices
from bodyscan.capture.exposure import find_exposures, measure_delays
from bodyscan.capture.projectors import PROJECTORS, Projector, ProjectorKind
from bodyscan.capture.session import (
    Shot,
    capture_shot,
    list_frames,
    plan_turns,
    refuse_existing_shot,
)
from bodyscan.captures.folder import open_scan
from bodyscan.errors import BadInput, CaptureError, FailedWork, RigFileError
from bodyscan.rig.devices import Order
from bodyscan.rig.rig import Rig

PAIRS = ("p1-1", "p1-2", "p2-1")


class MadeKind(CameraKind):
    """A camera whose clock is ahead by `ahead_ms`, and that loses the n-th pictures it takes."""

    kind: Literal["made"] = "made"
    ahead_ms: float = 0.0
    loses: tuple[int, ...] = ()

    def open(self, place: Place) -> Camera:
        return MadeCamera(self, place)


class MadeCamera(Camera):
    """Sees its projector's light, `gain` levels a ms of exposure, behind a shirt and hair."""

    exposure_ms = 10.0

    def __init__(self, kind: MadeKind, place: Place) -> None:
        self.kind, self.light, self.name, self.count = kind, place.shared, place.pair.name, 0
        self.scene = np.full((40, 50), 1.0)

    def trigger(self, frame: str) -> None:
        self.count += 1
        self.at_ms = now_ms()

    def take(self, timeout_s: float) -> Picture:
        if self.count in self.kind.loses:
            raise FrameLost("was lost")
        shown, since_ms, delay_ms = self.light.get(self.name, (0, 0.0, 0.0))
        on = shown if self.at_ms - since_ms >= delay_ms else 0
        levels = np.clip(2.0 + on * self.scene * (self.exposure_ms or 0.0), 0, 255)
        began_ms, clock = self.at_ms + self.kind.ahead_ms, self.name
        return Picture(
            levels.astype(np.uint8), began_ms, self.at_ms, self.exposure_ms or 0.0, clock
        )


class MadeProjectorKind(ProjectorKind):
    kind: Literal["made"] = "made"
    late_ms: float = 0.0
    ordered: bool = False

    def open(self, place: Place) -> Projector:
        return MadeProjector(self, place)


class MadeProjector(Projector):
    def __init__(self, kind: MadeProjectorKind, place: Place) -> None:
        self.kind, self.place = kind, place
        self.any_order, self.delay_ms = not kind.ordered, None

    def load(self, patterns: Mapping[str, Any]) -> None:
        self.patterns = patterns

    def show(self, frame: str) -> None:
        level = int(self.patterns[frame].max() > 0)
        self.place.shared[self.place.pair.name] = (level, now_ms(), self.kind.late_ms)


@pytest.fixture(autouse=True)
def kinds() -> Iterator[None]:
    CAMERAS.registered["made"], PROJECTORS.registered["made"] = MadeKind, MadeProjectorKind
    yield
    del CAMERAS.registered["made"], PROJECTORS.registered["made"]


def write_rig_file(
    folder: Path, capture: dict[str, Any], pairs: Sequence[str] = PAIRS, stripes: int = 32
) -> Path:
    projector: dict[str, Any] = {"stripes": stripes, "direction": "vertical"}
    pair = {"camera": {"width": 50, "height": 40}, "projector": projector}
    named = [{"name": name, "pole": name[:2], **pair} for name in pairs]
    path = folder / "rig.yaml"
    path.write_text(yaml.safe_dump({"version": 1, "name": "r", "pairs": named, "capture": capture}))
    return path


def made(folder: Path, camera: dict[str, Any] | None = None, **more: Any) -> Rig:
    projector = {"kind": "made", "width": 64, "height": 8, **more.pop("projector", {})}
    keys = {"camera": {"kind": "made", **(camera or {})}, "projector": projector, **more}
    return load_capture_rig(write_rig_file(folder, keys))


def test_every_frame_is_taken_once_in_the_order_that_was_asked_for(tmp_path: Path) -> None:
    rig = made(tmp_path)
    every = sorted((pair.name, frame) for pair in rig.pairs for frame in list_frames(rig, pair))
    first: dict[Order, list[set[str]]] = {
        "one-after-another": [{"p1-1"}, {"p1-1"}],
        "poles": [{"p1-1", "p2-1"}, {"p1-1", "p2-1"}],
        "interleaved": [{"p1-1"}, {"p1-2"}, {"p2-1"}, {"p1-1"}],
    }
    for order, begins in first.items():
        steps = [step for turn in plan_turns(rig, order) for step in turn]
        assert [{pair for pair, _ in step} for step in steps[: len(begins)]] == begins
        assert sorted(one for step in steps for one in step) == every


@pytest.mark.parametrize("ordered", [False, True])
def test_clocks_agree_and_what_is_lost_is_taken_again(tmp_path: Path, ordered: bool) -> None:
    """Clocks are minutes apart; a lost frame costs a frame, or the turn where order is fixed."""
    own = {
        "p1-2": {"camera": {"ahead_ms": 2e5, "loses": [4]}},
        "p2-1": {"camera": {"ahead_ms": -9e4}},
    }
    rig = made(
        tmp_path, pairs=own, projector={"ordered": ordered, "delay_ms": 1.0}, exposure_ms=2.0
    )
    count = len(list_frames(rig, rig.pairs[0]))
    with open_devices(rig, tmp_path) as devices:
        found = capture_shot(devices, Shot(tmp_path / "anna", subject="anna"))
    assert (found.lost, found.retaken) == ({}, count if ordered else 1)
    captures = open_scan(rig, tmp_path / "anna")
    assert not any(sequence.missing for sequence in captures.sequences)
    begun = []
    for pair in PAIRS:
        times = captures.frame_ms("s01", pair)
        assert times is not None
        assert (np.diff(list(times.values())) > 0).all()
        begun.append(min(times.values()))
    assert 0.9 < begun[0] < begun[1] < begun[2] < 60_000
    with pytest.raises(CaptureError, match="holds shot s01"):
        refuse_existing_shot(rig, Shot(tmp_path / "anna"))
    with pytest.raises(BadInput, match="subject"):
        refuse_existing_shot(rig, Shot(tmp_path / "x", subject="../<b>"))


def test_a_pair_that_stays_silent_costs_itself_alone(tmp_path: Path) -> None:
    own = {"p1-2": {"camera": {"loses": list(range(99))}}}
    rig = made(tmp_path, pairs=own, projector={"delay_ms": 1.0}, exposure_ms=2.0)
    with open_devices(rig, tmp_path) as devices:
        found = capture_shot(devices, Shot(tmp_path / "anna"))
    assert found.lost.keys() == {"p1-2"}
    assert (tmp_path / "anna" / "done").exists()
    missing = {s.pair for s in open_scan(rig, tmp_path / "anna").sequences if s.missing}
    assert missing == {"p1-2"}


def test_exposure_and_delay_are_found_before_the_first_capture(tmp_path: Path) -> None:
    rig = made(tmp_path, projector={"late_ms": 120.0})

    with open_devices(rig, tmp_path) as devices:
        assert all(119.0 < delay < 500.0 for delay in measure_delays(devices).values())
        cameras: Any = devices.cameras
        cameras["p1-1"].scene[:, :10], cameras["p2-1"].scene[:, 35:] = 2.0, 0.02
        said = {pair: found.describe(pair) for pair, found in find_exposures(devices)}
        set_to = {name: devices.cameras[name].exposure_ms for name in PAIRS}
        brightest = {"p1-1": 2.0, "p1-2": 1.0, "p2-1": 1.0}  # levels a ms
        assert all(160 < brightest[name] * (ms or 0.0) < 253 for name, ms in set_to.items())
        assert "a white shirt?" in said["p1-1"]
        assert "dark hair" in said["p2-1"]
        assert "too dark" not in said["p1-2"]
        cameras["p1-2"].scene[:] = 0.0
        with pytest.raises(FailedWork, match="pair p1-2 does not see its projector's light"):
            list(find_exposures(devices))


def test_twelve_emulated_cameras_deliver_22_frames_each_in_order(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PYLON_CAMEMU", "12")
    if find_spec("pypylon") is None:
        missing("pypylon is not installed (pip install '.[capture-pylon]')")
    pairs = [f"p{pole}-{k}" for pole in (1, 2, 3) for k in range(4)]
    own = {p: {"camera": {"images": p, "serial": f"0815-{k:04d}"}} for k, p in enumerate(pairs)}
    plan = {"camera": {"kind": "pylon"}, "pairs": own, "order": "poles", "exposure_ms": 1.0}
    rig = load_capture_rig(write_rig_file(tmp_path, plan, pairs, stripes=1024))
    frames = list_frames(rig, rig.pairs[0])
    assert len(frames) == 22
    for number, name in enumerate(pairs):
        (tmp_path / name).mkdir()
        for k in range(22):
            picture = np.full((40, 50), 20 * number + k, np.uint8)
            cv2.imwrite(str(tmp_path / name / f"{k:02d}.png"), picture)
    with open_devices(rig, tmp_path) as devices:
        assert capture_shot(devices, Shot(tmp_path / "in" / "anna")).retaken == 0
        captures = open_scan(rig, tmp_path / "in" / "anna")
        for number, name in enumerate(pairs):
            seen = [
                cv2.imread(str(tmp_path / "in/anna/s01" / name / f"{f}.png"), 0) for f in frames
            ]
            assert [int(one.mean()) for one in seen] == [20 * number + k for k in range(22)]
            times = captures.frame_ms("s01", name) or {}
            assert list(times) == list(frames)
            assert (np.diff(list(times.values())) > 0).all()
        broken: Any = devices.cameras["p2-1"]
        began = broken.begin

        def begin(*given: Any) -> None:
            began(*given)
            broken._handle.ForceFailedBufferCount.Value = 1
            broken._handle.ForceFailedBuffer.Execute()

        broken.begin = begin
        found = capture_shot(devices, Shot(tmp_path / "in" / "bea"))
    assert (found.retaken, found.lost) == (1, {})


def test_no_folder_waits_for_images_that_a_camera_still_owes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: Any) -> None:
        raise FailedWork("the cable is out")

    monkeypatch.setattr(MadeCamera, "trigger", fail)
    rig = made(tmp_path, exposure_ms=2.0, projector={"delay_ms": 1.0})
    with open_devices(rig, tmp_path) as devices, pytest.raises(FailedWork, match="cable"):
        capture_shot(devices, Shot(tmp_path / "anna"))
    assert not (tmp_path / "anna").exists()


def test_a_video_and_a_folder_are_cameras_too(tmp_path: Path) -> None:
    video = cv2.VideoWriter(str(tmp_path / "a.avi"), cv2.VideoWriter.fourcc(*"MJPG"), 30, (50, 40))
    for level in range(0, 240, 10):
        video.write(np.full((40, 50, 3), level, np.uint8))
    video.release()
    own = {"p1-2": {"camera": {"kind": "folder", "folder": "elsewhere"}}}
    plan = {"camera": {"kind": "opencv", "source": "a.avi"}, "pairs": own}
    rig = load_capture_rig(write_rig_file(tmp_path, plan, PAIRS[:2]))
    frames = list_frames(rig, rig.pairs[0])
    (tmp_path / "elsewhere" / "s01" / "p1-2").mkdir(parents=True)
    for k, frame in enumerate(frames):
        cv2.imwrite(
            str(tmp_path / f"elsewhere/s01/p1-2/{frame}.png"), np.full((40, 50), k, np.uint8)
        )
    with open_devices(rig, tmp_path) as devices:
        capture_shot(devices, Shot(tmp_path / "anna"))
    for pair, levels in (("p1-1", range(0, 240, 10)), ("p1-2", range(99))):
        for level, frame in zip(levels, frames, strict=False):
            image = cv2.imread(str(tmp_path / f"anna/s01/{pair}/{frame}.png"), cv2.IMREAD_GRAYSCALE)
            assert abs(float(image.mean()) - level) <= 1.0
    assert open_scan(rig, tmp_path / "anna").times == {}, "files do not tell when light was taken"


@pytest.mark.parametrize(
    ("capture", "wanted"),
    [
        ({"camera": {"kind": "opncv"}}, "capture.camera.kind: must be .* (did you mean 'opencv'?)"),
        ({"camera": {"kind": "made", "gian": 3}}, "capture.camera.gian"),
        ({"camera": {"kind": "made"}, "pairs": {"p9": {}}}, "names no pair"),
        ({"camera": {}}, "capture.camera.kind: is missing"),
        ({"camera": {"kind": "pylon"}, "order": "at once"}, "capture.order"),
    ],
)
def test_mistakes_in_the_rig_file_are_reported_by_line(
    tmp_path: Path, capture: dict[str, Any], wanted: str
) -> None:
    with pytest.raises(RigFileError, match=r"rig\.yaml:\d+:\d+") as refused:
        load_capture_rig(write_rig_file(tmp_path, capture))
    first, _, last = wanted.partition(".*")
    assert first in str(refused.value)
    assert last.strip() in str(refused.value)


def test_another_package_adds_a_camera(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    info = tmp_path / "more-1.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: more\nVersion: 1\n")
    entry = "[bodyscan.capture.cameras]\nmore = more:MoreKind\n"
    (info / "entry_points.txt").write_text(entry)
    (tmp_path / "more.py").write_text("MoreKind = 'found'\n")
    monkeypatch.syspath_prepend(tmp_path)
    assert "more" in CAMERAS.names()
    assert CAMERAS.find("more") == "found"  # type: ignore[comparison-overlap]
