"""Atomic, exact and repeatable files."""

from __future__ import annotations

import hashlib
import json
import math
import os
import time
import zipfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from small_workspace import run

from bodyscan.files.atomic import (
    atomic_replacement,
    format_json,
    hold_folder,
    write_bytes,
    write_json,
    write_npz,
)
from bodyscan.files.hashing import hash_content, hash_file, hash_files, list_files
from bodyscan.files.reading import read_npz

RIGS = Path(__file__).parents[2] / "rigs"


def test_a_failed_write_leaves_the_old_file_and_no_litter(tmp_path: Path) -> None:
    path = tmp_path / "mesh.ply"
    killed = tmp_path / ".mesh.4c1516627044.tmp.ply"
    write_bytes(killed, b"of a writer that was killed two hours ago")
    os.utime(killed, (time.time() - 7200.0,) * 2)
    write_bytes(path, b"old")

    def fail() -> None:
        with atomic_replacement(path) as temporary:
            assert temporary.suffix == ".ply"
            assert temporary.parent == path.parent
            temporary.write_bytes(b"half of the new")
            raise RuntimeError("power cut")

    with pytest.raises(RuntimeError):
        fail()
    with pytest.raises(FileNotFoundError), atomic_replacement(tmp_path / "x.bin"):
        pass  # writes nothing
    assert path.read_bytes() == b"old"
    assert os.listdir(tmp_path) == ["mesh.ply"]


@pytest.mark.parametrize(
    "command",
    [("calibrate-rig", RIGS / "three-pole-12.yaml"), ("scan", RIGS, "--calibration", RIGS.parent)],
)
def test_a_folder_of_results_is_written_by_one_command_and_swept(
    command: tuple[object, ...], tmp_path: Path
) -> None:
    folder = tmp_path / "result"
    with hold_folder(folder):
        refused = run(*command, "--out", folder)
        assert "another command is writing here" in str(refused.exception)
    assert not folder.exists()  # nothing was written
    folder.mkdir()
    for name in (".cloud.4c1516627044.tmp.ply", ".notes.tmp.ply", "cloud.ply"):
        (folder / name).touch()
    with hold_folder(folder):
        assert sorted(os.listdir(folder)) == [".notes.tmp.ply", "cloud.ply"]


def test_folders_are_created_and_the_umask_applies(tmp_path: Path) -> None:
    path = tmp_path / "a" / "b" / "c.bin"
    before = os.umask(0o027)
    try:
        write_bytes(path, b"x")
    finally:
        os.umask(before)
    assert path.stat().st_mode & 0o777 == 0o640


@given(st.lists(st.floats(allow_nan=False, allow_infinity=False)))
def test_json_keeps_every_bit_of_a_float(values: list[float]) -> None:
    back = json.loads(format_json({"values": np.array(values, dtype=np.float64)}))["values"]
    assert [v.hex() for v in back] == [v.hex() for v in values]


def test_json_is_sorted_and_indented_with_a_line_per_row_of_a_matrix() -> None:
    content = {"b": np.eye(2), "a": [{"n": np.int64(3)}], "c": {}, "d": [], "e": None, "f": "é"}
    text = format_json(content)
    expected = {"a": [{"n": 3}], "b": [[1, 0], [0, 1]], "c": {}, "d": [], "e": None, "f": "é"}
    assert json.loads(text) == expected
    assert text.startswith(
        '{\n  "a": [\n    {\n      "n": 3\n    }\n  ],\n  "b": [\n    [1.0, 0.0],\n'
    )


@pytest.mark.parametrize("value", [math.nan, math.inf, np.array([1.0, math.nan])])
def test_json_refuses_nan_and_infinity(tmp_path: Path, value: object) -> None:
    with pytest.raises(ValueError, match="not JSON compliant"):
        write_json(tmp_path / "x.json", {"value": value})
    assert os.listdir(tmp_path) == []


def test_npz_is_exact_and_its_bytes_do_not_depend_on_time_or_order(tmp_path: Path) -> None:
    points = np.random.default_rng(1).normal(size=(50, 3)).astype(np.float32)
    names = np.array(["p1-1", "p1-2"])
    write_npz(tmp_path / "a.npz", points=points, names=names, path=np.float64(np.nan))
    write_npz(tmp_path / "b.npz", path=np.float64(np.nan), names=names, points=points)
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()
    with zipfile.ZipFile(tmp_path / "a.npz") as archive:
        assert {entry.date_time for entry in archive.infolist()} == {(1980, 1, 1, 0, 0, 0)}
    with np.load(tmp_path / "a.npz", allow_pickle=False) as back:
        np.testing.assert_array_equal(back["points"], points)
        assert back["points"].dtype == np.float32
        assert back["names"].tolist() == names.tolist()
        assert np.isnan(back["path"])


def test_an_npz_is_read_or_refused_whatever_its_headers_say(tmp_path: Path) -> None:
    header = "{'descr': '<f8', 'fortran_order': False, 'shape': (1,), }"
    random = np.random.default_rng(3)
    junk = ["(", "'", "{", "[", "}", "\n", "None", "''", "-1,", "9" * 30, "'O'", "\x00"]
    refused = 0
    for at in range(len(header)):
        for text in random.choice(junk, 3):
            spoilt = header[:at] + text + header[at + int(random.integers(0, 9)) :]
            with zipfile.ZipFile(tmp_path / "a.npz", "w") as archive:
                magic = b"\x93NUMPY\x01\x00" + len(spoilt).to_bytes(2, "little")
                archive.writestr("a.npy", magic + spoilt.encode("latin1") + b"\x00" * 8)
            try:
                read_npz(tmp_path / "a.npz")
            except ValueError:
                refused += 1
    assert refused > 2 * len(header)


def test_npz_never_pickles(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="allow_pickle"):
        write_npz(tmp_path / "x.npz", things=np.array([{}], dtype=object))
    assert os.listdir(tmp_path) == []


def test_every_byte_of_a_large_file_is_hashed(tmp_path: Path) -> None:
    path, content = tmp_path / "large", bytearray(range(256)) * (3 << 12)
    path.write_bytes(content)
    whole = hash_file(path)
    assert whole == hashlib.sha256(content).hexdigest()
    content[-1] ^= 1
    path.write_bytes(content)
    assert hash_file(path) != whole


def test_the_hash_of_data_does_not_depend_on_the_order_of_keys() -> None:
    one = {"a": [1, 2], "b": {"c": None, "d": 0.5}}
    other = {"b": {"d": 0.5, "c": None}, "a": [1, 2]}
    assert hash_content(one) == hash_content(other)
    assert hash_content(one) != hash_content(one | {"a": [2, 1]})
    assert hash_content({}) == hashlib.sha256(b"{}").hexdigest()
    assert hash_content({"a": 1}) == hashlib.sha256(b'{"a":1}').hexdigest()
    with pytest.raises(ValueError, match="Out of range"):
        hash_content({"a": float("nan")})


def test_files_are_listed_in_a_fixed_order_and_hashed_by_content(tmp_path: Path) -> None:
    for name in ("b/2", "b/1", "a/3", "c"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(name, "utf-8")
    (tmp_path / "b" / "0").symlink_to(tmp_path / "a", target_is_directory=True)
    found = [path.relative_to(tmp_path).as_posix() for path in list_files(tmp_path)]
    assert found == ["c", "a/3", "b/0", "b/1", "b/2"]  # the link is named and not followed
    hashes = hash_files({"z": tmp_path / "c", "y": tmp_path / "a" / "3"})
    assert list(hashes) == ["y", "z"]
    assert hashes["z"] == hashlib.sha256(b"c").hexdigest()
