"""Whatever a rig file, captures.yaml or image holds, nothing but our own errors comes out.

BODYSCAN_FUZZ=10000 tries so many of each instead of a few.
"""

from __future__ import annotations

import os
import shutil
from contextlib import suppress
from copy import deepcopy
from pathlib import Path
from typing import Any

import pytest
import yaml
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from small_captures import write_small_captures

from bodyscan.captures.check import check, format_report
from bodyscan.captures.folder import open_captures
from bodyscan.captures.images import read_sequence
from bodyscan.errors import BodyscanError
from bodyscan.rig.rig import load_rig

CAPTURES = b"version: 1\nkind: calibration\nwhen: 2026-11-22T10:00:00\nshots:\n- name: b1\n"
TRIES = int(os.environ.get("BODYSCAN_FUZZ", "25"))
WORDS = b"- |: |{|[|&a |*a|<<: |null|-1|.nan|1e999|\n  ".split(b"|")
JUNK = st.sampled_from([None, "", "p1", -1, 0, 1e9, [], {}, [None], {"pair": "nobody"}, True])


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


def places(tree: Any) -> list[tuple[Any, Any]]:
    """Every (container, key) of a YAML document."""
    if not isinstance(tree, dict | list):
        return []
    keys = list(tree) if isinstance(tree, dict) else list(range(len(tree)))
    deeper = [place for key in keys for place in places(tree[key])]
    return [*((tree, key) for key in keys), *deeper]


@given(data=st.data())
@settings(max_examples=100)
def test_whatever_is_changed_is_checked_or_refused(whole: Path, data: st.DataObject) -> None:
    rig = yaml.safe_load((whole / "rig.yaml").read_text("utf-8"))
    for _ in range(data.draw(st.integers(1, 3), "changes")):
        if not places(rig):
            break
        container, key = data.draw(st.sampled_from(places(rig)))
        if data.draw(st.booleans(), "taken out"):
            del container[key]
        else:
            container[key] = deepcopy(data.draw(JUNK, "instead"))
    changed = whole / "changed.yaml"
    changed.write_text(yaml.safe_dump(rig, sort_keys=False), "utf-8")
    with suppress(BodyscanError):
        check(changed)
