"""The list of slow files is kept up when files are renamed."""

from pathlib import Path

from slow_files import SLOW


def test_every_slow_file_is_there() -> None:
    gone = [name for name in SLOW if not (Path(__file__).parent / name).is_file()]
    assert gone == []
