"""Meshes of other programs are read as they are meant, or refused by vertex, face or unit."""

from __future__ import annotations

from contextlib import nullcontext
from functools import partial
from pathlib import Path

import numpy as np
import open3d as o3d
import pytest
from small_bodies import ball
from trimesh import Trimesh

from bodyscan.arrays import Array, Indices
from bodyscan.errors import BadInput
from bodyscan.mesh.surface_file import read_surface as read_of_size
from bodyscan.mesh.topology import compute_signed_volume

VERTICES, FACES = ball().vertices, ball().faces
read_surface = partial(read_of_size, unit="millimetres", sizes_mm=(1.0, 100.0, 1e6))


def write(folder: Path, vertices: Array, faces: Indices) -> Path:
    mesh = o3d.geometry.TriangleMesh(
        o3d.utility.Vector3dVector(vertices), o3d.utility.Vector3iVector(faces.astype(np.int32))
    )
    o3d.io.write_triangle_mesh(str(folder / "made.ply"), mesh)
    return folder / "made.ply"


def test_a_sound_mesh_is_read_as_it_is(tmp_path: Path) -> None:
    read = read_surface(write(tmp_path, VERTICES, FACES))
    np.testing.assert_array_equal(read.value[0], VERTICES)
    np.testing.assert_array_equal(read.value[1], FACES)
    assert "taken as millimetres, z up: " in read.notes[0]
    some = np.where(np.arange(len(FACES))[:, None] == 7, FACES[:, ::-1], FACES)
    assert ": 4 faces, such as " in read_surface(write(tmp_path, VERTICES, some)).notes[0]
    data = (path := write(tmp_path, VERTICES, FACES)).read_bytes()
    path.write_bytes(data[:-13] + b"\4" + data[-12:] + data[-12:-8])  # a last face of four corners
    assert abs(len(read_surface(path).value[1]) - len(FACES)) <= 1


@pytest.mark.parametrize(
    ("vertices", "faces", "said"),
    [
        (VERTICES + 1e4, FACES[:, ::-1], "faces pointed inwards"),
        (VERTICES, FACES[1:, ::-1], "faces pointed inwards"),
        (np.vstack([VERTICES, [[9e3, 0, 0], [0, 0, -9e3]]]), FACES, "2 unreferenced vertices"),
        (VERTICES, np.vstack([FACES, [[4, 4, 5]]]), f"twice (the first is {len(FACES)})"),
        (VERTICES[FACES].reshape(-1, 3), np.arange(FACES.size).reshape(-1, 3)[:, ::-1], "merged"),
    ],
)
def test_what_can_mean_one_thing_is_mended_and_said(
    vertices: Array, faces: Indices, said: str, tmp_path: Path
) -> None:
    path = write(tmp_path, vertices, faces)
    read = read_surface(path)
    assert len(read.value[0]) == len(VERTICES)
    assert 0 <= len(FACES) - len(read.value[1]) <= 1
    assert compute_signed_volume(*read.value) == pytest.approx(
        compute_signed_volume(VERTICES, FACES), rel=1e-2
    )
    assert any(said in note for note in read.notes)
    assert all(note.startswith(str(path)) for note in read.notes)


def test_what_is_no_mesh_is_refused(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    unknown, wrong = VERTICES.copy(), FACES.copy()
    unknown[7, 1], wrong[5, 2] = np.nan, 99_999
    with pytest.raises(BadInput, match="vertex 7 "):
        read_surface(write(tmp_path, unknown, FACES))
    with pytest.raises(BadInput, match="face 5 names vertex 99999"):
        read_surface(write(tmp_path, VERTICES, wrong))
    damaged = {
        "quad.obj": "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nf 1 2 3 99999999\n",
        "cloud.ply": "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\nx\n",
        "body.glb": "glTF" + 100 * "x",
        "body.fbx": "",
    }
    for name, text in damaged.items():
        (tmp_path / name).write_text(text)
        with pytest.raises(BadInput, match="no surface can be read"):
            read_surface(tmp_path / name)
        assert not capfd.readouterr().err


@pytest.mark.parametrize("suffix", ["obj", "stl", "glb", "off", "ply"])
def test_the_formats_of_other_programs_are_read(suffix: str, tmp_path: Path) -> None:
    Trimesh(VERTICES, FACES, process=False).export(path := tmp_path / f"body.{suffix}")
    vertices, faces = read_surface(path).value
    assert len(vertices) == len(VERTICES)
    assert compute_signed_volume(vertices, faces) == pytest.approx(
        compute_signed_volume(VERTICES, FACES), rel=1e-5
    )


@pytest.mark.parametrize(
    ("size", "said"),
    [
        ((0.5, 0.3, 1.7), None),
        ((1.8, 0.3, 1.7), None),  # arms held out
        ((500, 300, 1700), "in millimetres, multiply its coordinates by 0.001"),
        ((50, 30, 170), "in centimetres, multiply its coordinates by 0.01"),
        ((20, 12, 67), "in inches, multiply its coordinates by 0.0254"),
        ((0.0005, 0.0003, 0.0017), "give a surface"),
        ((0.5, 1.7, 0.3), "does not extend farthest along z"),
    ],
)
def test_a_person_in_another_unit_or_who_lies_is_refused(
    size: tuple[float, float, float], said: str | None, tmp_path: Path
) -> None:
    path = write(tmp_path, VERTICES / np.ptp(VERTICES, axis=0) * size, FACES)
    with pytest.raises(BadInput, match=said) if said else nullcontext():
        read_of_size(path, "metres")


def test_who_stands_on_the_head_or_lies_on_an_arm_is_refused(tmp_path: Path) -> None:
    centres = [[-200.0, 0.0, 0.0], [200.0, 0.0, 0.0], [0.0, 0.0, 600.0]]  # two feet and a head
    vertices = np.concatenate([VERTICES + centre for centre in np.array(centres)])
    faces = np.concatenate([FACES + k * len(VERTICES) for k in range(3)])
    read_surface(write(tmp_path, vertices, faces))
    with pytest.raises(BadInput, match="on its head"):
        read_surface(write(tmp_path, -vertices, faces))
    limbs = [([300, 200, 1700], 850), ([1700, 90, 90], 1400)]  # arms held out: as wide as tall
    bodies = [VERTICES / np.ptp(VERTICES, axis=0) * size + [0, 0, at] for size, at in limbs]
    vertices, faces = np.concatenate(bodies), np.vstack([FACES, FACES + len(VERTICES)])
    read_surface(write(tmp_path, vertices, faces))
    with pytest.raises(BadInput, match="it lies on its side"):
        read_surface(write(tmp_path, vertices[:, [2, 1, 0]], faces))
