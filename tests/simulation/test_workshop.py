"""Devices and boards as people build and print them, one fault at a time."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from small_view import CAMERA, CRISP, LAMPS, projector, view, wall

from bodyscan.errors import BadInput
from bodyscan.rig.board import Board
from bodyscan.simulation import SimulationSettings, compose_settings
from bodyscan.simulation.board import make_board, make_print
from bodyscan.simulation.render import render_pair
from bodyscan.simulation.scene import Scene
from bodyscan.simulation.sensor import Brightness, draw_fixed_pattern, draw_flicker, expose
from bodyscan.simulation.settings import BoardMaking, Lighting, Noise, Pace


def test_a_workshop_is_not_ideal_and_every_number_stays_free() -> None:
    ideal, workshop = (compose_settings("mirror", preset=name) for name in ("ideal", "workshop"))
    assert ideal == SimulationSettings()
    for part in ("optics", "projection", "lighting", "noise", "board"):
        assert getattr(ideal, part) != getattr(workshop, part)
    assert workshop.person == ideal.person
    changes = ["person.breath_mm=5", "pace.start=poles", "board.warp_mm=[0, 0]"]
    changed = compose_settings("pinhole", preset="workshop", subject="restless", changes=changes)
    assert (changed.person.breath_mm, changed.person.sway_mm_s) == (5.0, 14.0)
    assert changed.pace.start == "poles"
    assert changed.board.warp_mm == (0.0, 0.0)
    assert (changed.projection.kind, changed.projection.gamma) == ("pinhole", 2.2)
    with pytest.raises(BadInput, match="no preset 'garage' to simulate"):
        compose_settings("mirror", preset="garage")


def test_boards_are_bent_and_twisted_by_what_is_asked() -> None:
    board = Board(name="b", columns=12, rows=9, square_mm=60.0)
    sizes = []
    for seed in range(30):
        making = BoardMaking(warp_mm=(0.1, 1.0))
        made = make_board(board, making, np.random.default_rng(seed))
        front = made.surfaces[0].vertices
        sizes.append(np.ptp(front[:, 2]))
        assert np.ptp(made.corners[:, 2]) <= sizes[-1]
        # A sheet of second order: what a plane and its bends do not explain is nothing.
        x, y, z = (front - front.mean(axis=0)).T
        terms = np.stack([x, y, x * x, x * y, y * y, np.ones_like(x)], axis=1)
        assert np.abs(z - terms @ np.linalg.lstsq(terms, z, rcond=None)[0]).max() < 1e-9
    assert 0.1 <= min(sizes) < 0.2
    assert 0.6 < max(sizes) <= 1.0001
    flat = make_board(board, BoardMaking(), np.random.default_rng(0))
    assert np.ptp(flat.surfaces[0].vertices[:, 2]) == 0.0


def test_pixels_are_their_own_in_every_image() -> None:
    noise = Noise(pixel_gain=0.02, pixel_grey=0.5, read_grey=0.01, photons=1e6)
    fixed = draw_fixed_pattern(CAMERA, noise, np.random.default_rng(0))
    assert fixed is not None
    grey = np.full((CAMERA.height, CAMERA.width), 100.0, np.float32)
    first, second = (
        expose(grey, noise, np.random.default_rng(k), fixed).astype(float) for k in (1, 2)
    )
    assert np.mean(first != second) < 0.1  # they differ where noise tips the rounding
    assert first.std() == pytest.approx(np.hypot(100 * 0.02, 0.5), rel=0.05)
    assert draw_fixed_pattern(CAMERA, Noise(), np.random.default_rng(0)) is None


def test_lamps_on_mains_beat_with_the_frames() -> None:
    names = [f"f{k}" for k in range(24)]
    lamps = replace(
        SimulationSettings(), lighting=Lighting(mains_hz=100.0, mains_depth=0.5),
        pace=Pace(frame_ms=1000.0 / 120.0),
    )  # fmt: skip
    drawn = draw_flicker(names, lamps, np.random.default_rng(0))
    room = np.array([drawn[name].room for name in names])
    # 100 Hz in frames of 1/120 s: six frames a beat; a frame sees sin(x) / x of the depth.
    np.testing.assert_allclose(room[:18], room[6:], atol=1e-9)
    seen = 0.5 * np.sin(np.pi * 100 / 120) / (np.pi * 100 / 120)
    assert np.ptp(room) == pytest.approx(2.0 * seen, rel=0.15)
    synchronous = replace(lamps, pace=Pace(frame_ms=10.0))
    drawn = draw_flicker(names, synchronous, np.random.default_rng(0))
    assert max(abs(one.room - 1.0) for one in drawn.values()) < 1e-12  # whole pulses
    assert draw_flicker(names, SimulationSettings(), np.random.default_rng(0)) == {}


def test_flicker_changes_one_frames_light_and_a_window_adds_its_own() -> None:
    scene, rays, source = Scene([wall(900.0, albedo=0.5)]), view(), projector()

    def rendered(**more: object) -> dict[str, np.ndarray]:
        rng = np.random.default_rng(0)
        return render_pair(scene, rays, source, LAMPS, CRISP, rng, **more)  # type: ignore[arg-type]

    plain = rendered()
    flickered = rendered(flicker={"bit01": Brightness(laser=1.1, room=0.5)})
    laser = plain["bit01"] - plain["dark"]
    np.testing.assert_allclose(
        flickered["bit01"], 1.1 * laser + 0.5 * plain["dark"], rtol=1e-5, atol=1e-4
    )
    np.testing.assert_array_equal(flickered["bit02"], plain["bit02"])
    facing = replace(LAMPS, window_grey=20.0, window_direction=(0.0, 0.0, -1.0))
    aside = replace(LAMPS, window_grey=20.0, window_direction=(1.0, 0.0, 0.0))
    for lamps, share in ((facing, 1.0), (aside, 0.5)):
        lit = render_pair(scene, rays, source, lamps, CRISP, np.random.default_rng(0))
        # The wall reflects half, and a window half round the side shines half as bright.
        more = lit["dark"] - plain["dark"]
        np.testing.assert_allclose(more, 0.5 * 20.0 * share, rtol=1e-4)


CHARUCO = Board(
    name="b", kind="charuco", columns=6, rows=4, square_mm=60, marker_mm=45, margin_mm=10,
    faces=2, thickness_mm=5, first_marker=7, dictionary="DICT_4X4_1000",
)  # fmt: skip
MAKING = BoardMaking()


def drawn(board: Board, face: int) -> np.ndarray:
    """OpenCV's print, 4 px a mm."""
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, board.dictionary))
    count = board.columns * board.rows // 2
    ids = np.arange(count) + board.first_marker + face * count
    size = (board.columns, board.rows)
    target = cv2.aruco.CharucoBoard(size, board.square_mm, board.marker_mm or 0, dictionary, ids)
    target.setLegacyPattern(board.legacy_layout)
    return target.generateImage((board.columns * 240, board.rows * 240), marginSize=0) < 128


@pytest.mark.parametrize("legacy", [False, True])
@pytest.mark.parametrize("face", [0, 1])
def test_charuco_is_as_opencv_draws_it(legacy: bool, face: int) -> None:
    board = CHARUCO.model_copy(update={"legacy_layout": legacy})
    image = drawn(board, face)
    v, u = np.indices(image.shape)
    places = np.stack([(u.ravel() + 0.5) / 4, (v.ravel() + 0.5) / 4], axis=1).astype(np.float32)
    dark = make_print(board, face, MAKING).albedo(places).reshape(image.shape) < 0.4
    # OpenCV rounds the markers' modules (7.5 mm) to whole px: only edges may differ
    differs = cv2.erode((dark != image).astype(np.uint8), np.ones((3, 3), np.uint8))
    assert differs.sum() == 0
    assert (dark == image).mean() > 0.98


def test_a_dictionary_with_too_few_markers_is_refused() -> None:
    board = CHARUCO.model_copy(update={"dictionary": "DICT_4X4_50", "first_marker": 40})
    with pytest.raises(BadInput, match="50 markers"):
        make_board(board, MAKING, np.random.default_rng(0))


def test_a_bowed_board_stands_out_towards_its_front() -> None:
    made = make_board(CHARUCO, replace(MAKING, bow_mm=2.0), np.random.default_rng(0))
    front, back = made.surfaces[:2]
    middle = np.linalg.norm(front.vertices[:, :2] - [180, 120], axis=1).argmin()
    assert front.vertices[middle, 2] == pytest.approx(-2.0, abs=1e-9)
    corner = np.linalg.norm(front.vertices[:, :2] - [0, 0], axis=1).argmin()
    assert front.vertices[corner, 2] == pytest.approx(0.0, abs=1e-9)
    assert back.vertices[:, 2].min() == pytest.approx(5.0 - 2.0, abs=1e-9)


def test_print_errors_have_the_size_asked_for() -> None:
    making = replace(MAKING, print_error_mm=0.1)
    board = CHARUCO.model_copy(update={"columns": 30, "rows": 30})
    perfect = make_board(board, MAKING, np.random.default_rng(0)).corners
    errors, steps = [], []
    for seed in range(6):
        made = make_board(board, making, np.random.default_rng(seed))
        error = (made.corners - perfect)[: 29 * 29, :2].reshape(29, 29, 2)
        errors.append(error)
        steps.append(np.diff(error, axis=0).std())
        mesh = made.surfaces[0]
        assert mesh.print_xy is not None
        for corner, place in ((0, [60, 60]), (400, [60 * (400 % 29 + 1), 60 * (400 // 29 + 1)])):
            vertex = np.linalg.norm(mesh.print_xy - place, axis=1).argmin()
            assert mesh.vertices[vertex] == pytest.approx(made.corners[corner], abs=1e-9)
    # six boards of six waves are few: within half
    assert np.std(errors) == pytest.approx(0.1, rel=0.5)
    assert np.mean(steps) / np.std(errors) < 0.5
