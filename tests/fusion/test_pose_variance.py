"""Error bars hold how well the pairs are placed."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from made_bodies import cloud_of

from bodyscan.arrays import Array, Indices
from bodyscan.fusion.pose_variance import add_motion_variance, add_pose_variance
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.geometry.uncertainty import PoseCovariance
from bodyscan.mesh.body import BodyCloud


@pytest.fixture
def cloud() -> BodyCloud:
    """Points of an upright cylinder, and one on top."""
    angle = np.linspace(0.0, 2.0 * np.pi, 72, endpoint=False)
    outward = np.column_stack([np.cos(angle), np.sin(angle), 0 * angle])
    normals = np.vstack([outward, [[0.0, 0.0, 1.0]]])
    points = np.vstack([150.0 * outward + [0, 0, 900.0], [[0.0, 0.0, 1700.0]]])
    return cloud_of(points, normals, 0.03)


def placed(*places: list[float]) -> dict[str, RigidTransform]:
    return {
        f"p{k}": RigidTransform(np.eye(3), np.array(place, float)) for k, place in enumerate(places)
    }


def test_a_pair_that_is_shifted_along_x_errs_where_it_looks_along_x(cloud: BodyCloud) -> None:
    covariance = np.diag([0.0, 0.0, 0.0, 0.04**2, 0.0, 0.0])
    prior = PoseCovariance(("p0",), covariance)
    found = add_pose_variance(cloud, placed([1300, 0, 900]), prior)
    front = cloud.normals[:, 0] > 0.999
    assert found.sigma_mm[front] == pytest.approx(0.05, rel=1e-3)
    assert found.sigma_mm[cloud.normals[:, 0] < 0.0] == pytest.approx(0.03)
    assert found.points is cloud.points


@pytest.mark.parametrize(
    ("seen", "alike", "share"),
    [(1, 0.0, 1.0), (2, 0.0, 0.5), (2, 1.0, 1.0), (2, 0.5, 0.75), (1, 0.5, 1.0), (5, 0.0, 0.5)],
)
def test_what_pairs_do_not_share_averages_out(
    cloud: BodyCloud, seen: int, alike: float, share: float
) -> None:
    """Two pairs side by side, each known to 0.04 mm along x, of whose variance they share `alike`:
    what is left of it in a point that `seen` pairs saw. One that looks at the back, a hundred times
    worse, says nothing of the front."""
    each = np.diag([0.0, 0.0, 0.0, 0.04**2, 0.0, 0.0])
    zero = np.zeros((6, 6))
    both = alike * each
    covariance = np.block([[each, both, zero], [both, each, zero], [zero, zero, 100.0 * each]])
    prior = PoseCovariance(("p0", "p1", "p2"), covariance)
    places = placed([1300, 100, 900], [1300, -100, 900], [-1300, 0, 900])
    cloud = replace(cloud, pairs_seen=np.full_like(cloud.pairs_seen, seen))
    found = add_pose_variance(cloud, places, prior)
    front, back = cloud.normals[:, 0] > 0.999, cloud.normals[:, 0] < -0.999
    expected = np.hypot(0.03, 0.04 * np.sqrt(share))
    assert found.sigma_mm[front] == pytest.approx(expected, rel=1e-3)
    assert found.sigma_mm[back] == pytest.approx(np.hypot(0.03, 0.4), rel=1e-3)


def test_the_seventieth_pair_errs_as_the_first(cloud: BodyCloud) -> None:
    """All pairs but the last stand in front; the last is known to a metre: what it faces is unsure."""
    places = placed(*[[1300.0, 0.0, 900.0]] * 69, [0.0, 1300.0, 900.0])
    covariance = np.zeros((420, 420))
    covariance[414:, 414:] = np.diag([0.0, 0.0, 0.0, 1e6, 1e6, 0.0])
    found = add_pose_variance(cloud, places, PoseCovariance(tuple(places), covariance))
    towards = np.array(places["p69"].translation) - cloud.points
    cosine = np.sum(towards * cloud.normals, axis=1) / np.linalg.norm(towards, axis=1)
    assert np.array_equal(found.sigma_mm > 1.0, cosine > 0.2)


def test_a_mean_of_three_pairs_spreads_by_its_error_bar(cloud: BodyCloud) -> None:
    """Motions drawn from a joint covariance without any structure; 2000 draws tell a spread to
    1.6 %, four times that for the worst of the points."""
    rng = np.random.default_rng(6)
    root = rng.normal(size=(18, 18)) * np.tile([1e-5] * 3 + [0.02] * 3, 3)[:, None]
    places = placed([1300, 100, 900], [1300, -100, 900], [1300, 0, 1200])
    front = cloud.normals[:, 0] > 0.9
    chosen = cloud_of(cloud.points[front], cloud.normals[front], 0.0)
    chosen = replace(chosen, pairs_seen=np.full_like(chosen.pairs_seen, 3))
    sigma = add_pose_variance(
        chosen, places, PoseCovariance(("p0", "p1", "p2"), root @ root.T)
    ).sigma_mm
    twists = (rng.normal(size=(2000, 18)) @ root.T).reshape(2000, 3, 6).mean(axis=1)
    moved = np.array([RigidTransform.identity().retract(t).apply(chosen.points) for t in twists])
    along = np.einsum("knc,nc->kn", moved - chosen.points, chosen.normals.astype(float))
    assert sigma == pytest.approx(along.std(axis=0), rel=0.065)


def test_what_moves_a_followed_body_as_a_whole_stays_in_its_sigmas(cloud: BodyCloud) -> None:
    """Following tells shapes alone; the boards hold where the whole stands."""
    by_boards = replace(cloud, sigma_mm=np.full_like(cloud.sigma_mm, 0.5))

    class Cells:
        def find_by_groups(self, points: Array, normals: Array) -> Indices:
            return np.zeros(len(points), np.int64)

    for motion_mm, expected in ((0.1, 0.5), (2.0, np.hypot(0.03, 2.0))):
        followed: Any = SimpleNamespace(cells=Cells(), sigma_mm=np.array([motion_mm]))
        found = add_motion_variance(cloud, by_boards, followed)
        assert found.sigma_mm == pytest.approx(expected, rel=1e-6)
