"""A rig file with anything taken out of it or put into it is checked or refused, never a traceback."""

from __future__ import annotations

from contextlib import suppress
from copy import deepcopy
from pathlib import Path
from typing import Any

import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from small_captures import write_small_captures

from bodyscan.captures.check import check
from bodyscan.errors import BodyscanError

JUNK = st.sampled_from([None, "", "p1", -1, 0, 1e9, [], {}, [None], {"pair": "nobody"}, True])


def places(tree: Any) -> list[tuple[Any, Any]]:
    """Every (container, key) of a YAML document."""
    if not isinstance(tree, dict | list):
        return []
    keys = list(tree) if isinstance(tree, dict) else list(range(len(tree)))
    deeper = [place for key in keys for place in places(tree[key])]
    return [*((tree, key) for key in keys), *deeper]


@pytest.fixture(scope="module")
def rig_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_small_captures(tmp_path_factory.mktemp("captures"))


@given(data=st.data())
@settings(max_examples=100)
def test_whatever_is_changed_is_checked_or_refused(rig_file: Path, data: st.DataObject) -> None:
    rig = yaml.safe_load(rig_file.read_text("utf-8"))
    for _ in range(data.draw(st.integers(1, 3), "changes")):
        if not places(rig):
            break
        container, key = data.draw(st.sampled_from(places(rig)))
        if data.draw(st.booleans(), "taken out"):
            del container[key]
        else:
            container[key] = deepcopy(data.draw(JUNK, "instead"))
    changed = rig_file.with_name("changed.yaml")
    changed.write_text(yaml.safe_dump(rig, sort_keys=False), "utf-8")
    with suppress(BodyscanError):
        check(changed)
