"""A calibration that is not one is refused, whoever made it so: by hand, by a disk, by malice."""

from __future__ import annotations

import io
import json
import shutil
import zipfile
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from small_workspace import run

from bodyscan.errors import BodyscanError, CalibrationFileError
from bodyscan.files.atomic import write_npz
from bodyscan.files.hashing import hash_file
from bodyscan.files.reading import read_npz
from bodyscan.registration.storage import (
    accept_calibration,
    archive_previous,
    calibration_id,
    load_calibration,
    save_calibration,
)

STORED = Path(__file__).parents[1] / "data" / "stored-0.1.0" / "calibration"
"""Of version 1, which has no hash of its JSON: only what it holds tells that it was changed."""


def set_(content: dict[str, Any], *where: str | int, to: Any) -> None:
    for part in where[:-1]:
        content = content[part]  # type: ignore[index]
    content[where[-1]] = to  # type: ignore[index]


def pose(content: dict[str, Any], change: Callable[[Any], Any]) -> None:
    pair = content["pairs"]["p1-2"]
    pair["rig_from_camera"] = change(np.array(pair["rig_from_camera"])).tolist()


CAMERA = ("pairs", "p1-2", "camera")
MISTAKES: dict[str, Callable[[dict[str, Any]], Any]] = {
    "a focal length that is NaN": lambda c: set_(c, *CAMERA, "alpha", to=float("nan")),
    "a negative focal length": lambda c: set_(c, *CAMERA, "alpha", to=-755.0),
    "a focal length as text": lambda c: set_(c, *CAMERA, "alpha", to="755.9"),
    "a camera without k1": lambda c: c["pairs"]["p1-2"]["camera"].pop("k1"),
    "a lens that folds over": lambda c: set_(c, *CAMERA, "k1", to=-4.0),
    "a principal point far outside": lambda c: set_(c, *CAMERA, "u0", to=3155.0),
    "a picture of another size": lambda c: set_(c, *CAMERA, "width", to=1280),
    "an unknown lens": lambda c: set_(c, *CAMERA, "lens", to="magic"),
    "a mirrored rotation": lambda c: pose(c, lambda m: m @ np.diag([1.0, 1.0, -1.0, 1.0])),
    "a matrix turned over": lambda c: pose(c, np.transpose),
    "a note that is no text": lambda c: set_(c, "notes", to=["\ud800"]),
    "a matrix of three rows": lambda c: pose(c, lambda m: m[:3]),
    "a pose beyond the horizon": lambda c: set_(
        c, "pairs", "p1-2", "rig_from_camera", 0, 3, to=1e9
    ),
    "a pair that the rig has not": lambda c: set_(c, "pairs", "p9", to=c["pairs"].pop("p1-2")),
    "a pair too few": lambda c: c["pairs"].clear(),
    "a pair calibrated and failed": lambda c: set_(c, "failed", "p1-2", to="lost"),
    "no order of the covariance": lambda c: c.pop("placing_covariance_order"),
    "an order that leaves one out": lambda c: c["placing_covariance_order"].pop(),
    "an order with a stranger": lambda c: set_(c, "placing_covariance_order", 0, to="p9"),
    "a board that the rig has not": lambda c: set_(c, "boards", 0, "board", to="other"),
    "a board listed twice": lambda c: c["boards"].append(c["boards"][0]),
    "fewer boards than were seen": lambda c: c["boards"].clear(),
    "a mirrored board": lambda c: set_(c, "boards", 0, "rig_from_board", 2, to=[0, 0, 0, 0]),
    "light of unknown kind": lambda c: set_(c, "pairs", "p1-2", "light", "kind", to="magic"),
    "light the other way": lambda c: set_(c, "pairs", "p1-2", "light", "direction", to="vertical"),
    "light that is gone": lambda c: set_(c, "pairs", "p1-2", "light", to=None),
    "stripes of another number": lambda c: set_(
        c, "rig", "pairs", 0, "projector", "stripes", to=160
    ),
    "a rig that is none": lambda c: set_(c, "rig", to={}),
    "a quality unheard of": lambda c: set_(c, "pairs", "p1-2", "quality", "beauty", to=1.0),
    "notes that are a text": lambda c: set_(c, "notes", to="all well"),
    "pairs that are a list": lambda c: set_(c, "pairs", to=[]),
    "another version": lambda c: set_(c, "version", to=7),
    "another schema": lambda c: set_(c, "schema", to="something"),
    "arrays of another calibration": lambda c: set_(c, "arrays_sha256", to="0" * 64),
}


@pytest.fixture
def copy(tmp_path: Path) -> Path:
    return Path(shutil.copytree(STORED, tmp_path / "calibration"))


def read(folder: Path) -> Any:
    return json.loads((folder / "calibration.json").read_text("utf-8"))


def write(folder: Path, content: Any) -> None:
    (folder / "calibration.json").write_text(json.dumps(content), "utf-8")


@pytest.mark.parametrize("mistake", MISTAKES)
def test_what_no_calibration_can_be_like_is_refused_without_any_hash(
    mistake: str, copy: Path
) -> None:
    content = read(copy)
    MISTAKES[mistake](content)
    write(copy, content)
    with pytest.raises(CalibrationFileError) as refused:
        load_calibration(copy)
    assert str(copy) in refused.value.where
    assert refused.value.remedy


ARRAYS: dict[str, Callable[[dict[str, Any]], Any]] = {
    "NaN in it": lambda a: set_(a, "placing_covariance", to=np.full((24, 24), np.nan)),
    "numbers of two bytes": lambda a: set_(
        a,
        "placing_covariance",
        to=(np.eye(24) + 2.0 * (np.eye(24, k=1) + np.eye(24, k=-1))).astype(np.float16),
    ),
    "the wrong shape": lambda a: set_(a, "placing_covariance", to=np.eye(6)),
    "correlations beyond one": lambda a: set_(
        a, "p1-2/camera_covariance", to=np.eye(7) + 2.0 * (np.eye(7, k=1) + np.eye(7, k=-1))
    ),
    "a mirrored projector": lambda a: set_(
        a, "p1-2/light/projector_from_camera", to=np.diag([1.0, 1.0, -1.0, 1.0])
    ),
    "parameters too few": lambda a: set_(a, "p1-2/light/parameters", to=np.zeros(2)),
    "other stripes": lambda a: set_(a, "p1-2/light/stripes", to=np.array(7.0)),
    "no stripes": lambda a: a.pop("p1-2/light/stripes"),
    "corners of too few": lambda a: set_(a, "p1-2/seen/pixels", to=np.zeros((3, 2))),
    "corners on boards unheard of": lambda a: set_(
        a, "p1-2/seen/target", to=np.full_like(a["p1-2/seen/target"], 99)
    ),
}


@pytest.mark.parametrize("mistake", ARRAYS)
def test_arrays_that_cannot_be_right_are_refused_though_their_hash_fits(
    mistake: str, copy: Path
) -> None:
    with np.load(copy / "calibration.npz") as stored:
        arrays = dict(stored)
    ARRAYS[mistake](arrays)
    write_npz(copy / "calibration.npz", **arrays)
    write(copy, read(copy) | {"arrays_sha256": hash_file(copy / "calibration.npz")})
    with pytest.raises(CalibrationFileError):
        load_calibration(copy)


def places(content: Any, where: tuple[str | int, ...] = ()) -> list[tuple[str | int, ...]]:
    """Of every value in plain data."""
    parts: Any = ()
    if isinstance(content, dict):
        parts = content.items()
    elif isinstance(content, list):
        parts = enumerate(content)
    below = [place for key, value in parts for place in places(value, (*where, key))]
    return [where, *below] if where else below


@pytest.fixture(scope="module")
def stored_now(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same calibration as this version writes it."""
    folder = tmp_path_factory.mktemp("now")
    save_calibration(load_calibration(STORED), folder)
    return folder


@pytest.fixture
def mine(stored_now: Path, tmp_path: Path) -> Path:
    """A copy of it, to be edited."""
    return Path(shutil.copytree(stored_now, tmp_path / "mine"))


@pytest.mark.slow
@given(st.data())
def test_no_value_is_changed_unseen(stored_now: Path, data: st.DataObject) -> None:
    content = read(stored_now)
    where = data.draw(st.sampled_from(places(content)))
    values = st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=9)
    value: object = data.draw(values | st.lists(values, max_size=4) | st.just({}))
    before = content
    for part in where:
        before = before[part]
    # 1 and 1.0 and True are one to Python and not in a file.
    if json.dumps(before) == json.dumps(value):
        return
    set_(content, *where, to=value)
    edited = stored_now.with_name("edited")
    edited.mkdir(exist_ok=True)
    shutil.copy(stored_now / "calibration.npz", edited)
    write(edited, content)
    with pytest.raises(CalibrationFileError):
        load_calibration(edited)


@pytest.mark.parametrize("part", ["camera", "rig_from_camera", "quality"])
def test_parts_exchanged_between_pairs_are_noticed(part: str, mine: Path) -> None:
    content = read(mine)
    a, b = (content["pairs"][name] for name in ("p1-2", "p2-3"))
    a[part], b[part] = b[part], a[part]
    write(mine, content)
    with pytest.raises(CalibrationFileError, match="was changed after it was stored"):
        load_calibration(mine)


def test_an_edit_that_is_meant_is_stored_with_a_note(mine: Path) -> None:
    content = read(mine)
    content["pairs"]["p1-2"]["rig_from_camera"][0][3] += 2.0
    write(mine, content)
    refused = run("export-rig", mine, "--out", mine.with_name("out"))
    assert isinstance(refused.exception, CalibrationFileError)
    assert "bodyscan accept-changed" in refused.exception.remedy
    assert run("accept-changed", mine).exit_code == 0
    found = load_calibration(mine)
    assert found.rig_from_camera["p1-2"].translation[0] == pytest.approx(652.0)
    assert "edited by hand" in found.notes[-1]


def test_a_calibration_that_nobody_edited_stays_as_it_is(mine: Path) -> None:
    before = {path.name: path.read_bytes() for path in mine.iterdir()}
    done = run("accept-changed", mine)
    assert done.exit_code == 0
    assert "was not edited" in done.output
    assert {path.name: path.read_bytes() for path in mine.iterdir()} == before


def test_an_edit_that_cannot_be_right_is_not_accepted(mine: Path) -> None:
    content = read(mine)
    del content["sha256"]  # which is an edit too
    write(mine, content)
    (mine / "report.html").touch()
    (mine / "corners.vnl").touch()
    assert accept_calibration(mine)
    assert [path.name for path in mine.glob("[cr]*.[hv]*")] == ["corners.vnl"]
    content["pairs"]["p1-2"]["camera"]["alpha"] *= -1.0
    write(mine, content)
    with pytest.raises(CalibrationFileError, match=r"p1-2\.camera\.alpha is not a focal length"):
        accept_calibration(mine)
    path = mine / "calibration.json"
    path.write_text(path.read_text("utf-8").replace("{", '{"notes": ["a"],', 1), "utf-8")
    with pytest.raises(CalibrationFileError, match="'notes' is given twice"):
        load_calibration(mine)
    content["pairs"]["p1-2"]["quality"]["corners_rms_px"] = 10**400
    write(mine, content)
    with pytest.raises(CalibrationFileError, match=r"not a readable calibration \(1000"):
        accept_calibration(mine)


def bomb(says: int) -> bytes:
    """An .npz of one entry that unpacks to 8 MB of zeros and says so many bytes of itself."""
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(
        header, {"descr": "<f8", "fortran_order": False, "shape": (says // 8,)}
    )
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("placing_covariance.npy", header.getvalue() + bytes(8_000_000))
    return packed.getvalue()


@pytest.mark.parametrize(
    ("says", "refusal"), [(8_000_000, "unpacks to"), (1 << 42, "header that does not fit")]
)
def test_arrays_that_would_fill_the_memory_are_not_read(
    says: int, refusal: str, tmp_path: Path
) -> None:
    path = tmp_path / "arrays.npz"
    path.write_bytes(bomb(says))
    most = 1_000_000 if says == 8_000_000 else 1 << 30
    with pytest.raises(ValueError, match=refusal):
        read_npz(path, most)
    write_npz(path, a=np.zeros((2, 3)))
    assert read_npz(path)["a"].shape == (2, 3)


@given(st.data())
def test_damaged_bytes_raise_nothing_but_our_own_errors(
    stored_now: Path, data: st.DataObject
) -> None:
    folder = stored_now.with_name("damaged")
    folder.mkdir(exist_ok=True)
    name = data.draw(st.sampled_from(["calibration.json", "calibration.npz"]))
    damaged = bytearray((stored_now / name).read_bytes())
    for _ in range(data.draw(st.integers(1, 4))):
        start = data.draw(st.integers(0, len(damaged) - 1))
        damaged[start : start + data.draw(st.integers(0, 40))] = data.draw(st.binary(max_size=40))
    for file in ("calibration.json", "calibration.npz"):
        shutil.copy(stored_now / file, folder)
    (folder / name).write_bytes(damaged)
    with suppress(BodyscanError):
        load_calibration(folder, accept_changed=True)


def test_a_calibration_is_replaced_only_when_that_is_said(copy: Path, tmp_path: Path) -> None:
    before = (copy / "calibration.json").read_bytes()
    rig = tmp_path / "rig.yaml"  # is not even looked at
    for command in ("calibrate-rig", "import"):
        refused = run(command, rig, "--out", copy)
        assert isinstance(refused.exception, CalibrationFileError)
        assert "--overwrite" in refused.exception.remedy
        assert not isinstance(run(command, rig, "--overwrite").exception, CalibrationFileError)
    assert (copy / "calibration.json").read_bytes() == before


def test_one_that_is_replaced_stays_by_the_hash_that_scans_know(copy: Path) -> None:
    known, former = calibration_id(copy), load_calibration(copy)
    for name in ("report.html", "sigma-map.png", "corners.vnl", "mine.html"):
        (copy / name).write_text("of the former")
    kept = archive_previous(copy)
    save_calibration(replace(former, notes=("new",)), copy)
    assert kept == copy / "history" / known
    assert calibration_id(kept) == known
    assert (load_calibration(copy).notes, load_calibration(kept).notes) == (("new",), former.notes)
    for name in ("report.html", "sigma-map.png", "corners.vnl"):  # what was made of it goes with it
        assert (kept / name).read_text() == "of the former"
        assert not (copy / name).exists()
    assert (copy / "mine.html").exists()


def test_a_kill_while_it_is_replaced_leaves_one_of_the_two(
    copy: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    former = load_calibration(copy)
    new = replace(former, observed={})  # so that the arrays differ

    def killed(*_: Any) -> None:
        raise KeyboardInterrupt

    archive_previous(copy)
    monkeypatch.setattr("bodyscan.registration.storage.write_json", killed)
    with pytest.raises(KeyboardInterrupt):
        save_calibration(new, copy)
    assert sorted(load_calibration(copy).observed) == sorted(former.pairs)
    monkeypatch.undo()
    save_calibration(new, copy)
    assert load_calibration(copy).observed == {}
