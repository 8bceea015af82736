"""A ring of cameras around a board, corners with noise: no images, exact truth."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from bodyscan.arrays import Array
from bodyscan.boards.board_layout import compute_corner_points
from bodyscan.boards.view import BoardView
from bodyscan.calibration.board_views import LocatedView, PlanarView, find_board_symmetries
from bodyscan.calibration.camera import estimate_pose, locate_board, locate_boards
from bodyscan.geometry.camera import Camera
from bodyscan.geometry.lenses.opencv import Radial
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.geometry.uncertainty import compute_position_sigma
from bodyscan.registration.rig_solve import RigSolution
from bodyscan.rig.board import Board
from bodyscan.rig.pair import NominalPose
from bodyscan.rig.rig import Rig

CHARUCO = Board(
    name="board", kind="charuco", columns=9, rows=7, square_mm=70, marker_mm=52, faces=2,
    thickness_mm=6,
)  # fmt: skip


def looking_at(position: Array | list[float], target: Array | list[float]) -> RigidTransform:
    forward = np.asarray(target, float) - position
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    return RigidTransform(
        np.column_stack([right, np.cross(forward, right), forward]), np.asarray(position, float)
    )


def ring_of_cameras(
    poles: int = 3, heights: Sequence[float] = (400, 850, 1300, 1750)
) -> tuple[dict[str, RigidTransform], dict[str, Camera]]:
    """`rig_from_camera` and cameras by name, at 1.3 m around the centre."""
    placings, cameras = {}, {}
    rng = np.random.default_rng(7)
    for pole in range(poles):
        angle = np.radians(60.0 + 360.0 * pole / poles)
        for k, height in enumerate(heights):
            name = f"p{pole + 1}-{k + 1}"
            position = [1300.0 * np.cos(angle), 1300.0 * np.sin(angle), height]
            placings[name] = looking_at(position, [0.0, 0.0, height - 50.0])
            focal = 1510.0 + rng.normal(0.0, 5.0)
            cameras[name] = Camera(
                focal, focal + 2.0, -0.5, 645.0, 508.0, Radial(-0.1, 0.05), 1280, 1024
            )
    return placings, cameras


def nominal(placing: RigidTransform) -> NominalPose:
    """A place as a rig file has it."""
    position = placing.translation
    look_at = position + 1000.0 * placing.rotation[:, 2]
    return NominalPose(position_mm=tuple(position), look_at_mm=tuple(look_at))


def ring_rig(
    placings: dict[str, RigidTransform], *boards: Board, fixed: str = "p1-1", **other: object
) -> Rig:
    """Of CHARUCO if no board is named; other: further keys of the rig file."""
    pairs = [
        {
            "name": name,
            "camera": {"width": 1280, "height": 1024},
            "nominal": nominal(placings[name]) if name == fixed else None,
        }
        for name in sorted(placings)
    ]
    rig = {"name": "ring", "boards": boards or (CHARUCO,), "pairs": pairs}
    return Rig.model_validate(rig | {"rig_frame": {"pair": fixed}} | other)


def centre_errors(
    placed: RigSolution, placings: dict[str, RigidTransform]
) -> dict[str, tuple[Array, Array]]:
    """By how much pairs were put beside where they stand, and the sigmas of that, mm."""
    return {
        name: (
            pose.translation - placings[name].translation,
            compute_position_sigma(placed.covariance, name, pose.translation),
        )
        for name, pose in placed.rig_from_camera.items()
    }


def rms_mm(placed: RigSolution, placings: dict[str, RigidTransform]) -> float:
    errors = [error for error, _ in centre_errors(placed, placings).values()]
    return float(np.sqrt(np.mean(np.sum(np.square(errors), axis=1))))


def in_sigmas(placed: RigSolution, placings: dict[str, RigidTransform]) -> list[Array]:
    """Errors over their sigmas, of all but the pair that fixes the frame, which has none."""
    errors = centre_errors(placed, placings).values()
    return [error / sigma for error, sigma in errors if np.all(sigma > 1e-6)]


def seen_anew(
    view: LocatedView,
    camera: Camera,
    camera_from_board: RigidTransform,
    rng: np.random.Generator,
    points: Array,
) -> LocatedView:
    """The view as it would have been with the board there, its corners at these points."""
    pixels = camera.project(camera_from_board.apply(points))
    pixels += rng.normal(0.0, 0.03, pixels.shape)
    pose, _ = locate_board(camera, PlanarView(view.shot, view.points, pixels))
    return replace(view, pixels=pixels, camera_from_board=pose)


def board_poses(count: int, rng: np.random.Generator) -> Iterator[RigidTransform]:
    """`rig_from_board`: upright boards near the centre at all heights, turned and tilted."""
    upright = np.column_stack([[0, 1, 0], [0, 0, -1], [-1, 0, 0]]).astype(float)
    for _ in range(count):
        turn = RigidTransform.from_rotation_vector([0, 0, rng.uniform(0, 2 * np.pi)], [0, 0, 0])
        tilt = RigidTransform.from_rotation_vector(rng.normal(0, 0.3, 3), [0, 0, 0])
        rotation = turn.rotation @ upright @ tilt.rotation
        centre = [*rng.uniform(-200, 200, 2), rng.uniform(300, 1800)]
        yield RigidTransform(rotation, centre - rotation @ [315.0, 245.0, 0.0])


def ring_views(
    placings: dict[str, RigidTransform],
    cameras: dict[str, Camera],
    *,
    shots: int = 40,
    noise_px: float = 0.03,
    seed: int = 0,
    board: Board = CHARUCO,
    poses: Sequence[RigidTransform] = (),
) -> tuple[list[LocatedView], dict[tuple[str, str], RigidTransform]]:
    """What each camera sees of each shot, located with the true camera; poses: of the shots' boards."""
    rng = np.random.default_rng(seed)
    points = compute_corner_points(board)
    per_face = len(points) // board.faces
    seen: list[tuple[str, PlanarView, tuple[RigidTransform, ...]]] = []
    truth = {}
    for number, rig_from_board in enumerate(poses or board_poses(shots, rng)):
        shot = f"s{number:02d}"
        truth[shot, board.name] = rig_from_board
        for name, camera in cameras.items():
            camera_from_board = placings[name].inverse() @ rig_from_board
            middle = camera_from_board.apply(points.mean(axis=0))
            facing = camera_from_board.rotation[:, 2] @ middle / np.linalg.norm(middle)
            if abs(facing) < 0.4 or (facing < 0 and board.faces == 1):
                continue
            face = points[:per_face] if facing > 0 else points[-per_face:]
            pixels = camera.project(camera_from_board.apply(face))
            inside = np.all((pixels > 5) & (pixels < [1275, 1019]), axis=1)
            if inside.sum() < 12:
                continue
            noisy = pixels[inside] + rng.normal(0.0, noise_px, (inside.sum(), 2))
            corners = face[inside]
            view = PlanarView(shot, corners, noisy)
            symmetries: tuple[RigidTransform, ...] = (RigidTransform.identity(),)
            if board.kind == "checkerboard":
                # As a detector would: whichever end, and always as if it were the front.
                symmetries = find_board_symmetries(board)
                label = symmetries[rng.integers(len(symmetries))]
                if abs(label.inverse().apply(corners)[0, 2]) > 1e-9:
                    label = next(
                        s for s in symmetries if abs(s.inverse().apply(corners)[0, 2]) < 1e-9
                    )
                view = PlanarView(shot, label.inverse().apply(corners), noisy)
            seen.append((name, view, symmetries))
    located = _located(cameras, [(name, view) for name, view, _ in seen])
    views = [
        LocatedView(name, view.shot, board.name, view.points, view.pixels, pose, symmetries)
        for (name, view, symmetries), pose in zip(seen, located, strict=True)
    ]
    return views, truth


def _located(
    cameras: dict[str, Camera], views: Sequence[tuple[str, PlanarView]]
) -> list[RigidTransform]:
    """camera_from_board of each view, all of a camera at once."""
    poses: dict[int, RigidTransform] = {}
    for name, camera in cameras.items():
        own = {number: view for number, (of, view) in enumerate(views) if of == name}
        starts = [estimate_pose(camera, view) for view in own.values()]
        if own:
            found, _ = locate_boards(camera, list(own.values()), starts)
            poses |= dict(zip(own, found, strict=True))
    return [poses[number] for number in range(len(views))]


def as_found(views: Sequence[LocatedView]) -> list[BoardView]:
    """The same views of CHARUCO as a detector gives them: corners by number, no pose."""
    corners = {
        tuple(p): k for k, p in enumerate(np.round(compute_corner_points(CHARUCO), 6).tolist())
    }
    ids = [[corners[tuple(p)] for p in np.round(view.points, 6).tolist()] for view in views]
    return [
        BoardView(view.pair, view.shot, view.board, np.array(own), view.pixels)
        for view, own in zip(views, ids, strict=True)
    ]
