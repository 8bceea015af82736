"""When frames were taken, as captures.yaml and files of times say it."""

from __future__ import annotations

from pathlib import Path

import pytest
from small_captures import FRAMES, RIG, write, write_small_captures

from bodyscan.captures.folder import Captures, open_captures, open_scan
from bodyscan.errors import CaptureError
from bodyscan.rig.rig import load_rig

CODE = [f"bit0{bit}{end}" for end in ("", "-inverse") for bit in range(4)]
DEFAULT = ["lit", "dark", *CODE]
ON_POLES = RIG.replace("- name: p", "- pole: left\n    name: p").replace(
    "- name: cam", "- pole: right\n    name: cam"
)


def taken(folder: Path, timing: str, rig: str = RIG, times: str | None = None) -> Captures:
    """One shot of the small rig with this `timing`, and a file of times if there is one."""
    write_small_captures(folder, shots=1)
    captures = folder / "captures"
    write(captures / "captures.yaml", f"kind: scan\nshots: [{{name: b1}}]\ntiming:\n{timing}")
    if times is not None:
        write(captures / "times.csv", times)
    return open_scan(load_rig(write(folder / "rig.yaml", rig)), captures)


def test_without_timing_nothing_is_known(tmp_path: Path) -> None:
    captures = open_captures(load_rig(write_small_captures(tmp_path)), tmp_path / "rig.yaml")
    assert captures.frame_ms("b1", "p1") is None
    assert captures.described_in == ()


def test_frames_follow_each_other_in_the_order_of_the_patterns(tmp_path: Path) -> None:
    captures = taken(tmp_path, "  frame_ms: 10\n  start: one-after-another\n")
    times = captures.frame_ms("b1", "p1")
    assert times is not None
    assert list(times) == DEFAULT
    assert list(times.values()) == [5.0 + 10.0 * place for place in range(len(FRAMES))]
    assert captures.frame_ms("b2", "p1") is None


def test_an_order_of_its_own(tmp_path: Path) -> None:
    turned = DEFAULT[::-1]
    captures = taken(tmp_path, f"  frame_ms: 10\n  start: together\n  order: {turned}\n")
    times = captures.frame_ms("b1", "p1")
    assert times is not None
    assert list(times) == turned
    assert times["lit"] == 95.0
    assert captures.frame_ms("b1", "cam") == {"lit": 5.0}  # a camera alone takes one frame


@pytest.mark.parametrize(
    ("start", "rig", "expected"),
    [
        ("one-after-another", RIG, {"p1": 5, "p2": 105, "cam": 205}),
        ("together", RIG, {"p1": 5, "p2": 5, "cam": 5}),
        ("poles", ON_POLES, {"p1": 5, "p2": 105, "cam": 5}),
        ("poles", RIG, {"p1": 5, "p2": 5, "cam": 5}),  # each is a pole by itself
        ("{p1: 300, p2: 0, cam: 7.5}", RIG, {"p1": 305, "p2": 5, "cam": 12.5}),
    ],
)
def test_when_pairs_begin(tmp_path: Path, start: str, rig: str, expected: dict[str, float]) -> None:
    captures = taken(tmp_path, f"  frame_ms: 10\n  start: {start}\n", rig)
    found = {one.pair: captures.frame_ms("b1", one.pair) for one in captures.sequences}
    assert {pair: min(times.values()) for pair, times in found.items() if times} == expected


def rows(change: dict[str, str] | None = None) -> str:
    """A file of times of p1, with some lines replaced by the frame that they are of."""
    lines = {name: f"b1,p1,{name},{3 * place}" for place, name in enumerate(DEFAULT)}
    return "\n".join(["shot,pair,frame,ms", *(lines | (change or {})).values()]) + "\n"


def test_a_file_of_times(tmp_path: Path) -> None:
    captures = taken(tmp_path, "  times: times.csv\n", times=rows())
    assert captures.frame_ms("b1", "p1") == {name: 3.0 * k for k, name in enumerate(DEFAULT)}
    assert captures.frame_ms("b1", "p2") is None
    # What a batch keeps of its inputs: other times are another scan.
    assert tmp_path / "captures" / "times.csv" in captures.described_in


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"bit00": "b1,p1,bit00,2"}, "times.csv:4:1: time runs backwards: frame bit00 of pair p1"
         " at 2 ms, after dark at 3 ms"),
        ({"bit00": "b1,p1,bit99,6"}, "4:1: names no frame that pair p1 took in shot b1 (did you"),
        ({"bit00": "b1,p9,bit00,6"}, "4:1: names no pair of these captures"),
        ({"bit00": "b9,p1,bit00,6"}, "4:1: names no shot of these captures"),
        ({"bit00": "b1,cam,bit00,6"}, "4:1: names no frame that pair cam took in shot b1"),
        ({"bit00": "b1,p1,lit,6"}, "4:1: gives frame lit of pair p1 a second time"),
        ({"bit00": "b1,p1,bit00,soon"}, "4:1: ms must be a number, 0 or more (got 'soon')"),
        ({"lit": "b1,p1,lit,-1"}, "2:1: ms must be a number, 0 or more"),
        ({"bit00": "b1,p1,6"}, "4:1: has 3 columns, not 4"),
        ({"bit00": ""}, "has no time of bit00 (pair p1, shot b1)"),
        ({name: f"b1,p1,{name},{3e6 * k}" for k, name in enumerate(DEFAULT)},
         "ms: 3e+06 ms from frame to frame is not between 0.2 and 2000, which cameras and people who"
         " stand can do: are these nanoseconds (3 ms)?"),
    ],
)  # fmt: skip
def test_mistakes_in_a_file_of_times(tmp_path: Path, change: dict[str, str], message: str) -> None:
    with pytest.raises(CaptureError) as caught:
        taken(tmp_path, "  times: times.csv\n", times=rows(change))
    assert message in str(caught.value)


@pytest.mark.parametrize(
    ("timing", "message"),
    [
        ("  frame_ms: 0\n  start: together", "4:13: timing.frame_ms: must be greater than 0 (got 0)"),
        ("  frame_ms: 0.0083\n  start: together", "timing.frame_ms: 0.0083 ms from frame to frame"),
        ("  frame_ms: 0.0083\n  start: together", "are these seconds (8.3 ms)?"),
        ("  frame_ms: 8300000\n  start: together", "are these nanoseconds (8.3 ms)?"),
        ("  frame_ms: 5000\n  start: together", "are these microseconds (5 ms)? If not, leave"),
        ("  frame_ms: 10\n  start: {p1: 0, p2: 1.0e+308, cam: 3}", "timing.start.p2: must be"),
        ("  start: together", "timing.frame_ms: is missing (or `times`"),
        ("  frame_ms: 10", "timing.start: is missing: one-after-another, together, poles, or"),
        ("  frame_ms: 10\n  start: later", "5:10: timing.start: must be 'one-after-another',"
         " 'together' or 'poles' or a mapping (key: value) (got later)"),
        ("  frame_ms: 10\n  start: {p1: 0, p3: 1, cam: 3}", "5:22: timing.start.p3: names no pair"),
        ("  frame_ms: 10\n  start: {p1: 0, cam: 3}", "timing.start: leaves out p2"),
        ("  frame_ms: 10\n  start: together\n  order: [lit, dark]", "timing.order: leaves out bit00"),
        ("  frame_ms: 10\n  start: together\n  order: [lit, light]", "timing.order[1]: names no frame"),
        ("  frame_ms: 10\n  start: together\n  order: [gray0, gray1]", "calibration another rig's?"),
        ("  frame_ms: 10\n  start: together\n  order: [lit, lit]", "timing.order[1]: lists a frame"),
        ("  frame_ms: 10\n  times: times.csv", "timing.frame_ms: is said twice"),
        ("  times: ../times.csv", "timing.times: must not climb out"),
        ("  times: none.csv", "names the file of times none.csv, which does not exist"),
        ("  times: captures.yaml", "captures.yaml:1:1: must begin with the line shot,pair,frame,ms"),
        ("  frame: 10", "timing.frame: is not a key known here (did you mean"),
    ],
)  # fmt: skip
def test_mistakes_in_the_timing(tmp_path: Path, timing: str, message: str) -> None:
    with pytest.raises(CaptureError) as caught:
        taken(tmp_path, timing)
    assert message in str(caught.value)
