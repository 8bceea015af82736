"""Pipeline files: bodyscan's own, wrong ones, one-off changes; how cores and memory are shared out."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml

from bodyscan.errors import BadInput
from bodyscan.jobs.batch import allocate
from bodyscan.jobs.pipeline import SECTIONS, Pipeline, load_pipeline
from bodyscan.settings import AlignmentSettings, Resources, ScanSettings

PIPELINES = sorted((Path(__file__).parents[2] / "pipelines").glob("*.yaml"))
FUSE = next(path for path in PIPELINES if path.stem == "fuse")


@pytest.mark.parametrize("path", PIPELINES, ids=lambda path: path.stem)
def test_every_file_names_every_parameter_with_a_comment(path: Path) -> None:
    pipeline = load_pipeline(path)
    assert pipeline.name == path.stem
    written = yaml.safe_load(path.read_text())
    for name in ("resources", *SECTIONS[pipeline.kind]):
        assert set(written[name]) == set(type(getattr(pipeline, name)).model_fields)
    for line in path.read_text().splitlines():
        if line.startswith("  ") and ":" in line:
            assert "#" in line, line


def test_the_defaults_are_those_of_the_commands() -> None:
    """A batch fuses as `bodyscan scan` does, and fuse.yaml says the same as no word at all."""
    assert Pipeline(name="fuse", kind="fuse").scan == ScanSettings()
    assert load_pipeline(FUSE) == Pipeline(name="fuse", kind="fuse")


def test_changes_are_applied() -> None:
    changed = load_pipeline(
        FUSE, ["fusion.points=2000", "export.formats=glb", "export.deface=true"]
    )
    assert changed.fusion.points == 2000
    assert changed.export.formats == ("glb",)
    assert changed.export.deface
    assert changed.alignment == load_pipeline(FUSE).alignment


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ("fusion.points=many", '--set fusion.points: must be a whole number (got "many")'),
        ("fusion.points=10", "must be 1000 or more"),
        ("fusion.pionts=5000", "is not a key known here"),
        (
            "export.formats=ply,obi",
            "formats[1]: must be 'glb', 'obj', 'ply' or 'stl' (did you mean 'obj'",
        ),
        ("nonsense", "is not a change"),
        ("fusion.points.x=1", "is a value, not a mapping"),
        ("rig_export.formats=colmap", "is for another kind"),
    ],
)
def test_wrong_changes_are_named(change: str, said: str) -> None:
    with pytest.raises(BadInput) as caught:
        load_pipeline(FUSE, [change])
    assert said in str(caught.value)


def test_wrong_files_are_told_by_line(tmp_path: Path) -> None:
    path = tmp_path / "p.yaml"
    path.write_text("name: x\nkind: fuse\nfusion:\n  points: -1\n  colour: red\n")
    with pytest.raises(BadInput) as caught:
        load_pipeline(path)
    assert f"{path}:4:11: fusion.points: must be 1000 or more" in str(caught.value)
    assert f"{path}:5:3: fusion.colour: is not a key known here" in str(caught.value)


def test_settings_of_earlier_releases_keep_their_meaning() -> None:
    old = {"least_reach_mm": 2.0, "fewest": 40, "least_sway": 0.2, "most_sway": 3.0}
    new = {"min_reach_mm": 2.0, "min_matches": 40, "min_sway": 0.2, "max_sway": 3.0}
    validate = AlignmentSettings.model_validate
    assert validate(old) == validate(new) != AlignmentSettings()


def test_matches_grow_with_the_pairs_and_not_with_their_square() -> None:
    assert AlignmentSettings().widen_spacing(16) == AlignmentSettings()
    wide = AlignmentSettings().widen_spacing(64)
    assert (wide.spacing_mm, wide.correlated) == (6.0, 1.25)


NEEDS = Resources(threads=2, memory_mb=4000)


@pytest.mark.parametrize(
    ("jobs", "workers", "cores_", "memory_mb", "wanted"),
    [
        (40, None, 16, 100_000, (8, 2)),  # by cores
        (40, None, 16, 13_000, (3, 2)),  # by memory
        (40, None, 1, 2_000, (1, 1)),  # there is always one
        (3, None, 16, 100_000, (3, 2)),  # no more than jobs
        (40, 16, 16, 100_000, (16, 1)),  # as asked for, with fewer threads
        (40, 16, 16, 13_000, (3, 2)),  # but never more memory than there is
        (40, 1, 16, 100_000, (1, 2)),
    ],
)
def test_shares(
    jobs: int, workers: int | None, cores_: int, memory_mb: int, wanted: tuple[int, int]
) -> None:
    shares = allocate(NEEDS, jobs, workers, cores_, memory_mb)
    assert (shares.workers, shares.threads) == wanted
