"""Capture folders: what lies where, what is missing, and nothing outside the folder."""

from __future__ import annotations

import json
import shutil
from datetime import datetime
from pathlib import Path

import pytest
import yaml
from small_captures import FRAMES, RIG, picture, write, write_small_captures

from bodyscan.captures.captures_file import (
    CapturesFile,
    ShotEntry,
    load_captures_file,
    write_captures_file,
)
from bodyscan.captures.check import check
from bodyscan.captures.folder import Captures, open_captures, open_scan
from bodyscan.errors import CaptureError
from bodyscan.rig.rig import load_rig


def opened(rig_path: Path) -> Captures:
    return open_captures(load_rig(rig_path), rig_path)


def with_rig(folder: Path, text: str) -> Path:
    return write(folder / "rig.yaml", text)


ONE_PAIR = """\
name: one
boards: [{name: board, columns: 5, rows: 4, square_mm: 30}]
pairs:
  - name: only
    camera: {width: 40, height: 30}
    projector: {stripes: 12, direction: horizontal}
calibration: [{folder: captures}]
"""


def test_files_tell_what_each_pair_took(tmp_path: Path) -> None:
    rig_path = write_small_captures(tmp_path)
    captures = opened(rig_path)
    assert captures.folders == (tmp_path / "captures",)
    assert captures.shots == ("b1", "b2", "b3")
    assert [(s.shot, s.pair) for s in captures.sequences[:4]] == [
        ("b1", "p1"),
        ("b1", "p2"),
        ("b1", "cam"),
        ("b2", "p1"),
    ]
    sequence = captures.pair_sequences("p2")[2]
    folder = tmp_path / "captures" / "b3" / "p2"
    assert sequence.has_stripes
    assert sequence.lit == folder / "lit.png"
    assert sequence.dark == folder / "dark.png"
    names = [f"bit0{bit}{kind}.png" for kind in ("", "-inverse") for bit in range(4)]
    assert sequence.coded == tuple(folder / name for name in names)
    assert sequence.missing == ()
    assert len(set(sequence.paths)) == len(FRAMES)
    camera = captures.pair_sequences("cam")[0]
    assert not camera.has_stripes
    assert camera.paths == (tmp_path / "captures" / "b1" / "cam" / "lit.png",)
    assert [s.shot for s in captures.pair_sequences("cam")] == ["b1", "b2", "b3"]
    assert [s.pair for s in captures.shot_sequences("b2")] == ["p1", "p2", "cam"]
    assert not any(s.missing for s in captures.sequences)


def test_captures_yaml_says_who_took_what(tmp_path: Path) -> None:
    rig_path = write_small_captures(tmp_path)
    write_captures_file(
        tmp_path / "captures",
        CapturesFile(
            kind="calibration",
            when=datetime(2026, 11, 21, 10),
            shots=(
                ShotEntry(name="b3", stripes=("p2",), lit=("p1", "cam")),
                ShotEntry(name="b9", stripes=("p1",)),
                ShotEntry(name="b1"),
            ),
        ),
    )
    captures = opened(rig_path)
    assert captures.shots == ("b3", "b9", "b1")
    assert captures.when == datetime(2026, 11, 21, 10)
    whole = {(s.shot, s.pair): s.has_stripes for s in captures.sequences}
    assert whole == {
        ("b3", "p1"): False,
        ("b3", "p2"): True,
        ("b3", "cam"): False,
        ("b9", "p1"): True,
        ("b1", "p1"): True,
        ("b1", "p2"): True,
        ("b1", "cam"): False,
    }
    missing = {s.shot: len(s.missing) for s in captures.sequences if s.missing}
    assert missing == {"b9": len(FRAMES)}  # it was never taken


def test_the_rig_file_chooses_shots_over_captures_yaml(tmp_path: Path) -> None:
    rig_path = write_small_captures(tmp_path)
    text = "kind: calibration\nshots: [{name: b1, lit: [p1]}, {name: b2}]\n"
    write(tmp_path / "captures" / "captures.yaml", text)
    rig_path = with_rig(
        tmp_path, RIG.replace("folder: captures", "{folder: captures, shots: [b3, b1]}")
    )
    captures = opened(rig_path)
    assert captures.shots == ("b3", "b1")
    assert [s.pair for s in captures.shot_sequences("b1")] == ["p1"]


@pytest.mark.parametrize(
    ("template", "names"),
    [
        ("{shot}/graycode_{frame}.png", ["b2", "b10"]),
        ("{frame}/{shot}/{shot}.PNG", ["b2", "b10"]),
        ("all/{shot}_{frame}_x.png", ["b2", "b10"]),
        ("{shot}-{frame}.jpg", ["a-b", "c.d"]),
    ],
)
def test_shots_are_told_from_file_names(tmp_path: Path, template: str, names: list[str]) -> None:
    for shot in names:
        for frame in FRAMES:
            path = tmp_path / "captures" / template.format(shot=shot, frame=frame)
            write(path, b"not looked at")
    write(tmp_path / "captures" / "all" / "notes.txt", b"")
    write(tmp_path / "captures" / ".hidden" / "lit.png", b"")
    captures = opened(with_rig(tmp_path, f'{ONE_PAIR}files: "{template}"\n'))
    assert captures.shots == tuple(names)  # b2 before b10
    assert not any(s.missing for s in captures.sequences)


def test_a_template_without_frame_holds_lit_images(tmp_path: Path) -> None:
    for pair in ("p1", "cam"):
        write(tmp_path / "captures" / pair / "00.jpg", b"not looked at")
    text = RIG.replace("folder: captures", '{folder: captures, files: "{pair}/{shot}.jpg"}')
    captures = opened(with_rig(tmp_path, text))
    assert [(s.shot, s.pair, s.has_stripes) for s in captures.sequences] == [
        ("00", "p1", False),
        ("00", "cam", False),
    ]
    write(tmp_path / "captures" / "captures.yaml",
          "kind: calibration\nshots: [{name: '00', stripes: [p1]}]")  # fmt: skip
    with pytest.raises(CaptureError, match=r"lists pair p1 in `stripes` of shot 00"):
        opened(tmp_path / "rig.yaml")


def test_cameras_may_write_files_of_other_kinds(tmp_path: Path) -> None:
    names = {"p1": "lit.TIF", "p2": "lit.jpg", "cam": "lit.png"}
    for pair, name in names.items():
        write(tmp_path / "captures" / "b1" / pair / name, b"not looked at")
        write(tmp_path / "captures" / "b1" / pair / "lit.json", b"")
    captures = opened(with_rig(tmp_path, RIG + "files: '{shot}/{pair}/{frame}.*'\n"))
    assert not any(s.has_stripes or s.missing for s in captures.sequences)
    assert {s.pair: s.paths[0].name for s in captures.sequences} == names


def test_a_template_without_shot_makes_a_folder_one_shot(tmp_path: Path) -> None:
    for frame in FRAMES:
        write(tmp_path / "scan7" / f"{frame}.png", b"not looked at")
    rig = load_rig(with_rig(tmp_path, ONE_PAIR + 'files: "{frame}.png"\n'))
    scan = open_scan(rig, tmp_path / "scan7")
    assert scan.shots == ("scan7",)
    assert not any(s.missing for s in scan.sequences)
    (tmp_path / "scan7").rename(tmp_path / "(Eve)")
    with pytest.raises(CaptureError, match=r"the folder.s name is not a valid shot name"):
        open_scan(rig, tmp_path / "(Eve)")
    write(tmp_path / "(Eve)" / "captures.yaml",
          "kind: scan\nsubject: S-1\nshots: [{name: still}]")  # fmt: skip
    scan = open_scan(rig, tmp_path / "(Eve)")
    assert (scan.shots, scan.subject) == (("still",), "S-1")


def test_folders_are_joined_and_shots_of_one_name_are_one_moment(tmp_path: Path) -> None:
    write_small_captures(tmp_path)
    captures = tmp_path / "captures"
    for shot in ("b1", "b2"):  # p2's images were written by another computer
        (tmp_path / "other" / shot).mkdir(parents=True)
        (captures / shot / "p2").rename(tmp_path / "other" / shot / "p2")
    rig_path = with_rig(tmp_path, RIG + "  - folder: other\n")
    joined = opened(rig_path)
    assert joined.folders == (captures, tmp_path / "other")
    assert [s.pair for s in joined.shot_sequences("b1")] == ["p1", "p2", "cam"]
    assert not any(s.missing for s in joined.sequences)
    write(tmp_path / "other" / "b1" / "p1" / "lit.png", picture("lit"))
    with pytest.raises(CaptureError, match=r"shot b1 of pair p1 is in .*captures as well"):
        opened(rig_path)


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("kind: calibration\nshots: [{name: b1, stripes: [p1-1]}]",
         "2:30: shots[0].stripes[0]: names no pair of rig small (did you mean 'p1'?)"),
        ("kind: calibration\nshots: [{name: b1, stripes: [p1-1, p2-1]}]", "Its pairs are p1, p2"),
        ("kind: calibration\nshots: [{name: b1, stripes: [cam]}]", "camera without projector"),
        ("kind: calibration\nshots: [{name: b1, lit: [p1], stripes: [p1]}]", "listed already"),
        ("kind: calibration\nshots: [{name: b1, lit: [p1, p1]}]", "2:30: shots[0].lit[1]: lists"),
        ("kind: calibration\nshots: [{name: b1}, {name: b1}]", "is given to two shots"),
        ("kind: calibration\nshots: [{name: 01}]", 'must be text (got 01: write "01")'),
        ("kind: calibration\nsubject: S-1", "2:10: subject: is for kind: scan"),
        ("kind: film", "1:7: kind: must be 'calibration' or 'scan' (got film)"),
        ("shots: []", "kind: is missing"),
        ("kind: calibration\nwhen: today", "when: must be a date and time such as 2026-"),
        ("kind: calibration\nshot: []", "shot: is not a key known here (did you mean 'shots'?)"),
        ("kind: calibration\nkind: scan", "2:1: kind: is given twice"),
        ("kind: scan", "is of kind scan, but calibration captures are wanted"),
        ("kind: [", "is not YAML"),
    ],
)  # fmt: skip
def test_mistakes_in_captures_yaml(tmp_path: Path, text: str, line: str) -> None:
    rig_path = write_small_captures(tmp_path, shots=1)
    path = write(tmp_path / "captures" / "captures.yaml", text)
    with pytest.raises(CaptureError) as caught:
        opened(rig_path)
    assert str(caught.value).startswith(str(path))
    assert line in str(caught.value)


def test_folders_that_are_not_there_or_hold_nothing(tmp_path: Path) -> None:
    rig_path = write(tmp_path / "rig.yaml", RIG)
    with pytest.raises(CaptureError, match=r"folder does not exist\s+Take shots of"):
        opened(rig_path)
    write(tmp_path / "captures" / "b1" / "p1" / "lit.jpg", b"")
    with pytest.raises(CaptureError, match=r"holds no image of rig small.*SHOT/p1/lit.png"):
        opened(rig_path)
    with pytest.raises(CaptureError, match="is not a folder"):
        open_scan(load_rig(rig_path), rig_path)
    with_rig(tmp_path, RIG.replace("calibration:\n  - folder: captures\n", ""))
    with pytest.raises(CaptureError, match="names no calibration captures"):
        opened(rig_path)


def test_a_rig_that_is_known_is_imported(tmp_path: Path) -> None:
    rig_path = with_rig(tmp_path, KNOWN)
    with pytest.raises(CaptureError, match="`bodyscan import`"):
        opened(rig_path)
    assert check(rig_path).warnings == ()
    with_rig(tmp_path, KNOWN.replace(", projector: {matrix: Kp}", ""))
    assert "names no calibration captures" in check(rig_path).warnings[0]


KNOWN = """\
name: one
pairs:
  - name: only
    camera: {width: 40, height: 30}
    projector: {stripes: 12, direction: horizontal}
    known: {file: c.yaml, format: opencv, units: mm, camera: {matrix: Kc}, projector: {matrix: Kp}}
"""


@pytest.mark.parametrize("link", ["b1/p1/lit.png", "b1/p1", "b1", "captures.yaml"])
def test_symbolic_links_out_of_the_folder_are_refused(tmp_path: Path, link: str) -> None:
    rig_path = write_small_captures(tmp_path / "rig")
    write(tmp_path / "rig" / "captures" / "captures.yaml", "kind: calibration")
    inside, outside = tmp_path / "rig" / "captures" / link, tmp_path / "secret"
    inside.rename(outside)
    inside.symlink_to(outside)
    with pytest.raises(CaptureError, match="symbolic link that leads out") as caught:
        opened(rig_path)
    assert caught.value.where == str(inside)
    assert "follow_links: true" in caught.value.remedy
    write(rig_path, rig_path.read_text() + "follow_links: true\n")
    assert len(opened(rig_path).sequences) == 9
    assert not any(s.missing for s in opened(rig_path).sequences)


def test_symbolic_links_within_the_folder_and_to_it_are_followed(tmp_path: Path) -> None:
    rig_path = write_small_captures(tmp_path)
    (tmp_path / "captures").rename(tmp_path / "elsewhere")
    (tmp_path / "captures").symlink_to(tmp_path / "elsewhere")
    (tmp_path / "captures" / "b4").symlink_to("b1")
    (tmp_path / "captures" / "b5").symlink_to("b5")  # a circle leads nowhere
    captures = opened(rig_path)
    assert captures.shots == ("b1", "b2", "b3", "b4")
    assert not any(s.missing for s in captures.sequences)
    (tmp_path / "captures" / "captures.yaml").symlink_to("captures.yaml")
    with pytest.raises(CaptureError, match="cannot be read"):
        opened(rig_path)


def test_shots_are_called_as_people_call_them(tmp_path: Path) -> None:
    """Spaces, accents (of one letter or two, as macOS writes them), brackets and times."""
    rig_path = write_small_captures(tmp_path)
    names = (
        "2013-May-14_20.41.56.117",
        "pose (2), d\u00e9but",
        "pose 10 e\u0301t\u00e9",
        "\u6771 #1",
    )
    folder = tmp_path / "captures"
    for name in names:
        shutil.copytree(folder / "b1", folder / name)
    for name in ("-b4", ".hidden", "@eaDir"):
        shutil.copytree(folder / "b1", folder / name)
    captures = opened(rig_path)
    assert set(captures.shots) == {"b1", "b2", "b3", *names}
    assert not any(s.missing for s in captures.sequences)
    listed = ", ".join(json.dumps({"name": name}) for name in names)
    write(folder / "captures.yaml", f"kind: calibration\nshots: [{listed}]")
    assert opened(rig_path).shots == names


@pytest.mark.parametrize(
    ("name", "said"),
    [("-b1", r"\(got '-b1'\)"), ("b\t1", r"not '\\t'"), ("b*", r"not '\*'"), ("../b1", "not '/'")],
)
def test_a_name_that_no_shot_can_have_is_told_with_its_line(
    tmp_path: Path, name: str, said: str
) -> None:
    rig_path = write_small_captures(tmp_path)
    content = f"kind: calibration\nshots:\n  - name: {json.dumps(name)}\n"
    write(tmp_path / "captures" / "captures.yaml", content)
    with pytest.raises(CaptureError, match=rf"captures.yaml:3:.*{said}"):
        opened(rig_path)


def test_the_examples_of_the_documentation_are_right(tmp_path: Path) -> None:
    root = Path(__file__).parents[2]
    text = (root / "docs" / "formats.md").read_text(encoding="utf-8")
    blocks = [part.split("```")[0] for part in text.split("```yaml\n")[1:]]
    (whole,) = (block for block in blocks if "\nboards:" in block)
    (references,) = (block for block in blocks if block.startswith("references:"))
    (frames,) = (block for block in blocks if block.startswith("frames:"))
    (captures,) = (block for block in blocks if "kind: calibration" in block)
    rig = load_rig(write(tmp_path / "rig.yaml", whole + frames))
    assert rig.frames.lit == "40"
    described = yaml.safe_load(whole + frames + references)
    marked = {**described["boards"][0], "kind": "charuco", "marker_mm": 50}
    described["boards"] += [
        {**marked, "name": name, "first_marker": 100 * k}
        for k, name in enumerate(("left", "right", "plate"))
    ]
    certified = load_rig(write(tmp_path / "rig.yaml", yaml.safe_dump(described)))
    assert [reference.name for reference in certified.references] == ["bar", "steel"]
    write(tmp_path / "captures.yaml", captures)
    file = load_captures_file(tmp_path, load_rig(root / "rigs" / "three-pole-12.yaml"))
    assert file.shots is not None
    assert file.shots[1].stripes == ("p1-1", "p1-2")
