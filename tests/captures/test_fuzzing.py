"""Whatever a rig file, captures.yaml or image holds, nothing but our own errors comes out.

BODYSCAN_FUZZ=10000 tries so many of each instead of a few.
"""

from __future__ import annotations

import os
import shutil
from contextlib import suppress
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from small_captures import write_small_captures

from bodyscan.captures.check import check, format_report
from bodyscan.captures.folder import open_captures
from bodyscan.captures.images import read_sequence
from bodyscan.errors import BodyscanError
from bodyscan.rig.rig_file import load_rig

CAPTURES = b"version: 1\nkind: calibration\nwhen: 2026-11-22T10:00:00\nshots:\n- name: b1\n"
TRIES = int(os.environ.get("BODYSCAN_FUZZ", "25"))
WORDS = [
    b"- ",
    b": ",
    b"{",
    b"[",
    b"&a ",
    b"*a",
    b"<<: ",
    b"null",
    b"-1",
    b".nan",
    b"1e999",
    b"\n  ",
]


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("fuzzed") / "small"
    write_small_captures(folder, shots=1)
    return folder


@settings(max_examples=TRIES, deadline=None, suppress_health_check=list(HealthCheck))
@given(st.data())
def test_nothing_but_our_own_errors(whole: Path, data: st.DataObject) -> None:
    folder = whole.with_name("damaged")
    shutil.rmtree(folder, ignore_errors=True)
    shutil.copytree(whole, folder)
    (folder / "captures" / "captures.yaml").write_bytes(CAPTURES)
    name = data.draw(
        st.sampled_from(["rig.yaml", "captures/captures.yaml", "captures/b1/p1/bit00.png"])
    )
    damaged = bytearray((folder / name).read_bytes())
    for _ in range(data.draw(st.integers(1, 4))):
        start = data.draw(st.integers(0, len(damaged)))
        put = data.draw(st.binary(max_size=12) | st.sampled_from(WORDS))
        damaged[start : start + data.draw(st.integers(0, 12))] = put
    (folder / name).write_bytes(damaged)
    rig_path = folder / "rig.yaml"
    with suppress(BodyscanError):
        format_report(check(rig_path))
    with suppress(BodyscanError):
        rig = load_rig(rig_path)
        for sequence in open_captures(rig, rig_path).sequences:
            with suppress(BodyscanError):
                read_sequence(sequence, rig.pair(sequence.pair).camera)


def test_the_captures_that_are_damaged_are_sound(whole: Path) -> None:
    assert check(whole / "rig.yaml").bad_images == ()
