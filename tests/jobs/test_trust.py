"""`verify` finds any byte that changed; `forget` leaves nothing of a subject."""

from __future__ import annotations

import csv
import json
import shutil
from collections.abc import Callable
from pathlib import Path

import cheap_job
import pytest
from cheap_batch import jobs_of, run_cheap, write_scans

from bodyscan.errors import BadInput
from bodyscan.files.atomic import lock_file
from bodyscan.files.hashing import list_files
from bodyscan.jobs.forgetting import find_subject, forget_subject
from bodyscan.jobs.verification import verify


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    day = tmp_path_factory.mktemp("made")
    todo = dict.fromkeys(("m1", "m2", "e1"), "nothing")
    scans = write_scans(day / "scans", **todo, bad="raise")
    for name, subject in {"m1": "mallow", "m2": "mallow", "e1": "elder", "bad": "mallow"}.items():
        text = f"kind: scan\nsubject: {subject}\n"
        (scans / name / "captures.yaml").write_text(text)
    assert run_cheap(scans, day / "out").code == 1
    for subject in ("mallow", "elder"):
        (day / f"{subject}.obj").write_text("o")
        side = {"file": f"{subject}.obj", "subject": subject}
        (day / f"{subject}.obj.json").write_text(json.dumps(side))
    return day


@pytest.fixture
def day(made: Path, tmp_path: Path) -> Path:
    """A workspace: scans of two subjects, what a batch made of them, and an export elsewhere."""
    return shutil.copytree(made, tmp_path, dirs_exist_ok=True)


@pytest.mark.slow
def test_any_byte_that_changed_is_found(day: Path) -> None:
    kinds = cheap_job.kinds()
    clean = verify(day / "out", kinds)
    assert clean.faults == ()
    checked = [
        day / "scans" / "m1" / "image.txt",
        day / "out" / "m1" / "scan" / "0.bin",
        day / "out" / "m1" / "scan" / "stage.json",
        day / "out" / "m1" / "export" / "body.bin",
        day / "out" / "e1" / "manifest.json",
    ]
    assert clean.files > len(checked)
    for path in checked:
        content = path.read_bytes()
        for place in (0, len(content) // 2, len(content) - 1):
            path.write_bytes(content[:place] + bytes([content[place] ^ 1]) + content[place + 1 :])
            assert any(str(path) in fault for fault in verify(day / "out", kinds).faults), path
        path.write_bytes(content)
    assert verify(day / "out", kinds).faults == ()


def test_what_came_and_went_is_found(day: Path) -> None:
    kinds = cheap_job.kinds()
    (day / "out" / "m1" / "scan" / "0.bin").unlink()
    shutil.rmtree(day / "out" / "m2")
    (day / "scans" / "e1" / "image.txt").unlink()
    faults = "\n".join(verify(day / "out", kinds).faults)
    assert "0.bin: is gone" in faults
    assert "m2/manifest.json: is gone" in faults
    assert "e1/image.txt: is gone" in faults
    with pytest.raises(BadInput, match="holds no manifest"):
        verify(day / "scans")


def test_what_a_person_added_is_named_and_no_fault(day: Path) -> None:
    clean = verify(day / "out", cheap_job.kinds())
    added = day / "out" / "e1" / "export" / "more.bin"
    added.write_text("x")
    found = verify(day / "out", cheap_job.kinds())
    assert (found.files, found.faults, found.added) == (clean.files, (), (added,))


def test_forget_removes_a_subject_and_nothing_else(day: Path) -> None:
    (day / "scans" / "m1" / "link").symlink_to(day / "elder.obj")
    before = set(list_files(day))
    others = {path: path.read_bytes() for path in before if "e1" in path.parts}
    found = forget_subject("mallow", day)
    after = set(list_files(day))
    assert before - after == set(found.files)
    gone = {path.relative_to(day).parts[:2] for path in found.files}
    assert gone == {
        *(("scans", name) for name in ("m1", "m2", "bad")),
        *(("out", name) for name in ("m1", "m2", "bad")),
        ("mallow.obj",),
        ("mallow.obj.json",),
    }
    assert {path: path.read_bytes() for path in others} == others
    assert (day / "elder.obj").exists()
    assert not any("mallow" in path.read_text(errors="replace") for path in after)
    assert not (day / "out" / "m1").exists()
    with (day / "out" / "summary.csv").open(newline="") as stream:
        assert [row["job"] for row in csv.DictReader(stream)] == ["e1"]
    assert verify(day / "out", cheap_job.kinds()).faults == ()
    with pytest.raises(BadInput, match="holds nothing of subject 'mallow'"):
        forget_subject("mallow", day)


def test_what_was_written_elsewhere_and_into_others_results_goes_too(day: Path) -> None:
    notes = day / "notes"
    notes.mkdir()
    measured = {"schema": "bodyscan-measurements", "subject": "mallow"}
    (notes / "m.json").write_text(json.dumps(measured))
    (notes / "own.json").write_text('{"subject": "mallow", "question": "of another program"}')
    for place in (notes, day / "out" / "e1" / "scan"):  # elder, compared with mallow
        (place / "r.html").write_text("r")
        side = '{"subject": "elder", "compared_with": "mallow"}'
        (place / "r.html.json").write_text(side)
    (notes / "copied.csv").write_text("subject,when,x\nmallow,now,1\nelder,now,2\n")
    (notes / "own.csv").write_text("subject,street\nmallow,High Street\n")  # another program's
    forgotten = forget_subject("mallow", day)
    found = set(forgotten.files)
    assert (notes / "copied.csv").read_text() == "subject,when,x\nelder,now,2\n"
    assert notes / "copied.csv" in forgotten.rows
    assert {notes / "m.json", notes / "r.html", notes / "r.html.json"} <= found
    assert day / "out" / "e1" / "scan" / "r.html" in found
    assert {path.name for path in notes.iterdir()} == {"copied.csv", "own.csv", "own.json"}
    assert (day / "out" / "e1" / "scan" / "0.bin").exists()


def test_bodies_and_images_that_name_nobody_are_listed_for_the_operator(day: Path) -> None:
    images = ("shots/a/lit.png", "shots/b/lit.png", "board/c/lit.png")
    for name in ("half/mesh.ply", "page/r.html", *images):
        (day / name).parent.mkdir(parents=True)
        (day / name).write_text("x")
    (day / "board" / "captures.yaml").write_text("kind: calibration\n")
    found = find_subject("mallow", day)
    assert found.unnamed == {day / "half": 1, day / "page": 1, day / "shots": 2}
    assert not set(found.unnamed) & {path.parent for path in found.files}
    with pytest.raises(BadInput, match="holds nothing"):
        forget_subject("m1", day)  # a folder's name


def test_a_scan_without_captures_file_is_its_folders_name(
    make_scans: Callable[..., Path], tmp_path: Path
) -> None:
    scans = make_scans(s4="nothing", s5="nothing")
    assert run_cheap(scans, tmp_path / "out").code == 0
    forget_subject("s4", tmp_path)
    left = {path.relative_to(tmp_path).parts[:2] for path in list_files(tmp_path)}
    assert {("scans", "s5"), ("out", "s5")} <= left
    assert not left & {("scans", "s4"), ("out", "s4")}


def test_a_forgetting_that_was_cut_short_can_be_taken_up(day: Path) -> None:
    files = find_subject("mallow", day).files
    for path in files[: len(files) // 2]:
        path.unlink()
    rest = forget_subject("mallow", day)
    assert set(rest.files) == set(files[len(files) // 2 :])
    assert not any("mallow" in path.read_text(errors="replace") for path in list_files(day))


def test_a_batch_at_work_is_not_disturbed(day: Path) -> None:
    with (
        lock_file(day / "out" / "batch.lock", wait=False),
        pytest.raises(BadInput, match="is running here"),
    ):
        forget_subject("mallow", day)
    assert len(jobs_of(day / "scans", day / "out")) == 4
