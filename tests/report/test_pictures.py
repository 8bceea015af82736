"""Pictures of small bodies: what is drawn where, and in which colour."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from made_bodies import ellipsoid, mesh_of

from bodyscan.mesh.body import BodyCloud, BodyMesh
from bodyscan.report.charts import diverging
from bodyscan.report.pictures import Scale, VisiblePoints, draw_cloud, draw_mesh

RADIUS = 100.0
CENTRE = np.array([5.0, 7.0, 900.0])
STEP = (2.0 * RADIUS + 40.0) / 300  # mm a pixel of a picture 300 px high


def ball() -> BodyMesh:
    """Its left half (y > 0) was made up."""
    vertices, faces = ellipsoid((RADIUS, RADIUS, RADIUS), CENTRE, 30)
    filled = (vertices[faces].mean(axis=1)[:, 1]) > 7.0
    return mesh_of(vertices, faces, filled, colours=90)


def dots() -> BodyCloud:
    normals = np.random.default_rng(0).normal(size=(200_000, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return BodyCloud(
        RADIUS * normals + CENTRE,
        normals.astype(np.float32),
        np.where(normals[:, 2] > 0, 0.05, 0.5).astype(np.float32),
        np.where(normals[:, :1] > 0, [[200, 30, 30]], [[30, 30, 200]]).astype(np.uint8),
        np.where(normals[:, 1] > 0, 1, 5).astype(np.uint8),
    )


def visible(*views: str) -> VisiblePoints:
    return VisiblePoints.from_points(dots().points, dots().normals, views, height_px=300)


def read(png: bytes) -> np.ndarray:
    picture = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR).astype(int)
    assert picture.shape[0] == 300
    return picture


def background(picture: np.ndarray) -> np.ndarray:
    return (picture == 250).all(axis=-1)


def strongly(picture: np.ndarray, channel: int, over: int) -> np.ndarray:
    """Where one channel (0 blue, 1 green, 2 red) is well above another."""
    return picture[..., channel] > picture[..., over] + 40


def test_a_ball_is_a_disc_with_its_made_up_half_orange() -> None:
    picture = read(draw_mesh(ball(), ["front"], height_px=300))
    area = np.count_nonzero(~background(picture)) * STEP**2
    assert area == pytest.approx(np.pi * RADIUS**2, rel=0.01)
    orange = strongly(picture, 2, 0)
    # From the front the subject's left is the picture's right.
    columns = np.nonzero(orange)[1]
    assert columns.min() > picture.shape[1] / 2 - 4
    assert np.count_nonzero(orange) == pytest.approx(
        np.count_nonzero(~background(picture)) / 2, rel=0.1
    )


@pytest.mark.parametrize(("view", "side"), [("back", "left"), ("side", "all")])
def test_views_stand_where_they_say(view: str, side: str) -> None:
    picture = read(draw_mesh(ball(), [view], height_px=300))
    orange, shown = strongly(picture, 2, 0), ~background(picture)
    share = np.count_nonzero(orange) / np.count_nonzero(shown)
    assert share == pytest.approx({"left": 0.5, "all": 1.0}[side], abs=0.12)
    if side == "left":
        assert np.nonzero(orange)[1].mean() < picture.shape[1] / 2


def test_faces_turned_inside_out_are_magenta() -> None:
    mesh = replace(ball(), filled=np.zeros_like(ball().filled))
    turned = replace(mesh, faces=mesh.faces[:, ::-1])
    right, wrong = (read(draw_mesh(one, ["front"], height_px=300)) for one in (mesh, turned))
    assert not strongly(right, 2, 1).any()
    shown = ~background(wrong)
    assert np.mean(strongly(wrong, 2, 1)[shown]) > 0.9


def test_the_side_facing_away_is_hidden() -> None:
    picture = read(draw_cloud(dots(), visible("front", "back")))
    front, back = np.split(picture, 2, axis=1)
    # The front half is red, the back half blue; at the outline either may show.
    for half, channel in ((front, 2), (back, 0)):
        shown = ~background(half)
        assert np.mean(strongly(half, channel, 2 - channel)[shown]) > 0.98


def test_a_ball_of_points_has_no_holes() -> None:
    shown = ~background(read(draw_cloud(dots(), visible("side"))))
    area = np.count_nonzero(shown) * STEP**2
    # Four of them fall on the 2 x 2 pixels that each paints: 2 % are left; a pixel of outline.
    assert area == pytest.approx(np.pi * RADIUS**2, rel=0.05)


def test_sigma_and_pairs_have_their_colours_and_a_bar() -> None:
    photo, sigma, pairs = (
        read(draw_cloud(dots(), visible("front"), colour))
        for colour in ("photo", "sigma", "pairs_seen")
    )
    width = photo.shape[1]
    assert sigma.shape[1] > width + 50
    above, below = sigma[80:140, width // 2], sigma[160:220, width // 2]
    assert below[:, 2].mean() > above[:, 2].mean() + 40  # the turbo scale ends in red
    left, right = pairs[150, 60 : width // 2 - 5], pairs[150, width // 2 + 5 : width - 60]
    assert left[:, 2].mean() > right[:, 2].mean() + 40


def test_deviations_are_red_outside_and_blue_inside() -> None:
    cloud = dots()
    signed = np.where(cloud.points[:, 2] > 900.0, 0.8, -0.8)
    scale = Scale(-1.0, 1.0, "deviation, mm", diverging()[:, ::-1])
    picture = read(visible("front").draw_values(signed, scale))
    # Random points leave a few gaps.
    middle = (picture.shape[1] - 130) // 2
    assert strongly(picture[80:140, middle], 2, 0).mean() > 0.9
    assert strongly(picture[160:220, middle], 0, 2).mean() > 0.9
