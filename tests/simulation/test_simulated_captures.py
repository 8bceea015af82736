"""Whole simulated data sets, read back by the package's own readers."""

from __future__ import annotations

import hashlib
import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import open3d as o3d
import pytest
import yaml

from bodyscan.captures.folder import open_scan
from bodyscan.errors import BadInput
from bodyscan.rig.rig import load_rig
from bodyscan.simulation import SimulationSettings, simulate
from bodyscan.simulation.body import load_subject
from bodyscan.simulation.settings import Person

PROJECT = Path(__file__).parents[2]
SUBJECT = PROJECT / "data" / "subjects" / "woman_average.ply"
SMALL = replace(SimulationSettings(), person=Person(subdivisions=0))


def hashes(folder: Path) -> dict[str, str]:
    return {
        str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


@pytest.fixture(scope="module")
def simulated(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("simulated")
    rig = PROJECT / "rigs" / "three-pole-12.yaml"
    simulate(rig, out, subject=SUBJECT, scale=0.1, settings=SMALL, board_shots=3)
    return out


def test_files_are_those_that_captures_yaml_lists(simulated: Path) -> None:
    bits = 6  # of 64 stripes
    patterns = [f"bit{k:02d}{end}" for k in range(bits) for end in ("", "-inverse")]
    for kind in ("calibration", "person"):
        folder = simulated / "captures" / kind
        listed = yaml.safe_load((folder / "captures.yaml").read_text())
        expected = {"captures.yaml"}
        for shot in listed["shots"]:
            for pair in shot.get("lit", []):
                expected.add(f"{shot['name']}/{pair}/lit.png")
            for pair in shot.get("stripes", []):
                names = ["lit", "dark", *patterns]
                expected |= {f"{shot['name']}/{pair}/{name}.png" for name in names}
        assert set(hashes(folder)) == expected
    assert listed["kind"] == "scan"
    assert listed["subject"] == "sim-woman-average"
    assert listed["simulated"] is True


def test_the_rig_file_is_the_given_one_scaled(simulated: Path) -> None:
    rig, given = load_rig(simulated / "rig.yaml"), load_rig(PROJECT / "rigs" / "three-pole-12.yaml")
    assert (rig.pairs[0].camera.width, rig.pairs[0].camera.height) == (128, 102)
    assert rig.pairs[0].projector is not None
    assert rig.pairs[0].projector.stripes == 64
    assert rig.calibration[0].folder == "captures/calibration"
    assert rig.boards == given.boards
    assert rig.rig_frame == given.rig_frame
    assert [pair.nominal for pair in rig.pairs] == [pair.nominal for pair in given.pairs]


def test_captures_say_when_frames_were_taken(simulated: Path) -> None:
    rig = load_rig(simulated / "rig.yaml")
    scan = open_scan(rig, simulated / "captures" / "person")
    starts = []
    for pair in rig.pairs:
        times = scan.frame_ms("s01", pair.name)
        assert times is not None
        assert np.diff(list(times.values())) == pytest.approx(1000 / 120)
        starts.append(times["lit"] - 1000 / 240)
    # Lit, dark, six bits and their inverses of one pair after those of the other.
    assert starts == pytest.approx(14 * 1000 / 120 * np.arange(12))


def test_images_have_the_size_of_the_rig_file_and_show_something(simulated: Path) -> None:
    for pair in load_rig(simulated / "rig.yaml").pairs:
        path = simulated / "captures" / "person" / "s01" / pair.name / "lit.png"
        image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        assert image.shape == (102, 128)
        assert image.dtype == np.uint8
        skin = image[image > 90]
        assert skin.size > 0.02 * image.size
        assert 110 < np.median(skin) < 190
        assert 215 < np.percentile(image, 99.9) < 240
        assert np.mean(image == 255) < 1e-3


def test_the_truth_describes_every_pair_and_shot(simulated: Path) -> None:
    truth = json.loads((simulated / "truth" / "truth.json").read_text())
    rig = load_rig(simulated / "rig.yaml")
    assert set(truth["pairs"]) == {pair.name for pair in rig.pairs}
    listed = yaml.safe_load((simulated / "captures" / "calibration" / "captures.yaml").read_text())
    assert set(truth["shots"]) == {shot["name"] for shot in listed["shots"]}
    assert truth["keys"]
    one = truth["pairs"]["p1-1"]
    planes = np.array(one["boundary_planes"])
    assert planes.shape == (65, 4)
    assert np.linalg.norm(planes[:, :3], axis=1) == pytest.approx(np.ones(65))
    pose = np.array(one["rig_from_camera"])
    assert np.linalg.norm(pose[:3, 3] - [650, 1126, 700]) < 60
    assert np.array(one["swayed_from_still"]) == pytest.approx(np.eye(4))


def test_the_true_surface_is_the_subject_in_the_rig_frame(simulated: Path) -> None:
    mesh = o3d.io.read_triangle_mesh(str(simulated / "truth" / "subject.ply"))
    low, high = mesh.get_min_bound(), mesh.get_max_bound()
    assert (low[2], high[2]) == pytest.approx((0.0, 1633.0), abs=1.0)
    assert low[:2] == pytest.approx(-high[:2], abs=1e-3)
    vertices = np.asarray(mesh.vertices)
    nose = vertices[vertices[:, 2] > 1450]
    toes = vertices[vertices[:, 2] < 60]
    assert nose[:, 0].max() > 1.2 * -nose[:, 0].min()  # the face is in front, towards +x
    assert toes[:, 0].max() > 0
    assert mesh.is_edge_manifold(allow_boundary_edges=False)


def test_the_same_arguments_give_the_same_bytes_in_any_order_of_work(tmp_path: Path) -> None:
    one, twelve = (PROJECT / "rigs" / f"{name}.yaml" for name in ("one-pair", "three-pole-12"))
    for workers in (1, 3):
        out = tmp_path / str(workers)
        simulate(one, out / "one", scale=0.1, board_shots=2, workers=workers)
        simulate(
            twelve, out / "twelve", scale=0.05, board_shots=2, workers=workers, settings=SMALL,
        )  # fmt: skip
    assert hashes(tmp_path / "1") == hashes(tmp_path / "3")
    simulate(one, tmp_path / "other", scale=0.1, board_shots=2, seed=1)
    first, other = hashes(tmp_path / "1" / "one"), hashes(tmp_path / "other")
    assert first["rig.yaml"] == other["rig.yaml"]
    assert (
        first["captures/calibration/b01/pair/lit.png"]
        != (other["captures/calibration/b01/pair/lit.png"])
    )


def test_names_of_frames_and_files_are_the_rig_files_own(tmp_path: Path) -> None:
    text = (PROJECT / "rigs" / "one-pair.yaml").read_text()
    text = text.replace('"{shot}/{pair}/{frame}.png"', '"{shot}_{frame}.png"')
    text += '\nframes: {lit: white, dark: null, pattern: "p{bit}", inverse: "n{bit}"}\n'
    (tmp_path / "rig.yaml").write_text(text)
    told: list[tuple[int, int]] = []
    simulate(
        tmp_path / "rig.yaml", tmp_path / "out", scale=0.1, board_shots=1,
        progress=lambda stage, done, total: told.append((done, total)),
    )  # fmt: skip
    assert told == [(0, 1), (1, 1)]
    folder = tmp_path / "out" / "captures" / "calibration"
    names = {path.name for path in folder.iterdir()} - {"captures.yaml"}
    bits = [f"b01_{sign}{k}.png" for k in range(5) for sign in "pn"]  # 25 stripes
    assert names == {"b01_white.png", *bits}


def test_a_subject_that_is_no_mesh_is_refused(tmp_path: Path) -> None:
    with pytest.raises(BadInput, match="no surface can be read here"):
        load_subject(tmp_path / "none.ply", Person(), np.random.default_rng(0))


def test_a_camera_without_projector_takes_lit_images_by_a_lamp(tmp_path: Path) -> None:
    text = (PROJECT / "rigs" / "one-pair.yaml").read_text()
    lines = [line for line in text.splitlines() if "projector" not in line]
    (tmp_path / "rig.yaml").write_text("\n".join(lines) + "\n")
    simulate(tmp_path / "rig.yaml", tmp_path / "out", scale=0.25, board_shots=2)
    folder = tmp_path / "out" / "captures" / "calibration"
    shots = yaml.safe_load((folder / "captures.yaml").read_text())["shots"]
    assert [shot["lit"] for shot in shots] == [["pair"], ["pair"]]
    assert {path.name for path in folder.rglob("*.png")} == {"lit.png"}
    image = cv2.imread(str(folder / "b01" / "pair" / "lit.png"), cv2.IMREAD_GRAYSCALE)
    assert np.mean(image > 100) > 0.1  # the board's white, brightly lit
