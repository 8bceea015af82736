"""No folder's name gets into what is kept: the same work elsewhere gives the same bytes."""

from __future__ import annotations

from pathlib import Path

from small_workspace import run

from bodyscan.errors import CaptureError, ScanFailed

STORED = Path(__file__).parents[1] / "data" / "stored-0.1.0" / "calibration"
PAIRS = ("p1-2", "p1-3", "p2-2", "p2-3")


def failed_scan(folder: Path) -> bytes:
    """scan.json of captures whose images are all damaged or missing."""
    for pair in PAIRS:
        image = folder / "captures" / "person" / pair / "bit00.png"
        image.parent.mkdir(parents=True)
        image.write_bytes(b"no image")
    result = run("scan", folder / "captures", "--calibration", STORED, "--out", folder / "made")
    assert isinstance(result.exception, ScanFailed)
    return (folder / "made" / "scan.json").read_bytes()


def test_a_scan_of_damaged_images_is_told_by_their_names_alone(tmp_path: Path) -> None:
    kept = failed_scan(tmp_path / "anna.miller")
    assert b"p2-3: person/p1-2/lit.png (pair p1-2" in kept  # alike in four pairs: said once
    assert kept.count(b"Copy it again from where it was taken") <= 1  # of four pairs
    assert b"anna" not in kept
    assert str(tmp_path).encode() not in kept
    assert failed_scan(tmp_path / "b" / "elsewhere") == kept


def test_links_out_of_the_folder_are_followed_when_that_is_said(tmp_path: Path) -> None:
    (tmp_path / "all.png").write_bytes(b"no image")
    for pair in PAIRS:
        image = tmp_path / "captures" / "person" / pair / "bit00.png"
        image.parent.mkdir(parents=True)
        image.symlink_to(tmp_path / "all.png")
    command = ("scan", tmp_path / "captures", "--calibration", STORED)
    refused = run(*command).exception
    assert isinstance(refused, CaptureError)
    assert "--follow-links" in refused.remedy
    assert isinstance(run(*command, "--follow-links").exception, ScanFailed)  # the images were read
