"""Which links hold a rig together, and which further shots are suggested."""

from __future__ import annotations

import re

import numpy as np
import pytest
from ring import ring_of_cameras, ring_rig, ring_views

from bodyscan.calibration.board_views import LocatedView
from bodyscan.geometry.camera import Camera
from bodyscan.geometry.robust import rms
from bodyscan.geometry.transforms import RigidTransform, twist_jacobian
from bodyscan.registration.advice import advise, assess_pairs, find_articulation_shots
from bodyscan.registration.rig_solve import RigSolution, solve_rig
from bodyscan.rig.rig import Rig

NOISE_PX = 0.03


Placings = dict[str, RigidTransform]
Cameras = dict[str, Camera]
Truth = dict[tuple[str, str], RigidTransform]
Ring = tuple[Rig, Placings, Cameras, list[LocatedView], Truth, RigSolution]


@pytest.fixture(scope="module")
def ring() -> Ring:
    placings, cameras = ring_of_cameras()
    views, truth = ring_views(placings, cameras, noise_px=NOISE_PX)
    rig = ring_rig(placings)
    return rig, placings, cameras, views, truth, solve_rig(rig, views, cameras).value


def again(
    target: tuple[str, str], count: int, ring: Ring, rng: np.random.Generator
) -> list[LocatedView]:
    """`count` shots of the board about where it was, as the true cameras see it."""
    _, placings, cameras, views, truth, _ = ring
    found = []
    for shot in range(count):
        tilt = RigidTransform.from_rotation_vector(rng.normal(0.0, 0.15, 3), np.zeros(3))
        for seen in (view for view in views if view.target == target):
            pose = placings[seen.pair].inverse() @ truth[target] @ tilt
            pixels = cameras[seen.pair].project(pose.apply(seen.points))
            noisy = pixels + rng.normal(0.0, NOISE_PX, pixels.shape)
            found.append(LocatedView(seen.pair, f"more{shot}", "board", seen.points, noisy, pose))
    return found


SUGGESTED = re.compile(
    r"(?P<shots>\d+) more shots? like (?P<shot>\w+) \(board (?P<board>\w+) about there, tilted "
    r"differently each time, seen by (?P<by>[^)]+)\) would (?P<verb>halve|improve) the sigma of "
    r"(?P<pair>\S+): (?P<before>[\d.]+) to (?P<after>[\d.]+) mm"
)


def test_a_pair_sees_places_where_they_are_within_their_sigma(ring: Ring) -> None:
    rig, placings, cameras, views, truth, placed = ring
    sigmas = assess_pairs(rig, placed)[0]
    off, motion = {}, {}
    for name in placings:
        each = np.concatenate([truth[v.target].apply(v.points) for v in views if v.pair == name])
        at, here = placings[name].inverse(), placed.rig_from_camera[name].inverse()
        by_place = cameras[name].jacobians(at.apply(each))[1] @ at.rotation
        mm = (2**0.5 / np.linalg.norm(by_place, axis=(1, 2)))[:, None]
        seen_at = cameras[name].project(at.apply(each))
        off[name] = (placed.cameras[name].project(here.apply(each)) - seen_at) * mm
        motion[name] = by_place @ twist_jacobian(each) * mm[..., None]
    every = np.concatenate(list(motion.values())).reshape(-1, 6)
    common = np.linalg.lstsq(every, np.concatenate(list(off.values())).ravel(), rcond=None)[0]
    ratios = [2**0.5 * rms(off[n] - motion[n] @ common) / sigmas[n] for n in placings]
    assert 0.7 < rms(np.array(ratios)) < 1.3


def test_shots_as_advised_reduce_the_sigma_of_the_worst_pair_as_told(ring: Ring) -> None:
    rig, _, cameras, views, *_ = ring
    views = [view for view in views if int(view.shot[1:]) < 12]
    placed = solve_rig(rig, views, cameras).value
    worst, more = advise(rig, placed)  # and nothing else: no shot is crucial
    name, sigma = max(assess_pairs(rig, placed)[0].items(), key=lambda one: one[1])
    assert worst == f"{name} has the largest sigma where boards were seen: {sigma:.3f} mm"
    told = SUGGESTED.fullmatch(more)
    assert told is not None
    assert told["pair"] == name
    assert told["verb"] == ("halve" if 2 * float(told["after"]) <= sigma else "improve")
    assert float(told["before"]) == pytest.approx(sigma, abs=5e-4)
    target = (told["shot"], told["board"])
    assert told["by"].split(", ") == sorted(v.pair for v in views if v.target == target)
    extra = again(target, int(told["shots"]), ring, np.random.default_rng(5))
    solution = solve_rig(rig, [*views, *extra], cameras).value
    # Tilts tell more of a lens than the same shot again, of which the prediction is.
    assert 0.5 < assess_pairs(rig, solution)[0][name] / float(told["after"]) < 1.15


def test_a_shot_that_alone_ties_a_pole_is_named() -> None:
    placings, cameras = ring_of_cameras(heights=(700, 1200))
    views, _ = ring_views(placings, cameras, shots=30)
    # The third pole sees the board together with the others in one shot only.
    one, other = ({v.shot for v in views if v.pair == name} for name in ("p3-2", "p1-2"))
    bridge = min(one & other)
    kept = [
        v
        for v in views
        if (v.shot == bridge and v.pair in ("p1-2", "p3-2"))
        or (v.shot != bridge and (v.pair[:2] == "p3") == (int(v.shot[1:]) % 2 == 0))
    ]
    rig = ring_rig(placings)
    placed = solve_rig(rig, kept, cameras).value
    crucial, worst, more = advise(rig, placed)
    assert find_articulation_shots(placed) == ((bridge, "board"),)
    assert crucial == (f"without any one of these shots the rig is disconnected: {bridge} (board)")
    # One shot ties it, and the advice is to tie that pole again.
    assert worst.startswith("p3")
    told = SUGGESTED.fullmatch(more)
    assert told is not None
    assert (told["shot"], told["by"]) == (bridge, "p1-2, p3-2")
    assert float(told["after"]) < 0.6 * float(told["before"])
