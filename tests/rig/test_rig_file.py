"""Rig files: read as meant, and every mistake reported by line, column and path."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st
from small_captures import RIG, write

from bodyscan.errors import RigFileError
from bodyscan.files.yaml_file import dump_yaml, read_yaml
from bodyscan.rig.board import MARKERS_IN
from bodyscan.rig.rig import Rig, find_unusual_lengths, load_rig, write_rig
from bodyscan.stripes.codes import parse_stripe_code
from bodyscan.stripes.codes.gray import Gray

RIGS = Path(__file__).parents[2] / "rigs"
REFERENCE = "version: 1\nreferences: [{name: a"


def refused(tmp_path: Path, text: str | bytes) -> list[str]:
    """The lines of the error, less the remedy, with `rig.yaml` for the whole path."""
    path = write(tmp_path / "rig.yaml", text)
    with pytest.raises(RigFileError) as caught:
        load_rig(path)
    assert caught.value.exit_code == 2
    assert "docs/formats.md" in caught.value.remedy
    lines = str(caught.value).replace(str(path), "rig.yaml").splitlines()
    return lines[:-1]


def changed(old: str, new: str) -> str:
    assert old in RIG
    return RIG.replace(old, new, 1)


@pytest.mark.parametrize("path", sorted(RIGS.glob("*.yaml")), ids=lambda path: path.stem)
def test_the_rig_files_of_the_project_load_and_survive_writing(path: Path, tmp_path: Path) -> None:
    rig = load_rig(path)
    write_rig(tmp_path / "again.yaml", rig)
    assert load_rig(tmp_path / "again.yaml") == rig
    assert not list(find_unusual_lengths(rig))


def test_a_rig_file_is_read_as_meant(tmp_path: Path) -> None:
    rig = load_rig(write(tmp_path / "rig.yaml", RIG))
    assert [pair.name for pair in rig.pairs] == ["p1", "p2", "cam"]
    assert rig.pair("p2").camera.width == 40
    assert rig.pair("cam").projector is None
    assert rig.board("board").square_mm == 30
    scaled = load_rig(
        write(tmp_path / "scaled.yaml", changed("square_mm: 30", "square_mm: 30, scale: 1.01"))
    )
    write_rig(tmp_path / "again.yaml", scaled)  # a scale counts once
    assert load_rig(tmp_path / "again.yaml").board("board").square_mm == pytest.approx(30.3)
    assert rig.files == "{shot}/{pair}/{frame}.png"
    assert rig.frame_pair is rig.pairs[0]
    assert rig.frame_board is None


def test_merge_keys_take_what_is_not_given(tmp_path: Path) -> None:
    text = changed(
        "  - name: p2\n    camera: *camera\n    projector: {stripes: 12, direction: horizontal}",
        "  - &p2\n    name: p2\n    camera: {<<: *camera, width: 50}\n  - {<<: *p2, name: p3}",
    )
    rig = load_rig(write(tmp_path / "rig.yaml", text))
    assert (rig.pair("p2").camera.width, rig.pair("p2").camera.height) == (50, 30)
    assert rig.pair("p3").camera == rig.pair("p2").camera


CHARUCO = "square_mm: 30, kind: charuco"


@pytest.mark.parametrize(
    ("old", "new", "line"),
    [
        ("width: 40", "width: -5", "7:29: pairs[0].camera.width: must be greater than 0 (got -5)"),
        ("width: 40", "width: 40.5", "pairs[0].camera.width: must be a whole number (got 40.5)"),
        ("width: 40", "widht: 40", "pairs[0].camera.widht: is not a key known here (did you mean"),
        ("{width: 40, height: 30}", "big", "must be a mapping (key: value) (got big)"),
        ("square_mm: 30", "square_mm: 0", "4:51: boards[0].square_mm: must be greater than 0"),
        ("square_mm: 30", "square_mm: 1e9999", "boards[0].square_mm: must be a finite number"),
        ("square_mm: 30", "square_mm: ", "boards[0].square_mm: must be a number (got nothing)"),
        (", square_mm: 30", "", "4:5: boards[0].square_mm: is missing"),
        ("square_mm: 30", "square_mm: 30, marker_mm: 9", "is for boards with markers"),
        ("square_mm: 30", "square_mm: 30, thickness_mm: 6", "is for a board with faces: 2"),
        ("square_mm: 30", "square_mm: 30, faces: 3", "boards[0].faces: must be 1 or 2 (got 3)"),
        ("square_mm: 30", CHARUCO, "boards[0].marker_mm: is missing"),
        ("square_mm: 30", f"{CHARUCO}, marker_mm: 30", "marker_mm: must be less than square_mm (30)"),
        ("square_mm: 30", f"{CHARUCO}, marker_mm: 9, dictionary: DICT_4x4_50", "mean 'DICT_4X4_50'?"),
        ("square_mm: 30", f"{CHARUCO}, marker_mm: 9, dictionary: DICT_4X4_50, first_marker: 45",
         "boards[0].dictionary: holds markers 0 to 49, but this board needs 45 to 54"),
        ("columns: 5", "columns: 5, columns: 6", "4:31: boards[0].columns: is given twice"),
        ("name: p2", "name: p1", "9:11: pairs[1].name: is given to two pairs: every name once"),
        ("name: p2", "name: ../up", "pairs[1].name: must be a name of letters, digits"),
        ("name: p2", "name: p2\n    nominal: {position_mm: [1, 2, 3], look_at_mm: [1, 2, 3]}",
         "pairs[1].nominal.look_at_mm: must differ from position_mm"),
        ("name: p2", "name: p2\n    nominal: {position_mm: [1, 2], look_at_mm: [1, 2, 3]}",
         "pairs[1].nominal.position_mm[2]: is missing"),
        ("name: cam", "name: cam\n    projector_nominal: {position_mm: [1, 2, 4], look_at_mm: "
         "[1, 2, 3]}", "pairs[2].projector_nominal: needs a projector"),
        ("direction: h", "direction: diagonal-h", "must be 'horizontal' or 'vertical' (got diag"),
        ("code: gray", "code: grey", "8:23: pairs[0].projector.code: must be 'gray', 'binary', 'li"),
        ("code: gray", "code: grey", "or 'stripe-index' (did you mean 'gray'?) (got grey)"),
        ("code: gray", "code: gray, invreses: true",
         "8:29: pairs[0].projector.invreses: is not a key known here (did you mean 'inverses'?)"),
        (", stripes: 12", "", "8:16: pairs[0].projector.stripes: is missing"),
        ("{code: gray, stripes: 12, direction: horizontal}", "gray", "projector: must be a mapping"),
        ("code: gray", "code: light-section, inverses: true", "inverses: is for code: gray"),
        ("code: gray, stripes: 12", "code: light-section, stripes: 1, crossing: {stripes: 4}",
         "pairs[0].projector.crossing: is for projectors: a laser's single line"),
        ("code: gray", "code: phase-shift, steps: 2", "steps: must be 3 or more or a list (got 2)"),
        ("code: gray", "code: phase-shift, period: 20", "period: must be 12 (stripes) or less (got"),
        ("code: gray, stripes: 12", "code: stripe-index, stripes: 255", "must be 254 or less for s"),
        ("version: 1", "version: 2", "1:10: version: must be 1 (got 2)"),
        ("  - folder: captures", "  - folder: a\n  - folder: a/", "folder: is listed twice"),
        ("  - folder: captures", "  folder: captures", "calibration: must be a list (got a map"),
        ("square_mm: 30", "square_mm: \u00a030", "square_mm: has a no-break space (U+00A0)"),
        ("    camera: *camera", "  \u00a0 camera: *camera", "not YAML: has a no-break space (U+00A0)"),
        ("square_mm: 30", "square_mm:\u00a030", "4:40: boards[0].square_mm:\\xa030: has a no-break"),
        ("name: p2", "name: \u201cp2\u201d", "pairs[1].name: has a left double quotation mark"),
        ("version: 1", "version: 1\nrig_frame: {pair: p9}", "rig_frame.pair: names no pair"),
        ("version: 1", "version: 1\nrig_frame: {pair: p1, shot: b}", "together with shot"),
        ("version: 1", "version: 1\nrig_frame: {shot: b, board: bord}", "(did you mean 'board'?)"),
        ("version: 1", "version: 1\nrig_frame: {board: board}", "rig_frame.board: needs shot"),
        ("version: 1", "version: 1\nrig_frame: {shot: b, x_axis: [0, 0, 0]}", "not be zero"),
        ("version: 1", "version: 1\nrig_frame: {shot: b, x_axis: [1, 1, 0]}", "perpendicular"),
        ("version: 1", f"{REFERENCE}, boards: [bord], length_mm: 1, sigma_mm: 1}}]",
         "2:33: references[0].boards[0]: names no board of this file (did you mean 'board'?)"),
        ("version: 1", f"{REFERENCE}, boards: [board], length_mm: 1, sigma_mm: 1}}]",
         "must have markers, which tell its corners apart from every side: board board is a plain"),
        ("version: 1", f"{REFERENCE}, boards: [], length_mm: 1, sigma_mm: 1}}]",
         "references[0].boards: "),
        ("version: 1", f"{REFERENCE}, boards: [x, x], length_mm: 1, sigma_mm: 0}}]",
         "references[0].sigma_mm: must be"),
        ("version: 1", "version: 1\nvolume: {top_mm: 100, bottom_mm: 200}", "must lie below top"),
        ("version: 1", "version: 1\nframes: {pattern: bit}", "frames.pattern: needs {bit}, or"),
        ("version: 1", "version: 1\nframes: {pattern: '{bit.real}'}", "may only hold {bit}"),
        ("version: 1", "version: 1\nframes: {patern: x}",
         "2:10: frames.patern: is not a key known here (did you mean 'pattern'?)"),
        ("version: 1", "version: 1\nframes: {index: [a]}", "frames.index: must be text: there is"),
        ("version: 1", "version: 1\nframes: all", "2:9: frames: must be a mapping"),
        ("version: 1", "version: 1\nframes: {pattern: [a, 5]}", "frames.pattern[1]: must be text"),
        ("version: 1", "version: 1\nframes: {pattern: [a, b, c]}",
         "2:19: frames.pattern: has 3 names, but the 12 stripes of pair p1 take 4 bits"),
        ("version: 1", "version: 1\nframes: {lit: same, dark: same}", "two images the same name"),
        ("version: 1", "version: 1\nfiles: '{shot}/{frame}.png'", "files: needs {pair}, since"),
        ("version: 1", "version: 1\nfiles: '{shot}/{pair}.png'", "files: needs {frame}, since"),
        ("version: 1", "version: 1\nfiles: '{shot}/{pair}/{frame}.gif'", "must end in .png"),
        ("version: 1", "version: 1\nfiles: '../{shot}/{pair}/{frame}.png'", "must not climb out"),
        ("version: 1", "version: 1\nfiles: '{shot}/{pair}/{frame:03d}.png'", "without :03d"),
        ("version: 1", "version: 1\nfiles: '/{shot}/{pair}/{frame}.png'", "must be relative"),
        ("version: 1", "version: 1\nfiles: 'C:/{shot}/{pair}/{frame}.png'", "nor a drive letter"),
        ("version: 1", "version: 1\nfiles: '{shot}/{pole}/{frame}.png'", "not {pole}"),
    ],
)  # fmt: skip
def test_one_mistake_is_one_line(tmp_path: Path, old: str, new: str, line: str) -> None:
    lines = refused(tmp_path, changed(old, new))
    assert len(lines) == 1
    assert lines[0].startswith("rig.yaml:")
    assert line in lines[0]


def test_all_mistakes_of_codes_and_names_are_reported_at_once(tmp_path: Path) -> None:
    text = changed("code: gray, stripes: 12", "code: grey, stripes: 1, steps: 4, colour: red")
    lines = refused(tmp_path, text + "frames: {patern: x, phase: '{bit}', lit: ../up, dark: 7}\n")
    joined = "\n".join(lines)
    for part in ("code: must be", "stripes: must be 2", "colour: is not a key", "frames.patern: is not",
                 "frames.dark: must be text"):  # fmt: skip
        assert part in joined
    assert len(lines) == 5, "steps may be right for the code that was meant"


def test_keys_without_a_value_are_ignored() -> None:
    """As calibrations have them that were written when every code had every key."""
    keys: dict[str, Any] = {"stripes": 12, "direction": "vertical"}
    nothing = {"inverses": None, "steps": None, "period": None}
    assert parse_stripe_code({"code": "gray", **keys, **nothing}) == Gray(**keys)
    assert parse_stripe_code({"code": "stripe-index", **keys, **nothing}).code == "stripe-index"


def test_markers_of_two_boards_must_differ(tmp_path: Path) -> None:
    def two(second: str) -> str:
        board = f"  - {{name: board, columns: 5, rows: 4, {CHARUCO}, marker_mm: 20, faces: 2}}\n"
        other = f"  - {{name: other, columns: 4, rows: 4, {CHARUCO}, marker_mm: 20, {second}}}\n"
        return changed("  - {name: board, columns: 5, rows: 4, square_mm: 30}\n", board + other)

    # 2 faces of 5 x 4 squares take markers 0 to 19; DICT_4X4_50 begins DICT_4X4_1000.
    for second in ("first_marker: 19", "first_marker: 19, dictionary: DICT_4X4_50"):
        lines = refused(tmp_path, two(second))
        assert len(lines) == 1
        assert "boards[1].first_marker: gives board other markers 19 to 26" in lines[0]
        assert "first_marker 20 or more" in lines[0]
    for second in ("first_marker: 20", "dictionary: DICT_5X5_50"):
        load_rig(write(tmp_path / "rig.yaml", two(second)))


def test_all_mistakes_are_reported_at_once_in_order(tmp_path: Path) -> None:
    text = changed("square_mm: 30", "square_mm: 0, colour: red").replace("name: p2", "name: p1")
    text = text.replace("height: 30", 'height: "30"').replace("name: cam", "name: a b")
    lines = refused(tmp_path, text)
    numbers = [int(line.split(":")[1]) for line in lines]
    assert numbers == sorted(numbers)
    joined = "\n".join(lines)
    for part in ("square_mm: must be", "colour: is no", "height: must", "name: must be a name"):
        assert part in joined
    # p2's and cam's camera are aliases of p1's: one mistake, reported once, where it is written.
    (height,) = (line for line in lines if "camera.height" in line)
    assert height.startswith("rig.yaml:7:")
    assert height.endswith("(and so in 2 more places by alias)")
    # Then all that does not fit together.
    text = changed("name: p2", "name: p1") + "rig_frame: {pair: p7}\nfiles: nothing\n"
    joined = "\n".join(refused(tmp_path, text))
    for part in ("given to two pairs", "names no pair", "needs {pair}", "must end in"):
        assert part in joined


@pytest.mark.parametrize(
    ("content", "line"),
    [
        ("name: [1, 2", "is not YAML"),
        ("name:\n\tpairs: []", "indent with spaces, never with tabs"),
        ("a: *nobody", "1:4: is not YAML: found undefined alias"),
        ("name: x\n---\nname: y", "found another document"),
        (b"name: \xff\xfe", "1:7: is not UTF-8 text"),
        (b"name: \x00", "is not YAML"),
        ("", "1:1: must be a mapping"),
        ("- 1", "1:1: must be a mapping"),
        ("[" * 100_000, "is nested more than 40 deep"),
        ("&a [*a]", "is nested more than 40 deep"),
        ("&a {<<: *a}", "merges (<<) too much"),
        ("name: !!python/object/apply:os.getcwd []", "write the value without a tag"),
        ("? [a]\n: 1", "has a key that is not text"),
        ("x" * 1_000_001, "is longer than 1,000,000 bytes"),
    ],
)
def test_files_that_are_not_rig_files(tmp_path: Path, content: str | bytes, line: str) -> None:
    assert any(line in text for text in refused(tmp_path, content))


def test_alias_bombs_are_refused_before_they_are_expanded(tmp_path: Path) -> None:
    levels = ["a0: &a0 [x, x, x, x, x, x, x, x, x]"]
    levels += [f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]" for i in range(1, 12)]
    lines = refused(tmp_path, "\n".join(levels))  # 9^12 values: weeks, if they were followed
    assert "values once aliases are followed" in lines[0]
    merges = ["a0: &a0 {x: 1}"]
    merges += [f"a{i}: &a{i} {{<<: [{', '.join([f'*a{i - 1}'] * 9)}]}}" for i in range(1, 12)]
    assert "too much" in refused(tmp_path, "\n".join(merges))[0]


def test_a_missing_rig_file(tmp_path: Path) -> None:
    with pytest.raises(RigFileError, match=r"nowhere\.yaml: there is no such file"):
        load_rig(tmp_path / "nowhere.yaml")
    with pytest.raises(RigFileError, match="cannot be read: Is a directory"):
        load_rig(tmp_path)


def test_long_lists_of_mistakes_are_cut(tmp_path: Path) -> None:
    lines = refused(tmp_path, RIG + "".join(f"key{i}: 1\n" for i in range(50)))
    assert len(lines) == 31
    assert lines[-1] == "... and 20 more"


def test_dictionaries_are_those_of_opencv() -> None:
    for name, count in MARKERS_IN.items():
        dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))
        assert len(dictionary.bytesList) == count
    names = {name.lower() for name in dir(cv2.aruco) if name.startswith("DICT_")}
    assert names == {name.lower() for name in MARKERS_IN}


@pytest.mark.slow
@given(
    st.recursive(
        st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text(),
        lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(), inner, max_size=4),
        max_leaves=20,
    )
)
def test_written_yaml_reads_back_as_it_was(
    tmp_path_factory: pytest.TempPathFactory, data: object
) -> None:
    path = tmp_path_factory.getbasetemp() / "any.yaml"
    path.write_text(dump_yaml(data), encoding="utf-8", newline="")
    document = read_yaml(path)
    assert document.problems == []
    assert document.data == data


def test_words_that_yaml_1_1_misreads_stay_words(tmp_path: Path) -> None:
    path = write(tmp_path / "x.yaml", "[no, on, 1:30, 010, 2026-11-21, 1_000, 1e3, 0o10, '5']")
    assert read_yaml(path).data == [
        "no", "on", "1:30", 10, "2026-11-21", "1_000", 1000.0, 8, "5",
    ]  # fmt: skip


CROSSED = changed(
    "code: gray, stripes: 12, direction: horizontal",
    "code: gray, stripes: 12, direction: horizontal, first_code: 2, crossing: {stripes: 20}",
)


def test_crossing_stripes_have_the_same_code_by_default(tmp_path: Path) -> None:
    rig = load_rig(write(tmp_path / "rig.yaml", CROSSED))
    first = rig.pair("p1").projector
    assert first is not None
    assert first.crossing == Gray(stripes=20, direction="vertical")
    assert first.directions == (first, first.crossing)
    names = rig.frames.code_names(first)
    assert len(names) == 2 * 4 + 2 * 5
    assert (names[0], names[8], names[-1]) == ("bit00", "crossing-bit00", "crossing-bit04-inverse")
    write_rig(tmp_path / "again.yaml", rig)
    assert load_rig(tmp_path / "again.yaml") == rig
    waves = CROSSED.replace("{stripes: 20}", "{stripes: 20, code: phase-shift, steps: 3}")
    second = load_rig(write(tmp_path / "rig.yaml", waves)).pairs[0].projector
    assert second is not None
    assert second.crossing == parse_stripe_code(
        {"code": "phase-shift", "stripes": 20, "direction": "vertical", "steps": 3}
    )


@pytest.mark.parametrize(
    ("old", "new", "line"),
    [
        ("{stripes: 20}", "{}", "projector.crossing.stripes: is missing"),
        ("{stripes: 20}", "{stripes: 20, direction: horizontal}",
         "crossing.direction: must not be horizontal as well"),
        ("{stripes: 20}", "{stripes: 20, crossing: {stripes: 4}}", "stripes run two ways"),
        ("first_code: 2", "first_code: 65530", "first_code: must be 65524 or less: 12 stripes"),
        ("version: 1", "version: 1\nframes: {pattern: [a, b, c, d, e]}",
         "12 stripes of pair p1 from 2 take 4 bits"),
        ("version: 1", "version: 1\nframes: {crossing: {pattern: [a, b]}}",
         "frames.crossing.pattern: has 2 names, but the 20 stripes of pair p1 take 5 bits"),
        ("version: 1", "version: 1\nframes: {crossing: {lit: a}}", "crossing.lit: is not a key"),
        ("version: 1", "version: 1\nframes: {crossing: {pattern: 'bit{bit:02d}'}}",
         "gives two images the same name ('bit00')"),
        ("version: 1", "version: 1\nframes: {lit: null}", "frames.lit: or board is needed: pair cam"),
    ],
)  # fmt: skip
def test_one_mistake_in_crossing_stripes_is_one_line(
    tmp_path: Path, old: str, new: str, line: str
) -> None:
    assert old in CROSSED
    lines = refused(tmp_path, CROSSED.replace(old, new, 1))
    assert len(lines) == 1, lines
    assert line in lines[0]


def test_missing_lit_and_useless_crossing_names_are_refused(tmp_path: Path) -> None:
    (line,) = refused(tmp_path, RIG + "frames: {crossing: {pattern: 'c{bit}'}}\n")
    assert "frames.crossing: is for a projector with `crossing`" in line
    text = changed("code: gray", "code: gray, inverses: false")
    (line,) = refused(tmp_path, text + "frames: {dark: null}\n")
    assert "frames.dark: is needed: pair p1 takes no inverses" in line
    (line,) = refused(tmp_path, text + "frames: {lit: null, board: room}\n")
    assert "frames.lit: is needed: the images of pair p1 do not show the scene" in line


def test_boards_are_needed_for_calibration_captures_only(tmp_path: Path) -> None:
    text = changed("boards:\n  - {name: board, columns: 5, rows: 4, square_mm: 30}\n", "")
    (line,) = refused(tmp_path, text)
    assert "boards: is missing: calibration captures show a board" in line
    text = text.replace("calibration:\n  - folder: captures", "")
    assert load_rig(write(tmp_path / "r.yaml", text)).boards == ()


def test_lengths_in_metres_or_centimetres_are_warned_of() -> None:
    content = yaml.safe_load((RIGS / "three-pole-12.yaml").read_text())
    content["boards"][0] |= {"square_mm": 7, "marker_mm": 5}
    content["volume"] = {"radius_mm": 0.7, "bottom_mm": 0.0, "top_mm": 2.2}
    content["pairs"][0]["nominal"] = {"position_mm": [0.65, 1.1, 0.7], "look_at_mm": [0, 0, 0.3]}
    warnings = list(find_unusual_lengths(Rig.model_validate(content)))
    assert len(warnings) == 4
    assert "square_mm is 7 mm" in warnings[0]
    assert "radius_mm is 0.7 mm" in warnings[1]
    assert "pair p1-1" in warnings[3]
