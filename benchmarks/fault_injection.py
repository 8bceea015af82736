"""Faults put into sound captures of a subject: each returns what `fuse` starts from.

A moved pole is a calibration that has it elsewhere; faults in images change the images; what stands
in the volume besides the subject is ray-cast with the calibrated cameras.
"""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import open3d as o3d
from scipy import ndimage

from bodyscan.arrays import Array, Bytes, Indices
from bodyscan.captures.folder import open_scan
from bodyscan.errors import BodyscanError
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.measurement.measurements import Measurements
from bodyscan.outcome import Outcome
from bodyscan.reconstruction.range_image import RangeImage
from bodyscan.registration.rig_calibration import RigCalibration
from bodyscan.workflows.range_images import reconstruct_sequence

MIDDLE = RigidTransform(np.eye(3), np.array([0.0, 0.0, 900.0]))
CAST_NOISE_MM = 0.1


@dataclass(frozen=True, eq=False)
class Sound:
    """A simulated rig and subject: the scan without any fault.

    other: range images of another person.
    vertices, faces: the subject's true surface, rig frame.
    girths: of that surface.
    """

    calibration: RigCalibration
    images: list[RangeImage]
    other: list[RangeImage]
    person: Path
    vertices: Array
    faces: Indices
    girths: Measurements


Case = tuple[RigCalibration, Outcome[list[RangeImage]]]


@dataclass(frozen=True)
class Fault:
    """named: words of which the verdict must contain one; () if nothing is wrong."""

    name: str
    named: tuple[str, ...]
    inject: Callable[[Sound], Case]


def faults() -> Iterator[Fault]:
    for pole, way in (("p1", 0), ("p2", 1)):
        for mm in (1.0, 2.0, 5.0, 15.0, 25.0):
            yield _moved(
                f"pole {pole}", f"{'out' if way == 0 else 'aside'} {mm:g} mm", mm, way, 0.0
            )
        for degrees in (1.0, 2.0, 4.0, 8.0):
            yield _moved(f"pole {pole}", f"turned {degrees:g} deg", 0.0, way, degrees)
        yield Fault(f"pole {pole}: another person's", (f"pole {pole}",), _another(pole))
    yield _moved("pole p2", "of an earlier scan: 8 mm and 2 deg", 8.0, 1, 2.0)
    for mm in (2.0, 5.0):
        yield _all_out(mm)
    for mm in (2.0, 5.0, 15.0):
        yield _moved("pair p1-2", f"out {mm:g} mm", mm, 0, 0.0)
    yield _moved("pair p1-2", "turned 2 deg", 0.0, 0, 2.0)
    yield Fault("pairs p2-2 and p2-3 exchanged", ("exchanged", "swapped"), _exchanged)
    yield Fault("pair p2-2: focal length edited by 1 %", ("p2-2", "p2 "), _edited)
    yield from _image_faults()
    yield Fault("two people hand in hand", ("two people", "two bodies", "person"), _two_people)
    yield Fault("one person behind another", ("two people", "two bodies", "person"), _behind)
    yield Fault("hand on hip", ("touches the",), _hand_on_hip)
    yield Fault("long hair, black", ("nothing was measured",), _hair)
    yield Fault("a stick beside the legs", ("stick",), _stick)
    yield Fault("a chair behind the legs", ("piece", "something", "not in the mesh"), _chair)


def faults_of_the_living() -> Iterator[Fault]:
    """Faults that may be mistaken for a person's own motion."""
    for mm in (2.0, 5.0, 15.0, 25.0):
        yield _moved("pole p2", f"aside {mm:g} mm", mm, 1, 0.0)
    yield _moved("pole p1", "out 5 mm", 5.0, 0, 0.0)
    yield _moved("pole p2", "turned 2 deg", 0.0, 1, 2.0)
    yield Fault("pole p2: another person's", ("pole p2",), _another("p2"))
    yield _moved("pair p1-2", "out 5 mm", 5.0, 0, 0.0)
    yield _all_out(3.0)


def _all_out(mm: float) -> Fault:
    """As if the frame that carries the poles had been put up anew, or grown."""

    def inject(sound: Sound) -> Case:
        placed, poles = sound.calibration.rig_from_camera, sound.calibration.rig.poles
        outward = {}
        for pole in set(poles.values()):
            own = [at.translation for name, at in placed.items() if poles[name] == pole]
            way = np.mean(own, axis=0) * [1.0, 1.0, 0.0]
            outward[pole] = mm * way / np.linalg.norm(way)
        moved = {
            name: RigidTransform(at.rotation, at.translation + outward[poles[name]])
            for name, at in placed.items()
        }
        return replace(sound.calibration, rig_from_camera=moved), Outcome(sound.images)

    return Fault(f"all poles: out {mm:g} mm", ("pole p", "all poles"), inject)


def _moved(what: str, how: str, mm: float, way: int, degrees: float) -> Fault:
    """A moved part of the rig. way: 0 away from the axis, 1 sideways."""
    name = what.split()[1]

    def inject(sound: Sound) -> Case:
        placed = dict(sound.calibration.rig_from_camera)
        group = [n for n in placed if n == name or n.startswith(f"{name}-")]
        outward = np.mean([placed[n].translation for n in group], axis=0) * [1.0, 1.0, 0.0]
        outward /= np.linalg.norm(outward)
        shift = mm * (outward if way == 0 else np.cross([0.0, 0.0, 1.0], outward))
        axis = np.array([0.0, 0.0, 1.0]) if way == 0 else outward
        by = RigidTransform.from_rotation_vector(np.radians(degrees) * axis, shift)
        placed |= {n: MIDDLE @ by @ MIDDLE.inverse() @ placed[n] for n in group}
        return replace(sound.calibration, rig_from_camera=placed), Outcome(sound.images)

    return Fault(f"{what}: {how}", (what,), inject)


def _another(pole: str) -> Callable[[Sound], Case]:
    def inject(sound: Sound) -> Case:
        mixed = [
            other if own.pair.startswith(pole) else own
            for own, other in zip(sound.images, sound.other, strict=True)
        ]
        return sound.calibration, Outcome(mixed)

    return inject


def _exchanged(sound: Sound) -> Case:
    placed = dict(sound.calibration.rig_from_camera)
    placed["p2-2"], placed["p2-3"] = placed["p2-3"], placed["p2-2"]
    return replace(sound.calibration, rig_from_camera=placed), Outcome(sound.images)


def _edited(sound: Sound) -> Case:
    """Points come out 1 % wider than they are; depths are unchanged."""
    wider = np.array([1.01, 1.01, 1.0], np.float32)
    images = [
        replace(image, points=image.points * wider) if image.pair == "p2-2" else image
        for image in sound.images
    ]
    return sound.calibration, Outcome(images)


def _image_faults() -> Iterator[Fault]:
    def each(change: Callable[[Bytes], Bytes]) -> Callable[[Path], None]:
        def work(folder: Path) -> None:
            for path in sorted(folder.glob("*.png")):
                _rewrite(path, change)

        return work

    def late(folder: Path) -> None:
        paths = sorted(folder.glob("*.png"))
        for path in paths[len(paths) // 2 :]:
            _rewrite(path, lambda grey: np.roll(grey, 3, axis=0))

    def fewer(folder: Path) -> None:
        for path in sorted(folder.glob("*-inverse.png"))[::2]:
            path.unlink()

    def blurred(grey: Bytes) -> Bytes:
        return np.asarray(cv2.GaussianBlur(grey, (0, 0), 3.0))

    def longer(grey: Bytes) -> Bytes:
        height, width = grey.shape[:2]
        zoom = cv2.getRotationMatrix2D((0.5 * (width - 1), 0.5 * (height - 1)), 0.0, 1.003)
        return np.asarray(cv2.warpAffine(grey, zoom, (width, height), flags=cv2.INTER_CUBIC))

    def torn(grey: Bytes) -> Bytes:
        half = len(grey) // 2
        return np.concatenate([grey[:half], grey[half + 1 :], grey[-1:]])

    def renumbered(folder: Path) -> None:
        paths = sorted(folder.glob("*.png"))
        later = [path.read_bytes() for path in paths[9:]]
        for path, content in zip(paths[8:], later, strict=False):
            path.unlink()
            path.write_bytes(content)

    changes: dict[str, Callable[[Path], None]] = {
        "mirrored": each(lambda grey: np.ascontiguousarray(grey[:, ::-1])),
        "focal length 0.3 % longer": each(longer),
        "a row lost": each(torn),
        "a frame lost, those after it moved up": renumbered,
        "three times overexposed": each(lambda grey: cv2.convertScaleAbs(grey, alpha=3.0)),
        "a tenth of the light": each(lambda grey: cv2.convertScaleAbs(grey, alpha=0.1)),
        "out of focus": each(blurred),
        "1 px lower": each(lambda grey: np.roll(grey, 1, axis=0)),
        "upside down": each(lambda grey: np.ascontiguousarray(grey[::-1, ::-1])),
        "bumped between its frames": late,
        "half of its inverses lost": fewer,
    }
    for what, change in changes.items():
        yield Fault(f"pair p2-3: {what}", ("p2-3",), _changed("p2-3", change))


def _changed(pair: str, change: Callable[[Path], None]) -> Callable[[Sound], Case]:
    def inject(sound: Sound) -> Case:
        with tempfile.TemporaryDirectory(dir=sound.person.parent) as there:
            copy = Path(there) / "person"
            shutil.copytree(sound.person, copy, copy_function=os.link)
            for folder in copy.glob(f"*/{pair}"):
                change(folder)
            images = {image.pair: image for image in sound.images}
            failed = {}
            try:
                captures = open_scan(sound.calibration.rig, copy)
                (sequence,) = captures.pair_sequences(pair)
                images[pair] = reconstruct_sequence(sound.calibration, captures, sequence)[0]
            except BodyscanError as error:
                del images[pair]
                failed[pair] = str(error)
        return sound.calibration, Outcome(list(images.values()), failures=failed)

    return inject


def _rewrite(path: Path, change: Callable[[Bytes], Bytes]) -> None:
    """Rewrite an image as a separate file: the original is a link to the sound one."""
    grey = change(np.asarray(cv2.imread(str(path), cv2.IMREAD_UNCHANGED), np.uint8))
    path.unlink()
    cv2.imwrite(str(path), grey)


def _two_people(sound: Sound) -> Case:
    """Two people side by side, hand in hand."""
    half = 0.5 * np.ptp(sound.vertices[:, 1]) - 15.0
    parts = [(sound.vertices + [0.0, side * half, 0.0], sound.faces) for side in (-1.0, 1.0)]
    return _cast(sound, parts)


def _behind(sound: Sound) -> Case:
    """Two people chest to back, 330 mm from middle to middle."""
    parts = [(sound.vertices + [side * 165.0, 0.0, 0.0], sound.faces) for side in (-1.0, 1.0)]
    return _cast(sound, parts)


def _hand_on_hip(sound: Sound) -> Case:
    """A bar from the trunk to the middle of the left forearm, in place of a hand on the hip."""
    x, y, z = sound.vertices[np.abs(sound.vertices[:, 2] - 850.0) < 15.0].T
    arm = y > 0.7 * y.max()
    length = float(y[arm].mean()) - 120.0
    made = o3d.geometry.TriangleMesh.create_cylinder(25.0, length, resolution=40)
    turn = o3d.geometry.get_rotation_matrix_from_axis_angle([-np.pi / 2, 0.0, 0.0])
    middle = [float(x[arm].mean()), 120.0 + 0.5 * length, float(z.mean())]
    bar = np.asarray(made.vertices) @ turn.T + middle
    return _cast(sound, [(sound.vertices, sound.faces), (bar, np.asarray(made.triangles))])


def _stick(sound: Sound) -> Case:
    """A stick from the floor to above the hand that holds it."""
    hand = sound.vertices[np.argmax(sound.vertices[:, 1])]
    made = o3d.geometry.TriangleMesh.create_cylinder(20.0, 1000.0, resolution=40)
    stick = np.asarray(made.vertices) + [hand[0], hand[1] + 5.0, 510.0]
    return _cast(sound, [(sound.vertices, sound.faces), (stick, np.asarray(made.triangles))])


def _chair(sound: Sound) -> Case:
    """A chair: its seat touches the backs of the calves at 430 mm; four legs and a back."""
    boxes = [
        ((420.0, 420.0, 30.0), (-330.0, 0.0, 430.0)),
        ((30.0, 420.0, 450.0), (-530.0, 0.0, 680.0)),
    ]
    boxes += [
        ((30.0, 30.0, 430.0), (x, y, 215.0)) for x in (-140.0, -520.0) for y in (-190.0, 190.0)
    ]
    parts = [(sound.vertices, sound.faces)]
    for size, middle in boxes:
        made = o3d.geometry.TriangleMesh.create_box(*size)
        parts.append(
            (np.asarray(made.vertices) - 0.5 * np.array(size) + middle, np.asarray(made.triangles))
        )
    return _cast(sound, parts)


def _hair(sound: Sound) -> Case:
    """Dark hair: the topmost 250 mm reflect nothing."""
    top = float(sound.vertices[:, 2].max()) - 250.0
    images = []
    for image in sound.images:
        height = sound.calibration.rig_from_camera[image.pair].apply(image.points.astype(float))[
            ..., 2
        ]
        sigma = np.where(height > top, np.float32(np.nan), image.sigma_mm)
        images.append(replace(image, sigma_mm=sigma))
    return sound.calibration, Outcome(images)


def _cast(sound: Sound, parts: list[tuple[Array, Indices]]) -> Case:
    scene = o3d.t.geometry.RaycastingScene()
    for vertices, faces in parts:
        scene.add_triangles(vertices.astype(np.float32), faces.astype(np.uint32))
    floor = 2500.0 * np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], np.float32)
    scene.add_triangles(floor, np.array([[0, 1, 2], [0, 2, 3]], np.uint32))
    rng = np.random.default_rng(1)
    images = [_seen(scene, sound.calibration, image, rng) for image in sound.images]
    return sound.calibration, Outcome(images)


def _seen(
    scene: o3d.t.geometry.RaycastingScene,
    calibration: RigCalibration,
    image: RangeImage,
    rng: np.random.Generator,
) -> RangeImage:
    """What a pair would measure: what its camera sees and its projector lights."""
    at, lamp = calibration.rig_from_camera[image.pair], calibration.rig.pair(image.pair)
    assert lamp.projector_nominal is not None
    rays = image.camera.pixel_rays()
    ahead = at.rotate(rays)
    cast = scene.cast_rays(_rays(np.broadcast_to(at.translation, ahead.shape), ahead))
    depth = cast["t_hit"].numpy().astype(float)
    normals = cast["primitive_normals"].numpy() @ at.rotation
    seen = np.isfinite(depth)
    hit = at.apply(rays * np.where(seen, depth, 1.0)[..., None])
    source = np.broadcast_to(lamp.projector_nominal.position_mm, hit.shape)
    lit = scene.cast_rays(_rays(source, hit - source))["t_hit"].numpy() > 1.0 - 1e-3
    length = np.linalg.norm(rays, axis=-1)
    facing = -np.sum(normals * rays, axis=-1) / length
    # Silhouette pixels mix both sides; a decoder removes them.
    whole = ndimage.binary_erosion(seen & lit & (facing > 0.1))
    points = (
        rays
        * (np.where(seen, depth, 0.0) + rng.normal(0, CAST_NOISE_MM, depth.shape) / length)[
            ..., None
        ]
    )
    return replace(
        image,
        points=points.astype(np.float32),
        normals=normals.astype(np.float32),
        sigma_mm=np.where(whole, np.float32(CAST_NOISE_MM), np.float32(np.nan)),
        colours=np.where(seen, 40 + 200 * np.clip(facing, 0, 1), 0).astype(np.uint8),
        beyond=None,
        common_mm=None,
    )


def _rays(origins: Array, directions: Array) -> o3d.core.Tensor:
    return o3d.core.Tensor(np.concatenate([origins, directions], axis=-1).astype(np.float32))
