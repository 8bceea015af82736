"""Errors of the operating system in plain words with path and remedy; paths made relative."""

from __future__ import annotations

import errno
import os
import re
import shutil
from pathlib import Path
from typing import Any

import pytest
from small_workspace import run, small_rig

from bodyscan.errors import BadInput, BodyscanError, FailedWork
from bodyscan.files.atomic import write_text
from bodyscan.files.messages import (
    make_paths_relative,
    require_writable,
    translate_failure,
    translate_os_error,
)

STORED = Path(__file__).parents[1] / "data" / "stored-0.1.0"


@pytest.mark.parametrize(
    ("number", "kind", "what"),
    [
        (errno.ENOSPC, FailedWork, "the disk is full"),
        (errno.EROFS, BadInput, "is not allowed here"),
        (errno.EACCES, BadInput, "is not allowed here"),
        (errno.ENOENT, BadInput, "No such file"),
        (errno.EIO, FailedWork, "error"),
    ],
)
def test_an_os_error_is_translated(number: int, kind: type[BodyscanError], what: str) -> None:
    error = translate_os_error(OSError(number, os.strerror(number), "some/where"))
    assert type(error) is kind
    assert error.where == "some/where"
    assert what in error.what
    assert error.remedy
    assert str(BadInput(f"'{'9' * 5000}' \x1b[31m")) == f"'{'9' * 199}... \\x1b[31m"
    assert str(BadInput("is long", where="a/" * 2000)) == f"{'a/' * 100}...{'a/' * 100}: is long"


def test_a_folder_need_not_exist_to_be_writable(tmp_path: Path) -> None:
    require_writable(tmp_path / "a" / "b")
    assert not list(tmp_path.iterdir())
    with pytest.raises(BodyscanError) as refused:
        require_writable(Path("/proc/results"))  # not even root can
    assert refused.value.where == "/proc/results"


@pytest.mark.parametrize(
    ("command", "how"),
    [
        ("scan day/anna --calibration rig --out day/anna", "is"),
        ("scan day/anna --calibration rig --out rig --overwrite", "is"),
        ("scan day/anna --calibration rig/calibration.json --out rig/new", "lies inside"),
        ("scan day/anna --calibration rig --empty day/empty --out day/empty/new", "lies inside"),
        ("scan day/../day/anna --calibration rig --out day", "contains"),
        ("scan link --calibration rig --out day/anna/new", "lies inside"),
        ("check-calibration day/anna --calibration rig --repair rig --overwrite", "is"),
        ("refine-rig day/anna --calibration rig --out day/anna", "is"),
        ("export-rig rig --out rig/for-colmap", "lies inside"),
        ("watch day --calibration rig --out day/out", "lies inside"),
        ("batch pipeline.yaml --scans day --calibration rig --out day", "contains"),
        ("batch pipeline.yaml --scans day --calibration rig --out rig", "is"),
        ("batch pipeline.yaml --scans day --calibration rig --out day/anna", "is"),
        ("calibrate-rig small.yaml --out captures/calibration", "is"),
        ("accept --spheres day/anna --calibration rig --out day/anna/new", "lies inside"),
    ],
)
def test_no_result_goes_where_images_or_a_calibration_are_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: str, how: str
) -> None:
    for folder in ("day/anna", "day/empty", "captures/calibration"):
        (tmp_path / folder).mkdir(parents=True)
    (tmp_path / "day/anna/lit.png").touch()
    (tmp_path / "link").symlink_to("day/anna")
    shutil.copytree(STORED / "calibration", tmp_path / "rig")
    (tmp_path / "pipeline.yaml").write_text("version: 1\nname: small\nkind: fuse\n")
    small_rig(tmp_path)
    before = sorted(tmp_path.rglob("*"))
    monkeypatch.chdir(tmp_path)
    refused = run(*command.split()).exception
    assert isinstance(refused, BadInput)
    assert re.match(rf"{how} [\w/.-]+, which is read", refused.what)
    assert refused.where == re.findall(r"--(?:out|repair) (\S+)", command)[0]
    assert sorted(tmp_path.rglob("*")) == before


def refuse(*_: Any, **__: Any) -> Any:
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def test_a_full_disk_is_found_before_the_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("bodyscan.files.messages.TemporaryFile", refuse)
    monkeypatch.setattr("bodyscan.fusion.storage.load_scan", None)  # any work would fail otherwise
    result = run("export", STORED / "scan", "--out", tmp_path / "out")
    assert isinstance(result.exception, FailedWork)
    assert result.exception.where == str(tmp_path / "out")


def test_a_disk_that_fills_up_is_reported_with_the_final_name_of_the_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("bodyscan.files.atomic.flush", refuse)
    result = run("export", STORED / "scan", "--out", tmp_path, "--format", "stl")
    assert isinstance(result.exception, FailedWork)
    assert result.exception.where == str(tmp_path / "body.stl")
    assert not list(tmp_path.iterdir())
    with pytest.raises(OSError, match=r"a\.txt"):
        write_text(tmp_path / "a.txt", "text")


def test_too_little_memory_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    def take_all(folder: Path) -> None:
        raise MemoryError

    monkeypatch.setattr("bodyscan.fusion.storage.load_scan", take_all)
    result = run("measure", STORED / "scan")
    assert isinstance(result.exception, FailedWork)
    assert "memory" in result.exception.what


@pytest.mark.parametrize(
    ("error", "expected"),
    [
        (OSError("libEGL.so.1: cannot open shared object file: No such file"), "libEGL.so.1"),
        (ImportError("libGL.so.1: cannot open shared object file"), "apt-get install"),
        (ModuleNotFoundError("No module named 'open3d'", name="open3d"), "pip install open3d"),
        (ImportError("_qhull.so: failed to map segment from shared object"), "not enough memory"),
        (RuntimeError("can't start new thread"), "not enough memory"),
        (OSError(errno.ENOMEM, "Cannot allocate memory"), "Cannot allocate memory"),
    ],
)
def test_what_the_system_lacks_is_a_sentence(error: Exception, expected: str) -> None:
    assert expected in str(translate_failure(error))
    assert translate_failure(RuntimeError("a mistake of ours")) is None


@pytest.mark.parametrize(
    ("text", "base", "below", "expected"),
    [
        ("/h/s/a/lit.png: gone; so is /h/s/b.png", "/h/s", ["/h/s/a"],
         "a/lit.png: gone; so is b.png"),
        ("/a/boards/b01/lit.png: is black", "/a/rig", ["/a/boards"],
         "../boards/b01/lit.png: is black"),
        ("data/x.png, a/y.png", "a", [], "data/x.png, y.png"),  # not the end of another path
        ("captures/b01/lit.png", ".", [], "captures/b01/lit.png"),
    ],
)  # fmt: skip
def test_paths_in_stored_messages_are_relative(
    text: str, base: str, below: list[str], expected: str
) -> None:
    assert make_paths_relative(text, Path(base), map(Path, below)) == expected
