"""What the operating system refuses is a line that says where and what to do."""

from __future__ import annotations

import errno
import os
from pathlib import Path
from typing import Any

import pytest
from small_workspace import run

from bodyscan.errors import BadInput, BodyscanError, FailedWork
from bodyscan.files import os_errors
from bodyscan.files.atomic import write_text
from bodyscan.files.os_errors import in_words, require_writable

STORED = Path(__file__).parents[1] / "data" / "stored-0.1.0"


@pytest.mark.parametrize(
    ("number", "kind", "said"),
    [
        (errno.ENOSPC, FailedWork, "the disk is full"),
        (errno.EROFS, BadInput, "is not allowed here"),
        (errno.EACCES, BadInput, "is not allowed here"),
        (errno.ENOENT, BadInput, "No such file"),
        (errno.EIO, FailedWork, "error"),
    ],
)
def test_each_kind_has_its_words(number: int, kind: type[BodyscanError], said: str) -> None:
    told = in_words(OSError(number, os.strerror(number), "some/where"))
    assert type(told) is kind
    assert told.where == "some/where"
    assert said in told.what
    assert told.remedy


def test_a_folder_that_is_not_there_yet_is_none_the_worse(tmp_path: Path) -> None:
    require_writable(tmp_path / "a" / "b")
    assert not list(tmp_path.iterdir())


def test_a_place_where_nothing_can_be_written_is_refused() -> None:
    with pytest.raises(BodyscanError) as refused:
        require_writable(Path("/proc/results"))  # not even root can
    assert refused.value.where == "/proc/results"


def refuse(*_: Any, **__: Any) -> Any:
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def test_room_is_looked_for_before_the_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os_errors, "TemporaryFile", refuse)
    monkeypatch.setattr("bodyscan.fusion.storage.load_scan", None)  # any work would fail otherwise
    result = run("export", STORED / "scan", "--out", tmp_path / "out")
    assert isinstance(result.exception, FailedWork)
    assert result.exception.where == str(tmp_path / "out")


def test_a_disk_that_fills_up_meanwhile_is_told_with_the_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("bodyscan.files.atomic.flush", refuse)
    result = run("export", STORED / "scan", "--out", tmp_path, "--format", "stl")
    assert isinstance(result.exception, FailedWork)
    assert result.exception.where == str(tmp_path / "body.stl")
    assert not list(tmp_path.iterdir())


def test_the_file_is_named_as_people_know_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("bodyscan.files.atomic.flush", refuse)
    with pytest.raises(OSError, match=r"a\.txt"):
        write_text(tmp_path / "a.txt", "text")


def test_memory_that_does_not_suffice_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    def take_all(folder: Path) -> None:
        raise MemoryError

    monkeypatch.setattr("bodyscan.fusion.storage.load_scan", take_all)
    result = run("measure", STORED / "scan")
    assert isinstance(result.exception, FailedWork)
    assert "memory" in result.exception.what
