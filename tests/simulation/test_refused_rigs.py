"""Captures that the simulator cannot make are refused, with the reason, before anything is written."""

from __future__ import annotations

from pathlib import Path

import pytest
from small_captures import RIG, write

from bodyscan.errors import BadInput
from bodyscan.simulation.simulate import simulate


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("stripes: 12,", "stripes: 12, crossing: {stripes: 9},", "projects stripes one way only"),
        ("version: 1", "version: 1\nframes: {board: room}", "looks for boards there"),
        (
            "version: 1",
            'version: 1\nfiles: "{shot}/{pair}/*_{frame}.png"',
            "cannot tell what `\\*`",
        ),
    ],
)
def test_captures_that_it_cannot_make_are_refused(
    tmp_path: Path, old: str, new: str, message: str
) -> None:
    rig = write(tmp_path / "rig.yaml", RIG.replace(old, new, 1))
    with pytest.raises(BadInput, match=message) as caught:
        simulate(rig, tmp_path / "made")
    assert caught.value.where == "rig small"
    assert not (tmp_path / "made").exists()
