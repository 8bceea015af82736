"""A whole captured data set of a rig: boards, a person, and the truth about them."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import IntEnum
from pathlib import Path
from threading import Lock

import numpy as np

from bodyscan.errors import BadInput
from bodyscan.files.atomic import write_json
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.progress import THREADS, Progress, map_threads, silent
from bodyscan.rig.rig import Rig, load_rig, write_rig
from bodyscan.rig.templates import fill
from bodyscan.simulation import body, files
from bodyscan.simulation.board import make_board
from bodyscan.simulation.files import Motion, Truth, describe
from bodyscan.simulation.lamps import Lamps
from bodyscan.simulation.layout import TruePair, build_pairs, build_room
from bodyscan.simulation.living import LivingBody, animate, moves, save_body
from bodyscan.simulation.patterns import (
    refuse_unknown_code,
    refuse_unknown_frames,
    simulate_instrument,
)
from bodyscan.simulation.plan import count_default_shots, plan_boards
from bodyscan.simulation.rays import View
from bodyscan.simulation.render import Moving, render_pair
from bodyscan.simulation.scene import Scene, Surface
from bodyscan.simulation.sensor import (
    Brightness,
    FixedPattern,
    choose_exposure,
    draw_fixed_pattern,
    draw_flicker,
    expose,
)
from bodyscan.simulation.settings import SimulationSettings


class Stream(IntEnum):
    """Streams of random numbers by purpose, each independent of what the others draw."""

    PAIRS = 1
    BOARDS = 2
    PLAN = 3
    SKIN = 4
    RAYS = 6
    NOISE = 7
    LIFE = 8
    PIXELS = 9


CALIBRATION, PERSON = "captures/calibration", "captures/person"
PERSON_SHOT = "s01"


@dataclass(frozen=True, eq=False)
class Task:
    """One pair's images of one shot: what is there besides the room, and where.

    frames_ms: when each frame is taken, for a subject that moves; it is then `body`, and the
        surfaces show it at the middle of that time.
    """

    number: int
    shot: str
    folder: str
    surfaces: tuple[Surface, ...]
    rig_from_surfaces: RigidTransform
    bright_grey: float
    sequence: bool
    body: LivingBody | None = None
    frames_ms: Mapping[str, float] = field(default_factory=dict)


def simulate(
    rig_file: Path,
    out: Path,
    *,
    subject: Path | None = None,
    scale: float = 1.0,
    seed: int = 0,
    settings: SimulationSettings | None = None,
    board_shots: int | None = None,
    take: int = 0,
    workers: int = THREADS,
    progress: Progress = silent,
) -> None:
    """Write captures of the rig in `rig_file`, with known truth, into the folder `out`.

    subject: a body mesh (see `body.load_subject`); without one only boards are captured.
    scale: of image size and number of stripes.
    board_shots: not counting the one that fixes the rig frame; by default 40 for twelve pairs; 0
        for the subject alone, in front of a rig that was calibrated before.
    take: another number lets the subject sway otherwise in front of the same rig.
    workers: pairs at the same time.

    The same arguments give the same bytes. Raises RigFileError, and BadInput for a rig without
    nominal poses, a stripe code that the simulator does not know, or a subject that cannot be read.
    """
    settings = settings or SimulationSettings()
    rig = files.scale_rig(load_rig(rig_file), scale, CALIBRATION)
    refuse_unknown_frames(rig)
    for pair in rig.pairs:
        if pair.projector is not None:
            refuse_unknown_code(pair.projector, pair.name)
    truth = _decide(rig, subject, settings, seed, board_shots, take)
    tasks = {name: _list_tasks(truth, name) for name in truth.pairs}
    _render_all(rig, truth, tasks, Path(out), workers, progress)
    write_rig(out / "rig.yaml", rig)
    if truth.plan:
        listed = [(shot.name, shot.stripes, shot.lit) for shot in truth.plan]
        files.write_captures(out / CALIBRATION, "calibration", listed)
    if truth.person is not None:
        striped = [name for name, pair in truth.pairs.items() if pair.has_stripes]
        alone = [name for name in truth.pairs if name not in striped]
        shots = [(PERSON_SHOT, striped, alone)]
        files.write_captures(out / PERSON, "scan", shots, truth.subject, settings.pace)
        body.save_truth(truth.person, out / "truth" / "subject.ply")
    if truth.motion is not None:
        living, moment = truth.motion.body, truth.motion.moment_ms
        at_mean_breath = living.surface(moment, breathing=False)
        body.save_truth(at_mean_breath, out / "truth" / "subject-mean-breath.ply")
        save_body(living, out / "truth" / "body.npz")
    write_json(out / "truth" / "truth.json", describe(truth))


def simulate_board(
    rig_file: Path, out: Path, shot: str, *, seed: int = 0, settings: SimulationSettings
) -> None:
    """Write all images that every pair takes of one shot of the board, as a rig does that does not know
    who sees it: of the shot that fixes the rig frame, or where `simulate` holds the board in b01, b02
    and so on.

    Raises as `simulate` does, and BadInput for another name.
    """
    rig = load_rig(rig_file)
    number = re.fullmatch(r"b(\d{2,3})", shot)
    truth = _decide(rig, None, settings, seed, int(number[1]) if number else 1, 0)
    if shot not in [one.name for one in truth.plan]:
        raise BadInput("the simulator shows its board in shots b01, b02 and so on", where=shot)
    names = tuple(truth.pairs)
    truth = replace(truth, plan=tuple(replace(one, lit=names) for one in truth.plan))
    tasks = {
        name: [
            replace(task, sequence=truth.pairs[name].has_stripes)
            for task in _list_tasks(truth, name)
            if task.shot == shot
        ]
        for name in names
    }
    _render_all(rig, truth, tasks, out, THREADS, silent)


def start_random_stream(seed: int, *purpose: int) -> np.random.Generator:
    """Start random numbers of one purpose (`Stream`, and numbers below it) of a data set."""
    return np.random.default_rng([seed, *purpose])


def _decide(
    rig: Rig,
    subject: Path | None,
    settings: SimulationSettings,
    seed: int,
    shots: int | None,
    take: int,
) -> Truth:
    """Draw everything that is true of the data set before any image is made."""
    pairs = draw_true_pairs(rig, settings, seed)
    boards = {
        board.name: make_board(
            board, settings.board, start_random_stream(seed, Stream.BOARDS, number)
        )
        for number, board in enumerate(rig.boards)
    }
    shots = count_default_shots(len(pairs)) if shots is None else shots
    plan = plan_boards(rig, pairs, shots, start_random_stream(seed, Stream.PLAN)) if shots else []
    truth = Truth(rig.name, seed, settings, pairs, boards, tuple(plan), None, None, {})
    if subject is None:
        return truth
    person = body.load_subject(
        subject, settings.person, start_random_stream(seed, Stream.SKIN), settings.skin
    )
    motion, sways = None, dict.fromkeys(pairs, RigidTransform.identity())
    if moves(settings.person):
        living = animate(
            person,
            settings.person,
            start_random_stream(seed, Stream.LIFE, *([take] if take else [])),
        )
        times = files.compute_person_times(rig, PERSON_SHOT, settings.pace)
        every = [ms for by_frame in times.values() for ms in by_frame.values()]
        motion = Motion(living, times, (min(every) + max(every)) / 2.0)
        person = living.surface(motion.moment_ms)
        sways = {name: motion.trunk(name) for name in pairs}
    pseudonym = f"sim-{subject.stem.replace('_', '-')}"
    return replace(truth, subject=pseudonym, person=person, sways=sways, motion=motion)


def draw_true_pairs(rig: Rig, settings: SimulationSettings, seed: int) -> dict[str, TruePair]:
    """Build the pairs of a data set with these settings and seed."""
    return build_pairs(
        rig, settings, lambda number: start_random_stream(seed, Stream.PAIRS, number)
    )


def _list_tasks(truth: Truth, pair: str) -> list[Task]:
    """List what one pair captures: its board shots, then the person."""
    light, motion = truth.settings.lighting, truth.motion
    tasks = [
        Task(number, shot.name, CALIBRATION, truth.boards[shot.board].surfaces,
             shot.rig_from_board, light.board_grey, pair in shot.stripes)
        for number, shot in enumerate(truth.plan)
        if pair in (*shot.stripes, *shot.lit)
    ]  # fmt: skip
    if truth.person is None:
        return tasks
    surface = truth.person if motion is None else motion.body.surface(motion.middle_ms(pair))
    person = Task(
        len(truth.plan), PERSON_SHOT, PERSON, (surface,), RigidTransform.identity(),
        light.person_grey, truth.pairs[pair].has_stripes,
    )  # fmt: skip
    if motion is not None:
        person = replace(person, body=motion.body, frames_ms=motion.times[pair])
    return [*tasks, person]


def _render_all(
    rig: Rig,
    truth: Truth,
    tasks: Mapping[str, Sequence[Task]],
    out: Path,
    workers: int,
    progress: Progress,
) -> None:
    """Render every image of every pair's tasks; each thread has one pair at a time."""
    room, settings = build_room(truth.pairs.values(), truth.settings.room), truth.settings
    lock, done, total = Lock(), 0, sum(map(len, tasks.values()))
    progress("simulate", 0, total)

    def render(numbered: tuple[int, TruePair]) -> None:
        nonlocal done
        number, pair = numbered
        rays = start_random_stream(truth.seed, Stream.RAYS, number)
        view = View.from_camera(pair.camera, settings.optics, rays)
        pixels = start_random_stream(truth.seed, Stream.PIXELS, number)
        fixed = draw_fixed_pattern(pair.camera, settings.noise, pixels)
        for task in tasks[pair.name]:
            noise = start_random_stream(truth.seed, Stream.NOISE, number, task.number)
            _render_task(rig, pair, view, room, task, settings, out, noise, fixed)
            with lock:
                done += 1
                progress("simulate", done, total)

    map_threads(render, enumerate(truth.pairs.values()), workers=workers)


def _render_task(
    rig: Rig,
    pair: TruePair,
    view: View,
    room: Sequence[Surface],
    task: Task,
    settings: SimulationSettings,
    out: Path,
    rng: np.random.Generator,
    fixed: FixedPattern | None,
) -> None:
    """Cast, expose and write one pair's images of one shot; `fixed` is of its camera's sensor."""
    scene, moving = _build_scenes(pair, room, task)
    code, lighting = rig.pair(pair.name).projector, settings.lighting
    taken = settings.pace.order or rig.frames.sequence_names(code)
    flicker = draw_flicker(taken, settings, rng.spawn(1)[0])
    direction = np.array(lighting.window_from) / np.linalg.norm(lighting.window_from)
    window = pair.rig_from_camera.inverse().rotate(direction)
    lamps = Lamps(
        lighting.laser_grey, lighting.ambient_grey, 0.85 * pair.reach_mm, pair.reach_mm,
        lighting.window_grey, tuple(window.tolist()), settings.skin,
    )  # fmt: skip
    images = render_pair(
        scene, view, pair.projector, lamps, settings.projection, rng, frames=rig.frames, code=code,
        sequence=task.sequence, moving=moving, flicker=flicker,
    )  # fmt: skip
    length = choose_exposure(images[rig.frames.lit or "lit"], task.bright_grey, lighting)
    gains = {name: np.float32(flicker.get(name, Brightness()).gain) for name in images}
    exposed = {
        name: expose(image * length * gains[name], settings.noise, rng, fixed)
        for name, image in images.items()
    }
    if code and not code.is_projected and task.sequence:
        exposed = simulate_instrument(exposed, code, rig.frames)
    for frame, grey in exposed.items():
        name = fill(rig.files, shot=task.shot, pair=pair.name, frame=frame)
        files.write_image(out / task.folder / name, grey)


def _build_scenes(
    pair: TruePair, room: Sequence[Surface], task: Task
) -> tuple[Scene, Moving | None]:
    """Build the scene in the camera's frame, and how it moves from frame to frame if it does."""
    camera_from_rig = pair.rig_from_camera.inverse()
    camera_from_surfaces = camera_from_rig @ task.rig_from_surfaces
    around, living = [surface.transform(camera_from_rig) for surface in room], task.body

    def scene_with(surfaces: Sequence[Surface]) -> Scene:
        return Scene([*(surface.transform(camera_from_surfaces) for surface in surfaces), *around])

    scene = scene_with(task.surfaces)
    if living is None:
        return scene, None

    def scene_at(frame: str) -> Scene:
        # Images that an instrument keeps to itself have no times: it is quick.
        taken = task.frames_ms.get(frame)
        return scene if taken is None else scene_with((living.surface(taken),))

    # Motion is smooth: its largest displacement at a few moments suffices, with a margin.
    first, last = min(task.frames_ms.values()), max(task.frames_ms.values())
    moments = np.linspace(first, last, 5)
    start = living.vertices((first + last) / 2.0)
    away = [np.linalg.norm(living.vertices(ms) - start, axis=1).max() for ms in moments]
    reach_mm = 1.3 * float(max(away))
    return scene, Moving(len(task.surfaces), scene_at, reach_mm)
