"""Board plans: what is held where, and who takes it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from bodyscan.errors import BadInput
from bodyscan.rig.rig import Rig, load_rig
from bodyscan.simulation.layout import TruePair, build_pairs
from bodyscan.simulation.plan import BoardShot, count_default_shots, plan_boards
from bodyscan.simulation.settings import SimulationSettings

RIGS = Path(__file__).parents[2] / "rigs"
Plan = tuple[Rig, dict[str, TruePair], list[BoardShot]]


def planned(name: str) -> Plan:
    rig = load_rig(RIGS / name)
    pairs = build_pairs(rig, SimulationSettings(), lambda n: np.random.default_rng([0, n]))
    shots = count_default_shots(len(pairs))
    return rig, pairs, plan_boards(rig, pairs, shots, np.random.default_rng(1))


@pytest.fixture(scope="module", params=["three-pole-12.yaml", "four-pole-16.yaml", "one-pair.yaml"])
def plan(request: pytest.FixtureRequest) -> Plan:
    return planned(request.param)


def seen(pair: TruePair, shot: BoardShot, rig: Rig) -> tuple[float, float, bool]:
    """(angle off the face in degrees, share inside the image, front?) worked out anew."""
    board = rig.board(shot.board)
    size = np.array([board.columns, board.rows]) * board.square_mm
    x, y = np.meshgrid(np.linspace(0, size[0], 21), np.linspace(0, size[1], 21))
    points = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)
    seen_at = pair.rig_from_camera.inverse().apply(shot.rig_from_board.apply(points))
    ahead = seen_at[:, 2] > 0
    u, v = pair.camera.image(seen_at[ahead]).T
    inside = np.zeros(len(points))
    inside[ahead] = (u >= 0) & (u < pair.camera.width) & (v >= 0) & (v < pair.camera.height)
    centre = shot.rig_from_board.apply(np.array([*size / 2, 0.0]))
    way = pair.rig_from_camera.translation - centre
    cosine = shot.rig_from_board.rotation[:, 2] @ way / np.linalg.norm(way)
    return float(np.degrees(np.arccos(abs(cosine)))), float(np.mean(inside)), bool(cosine < 0)


def test_who_takes_what_follows_the_rules(plan: Plan) -> None:
    rig, pairs, shots = plan
    for shot in [shot for shot in shots if shot.name != rig.rig_frame.shot][::4]:
        assert not set(shot.stripes) & set(shot.lit)
        for name, pair in pairs.items():
            angle, inside, front = seen(pair, shot, rig)
            whole = rig.boards[0].kind == "checkerboard"
            share = 0.99 if whole else 0.45  # the plan counts fewer points: 0.05 to spare
            if name in shot.stripes:
                assert angle <= 50
                assert inside >= share
                assert front or rig.boards[0].faces == 2
            elif name in shot.lit:
                assert angle <= 70
                assert inside >= 0.2
            else:
                assert angle > 69 or inside < (1.0 if whole else 0.3) or not front


def test_every_pair_gets_its_boards_near_and_far_and_tilted(plan: Plan) -> None:
    rig, pairs, shots = plan
    for name, pair in pairs.items():
        own = [shot for shot in shots if name in shot.stripes]
        assert len(own) >= 6
        board = rig.boards[0]
        size = np.array([board.columns, board.rows, 0.0]) * board.square_mm
        poses = [pair.rig_from_camera.inverse() @ shot.rig_from_board for shot in own]
        depth = np.array([pose.apply(size / 2)[2] for pose in poses]) / pair.reach_mm
        assert depth.max() - depth.min() > 0.15
        normals = np.stack([pose.rotation[:, 2] * np.sign(pose.rotation[2, 2]) for pose in poses])
        spread = np.linalg.svd(normals - normals.mean(axis=0))[1] / np.sqrt(len(own))
        assert spread[1] > 0.08  # about two axes, by 5 degrees and more (one sigma)


def test_pairs_of_all_poles_are_tied_together(plan: Plan) -> None:
    _, pairs, shots = plan
    groups = {name: {name} for name in pairs}
    for shot in shots:
        takers = (*shot.stripes, *shot.lit)
        for name in takers[1:]:
            merged = groups[takers[0]] | groups[name]
            for member in merged:
                groups[member] = merged
    assert all(group == set(pairs) for group in groups.values())


def test_the_floor_board_lies_as_the_rig_file_says_and_the_lowest_cameras_take_it() -> None:
    _, _, shots = planned("three-pole-12.yaml")
    floor = shots[0]
    assert floor.name == "floor"
    assert floor.stripes == ()
    assert set(floor.lit) == {"p1-1", "p2-1", "p3-1"}
    middle = floor.rig_from_board.apply(np.array([315.0, 245.0, 6.0]))
    assert middle == pytest.approx([0, 0, 0], abs=1e-9)
    assert floor.rig_from_board.rotation[:, 2] == pytest.approx([0, 0, -1])


def test_the_pair_that_fixes_the_rig_frame_stands_where_it_should() -> None:
    _, pairs, _ = planned("one-pair.yaml")
    assert pairs["pair"].rig_from_camera.translation == pytest.approx([400, 0, 300], abs=1e-12)
    assert pairs["pair"].rig_from_camera.rotation[:, 2] == pytest.approx([-1, 0, 0], abs=1e-12)
    _, pairs, _ = planned("three-pole-12.yaml")
    off = np.linalg.norm(pairs["p2-1"].rig_from_camera.translation - [-1300, 0, 700])
    assert 1.0 < off < 60.0  # 10 mm an axis


def test_a_rig_without_placings_is_refused() -> None:
    rig = load_rig(RIGS / "one-pair.yaml")
    bare = rig.model_copy(update={"pairs": (rig.pairs[0].model_copy(update={"nominal": None}),)})
    with pytest.raises(BadInput, match="nominal pose"):
        build_pairs(bare, SimulationSettings(), lambda n: np.random.default_rng(n))
