"""What the station does besides answering: the watch, the rig's devices, a board carried round."""

from __future__ import annotations

import threading
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field
from functools import partial
from itertools import chain
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any

from bodyscan.capture.devices import Devices, open_devices
from bodyscan.capture.exposure import find_exposures, measure_delays
from bodyscan.capture.session import Shot, capture_shot, refuse_existing_shot
from bodyscan.captures.folder import resolve_capture_path
from bodyscan.errors import BadInput, BodyscanError
from bodyscan.files.atomic import hold_folder
from bodyscan.jobs.job import CALIBRATION
from bodyscan.jobs.watching import Watched, watch
from bodyscan.registration.calibration_verdict import grade_calibration
from bodyscan.rig.rig import Rig
from bodyscan.station.board_tour import BoardTour
from bodyscan.station.day import Day
from bodyscan.station.feed import Feed
from bodyscan.workflows.calibrate_rig import calibrate_folder


@dataclass
class Operation:
    """The threads of a station; each tells the pages how far it is.

    rig_file: whose devices take the images and whose captures show the board; None: another program
        takes the images. A station with one needs no calibration yet: it is made on the page.
    """

    watched: Watched
    rig_file: Path | None
    rig: Rig
    day: Day
    feed: Feed
    stopped: threading.Event = field(default_factory=threading.Event)
    trouble: str = ""
    capturing: dict[str, Any] = field(default_factory=lambda: {"state": "idle"})
    tour: BoardTour | None = None
    _recalibrated: threading.Event = field(default_factory=threading.Event)
    _requests: SimpleQueue[Shot | None] = field(default_factory=SimpleQueue)  # None: calibrate
    _lock: threading.Lock = field(default_factory=threading.Lock)
    _threads: list[threading.Thread] = field(default_factory=list)

    @property
    def can_capture(self) -> bool:
        return self.rig_file is not None and self.rig.capture is not None

    def start(self) -> None:
        """Start the watch, and the thread that holds the devices and calibrates."""
        self._run(self._watch)
        if self.rig_file is not None:
            self._run(self._serve_requests, self.rig_file)

    def stop(self) -> None:
        """End all threads, and wait for them; jobs that run are begun anew at the next start."""
        self.stopped.set()
        self._recalibrated.set()
        for thread in self._threads:
            thread.join(30.0)

    def _run(self, work: Any, *arguments: Any) -> None:
        thread = threading.Thread(target=work, args=arguments, daemon=True)
        thread.start()
        self._threads.append(thread)

    def _watch(self) -> None:
        """Watch the inbox with the calibration that is there: a new one ends it, and it begins anew."""
        while True:
            self._recalibrated.clear()
            if self.stopped.is_set():
                return
            try:
                if (self.watched.calibration / CALIBRATION).exists():
                    self.trouble = ""
                    self.feed.publish({"kind": "rig"})
                    watch(self.watched, self.listen, stopped=self._recalibrated)
                self._recalibrated.wait(1.0)
            except BodyscanError as error:  # such as of a damaged calibration, which another mends
                self._complain(str(error))
                self._recalibrated.wait()
            except Exception as error:
                self._complain(f"the watch ended: {type(error).__name__}: {error}")
                raise

    def _complain(self, text: str) -> None:
        self.trouble = text
        self.feed.publish({"kind": "trouble", "text": text})

    def listen(self, event: dict[str, Any]) -> None:
        """Hand an event of the watch on to the pages, as the row that it changed."""
        if row := self.day.take(event):
            self.feed.publish({"kind": "scan", "row": row})

    def request_person(self, subject: str) -> str:
        """Have a person scanned; return the scan's name. Raises BadInput if that cannot be now."""
        taken = {path.name for path in self.watched.inbox.iterdir()}
        taken |= {row["scan"] for row in self.day.rows()}
        names = (f"{subject}-{number:02d}" for number in range(1, 10_000))
        name = next(name for name in names if name not in taken)
        self._request(Shot(self.watched.inbox / name, subject=subject))
        return name

    def request_board(self) -> str:
        """Have a shot of the board taken, the one that fixes the rig frame first; return its name.

        Raises BadInput if that cannot be now.
        """
        if self.rig_file is None or not self.rig.calibration:
            raise BadInput("the rig file names no calibration captures")
        folder = resolve_capture_path(self.rig_file, self.rig.calibration[0])
        there = {path.name for path in folder.glob("*")}
        first = filter(None, [self.rig.rig_frame.shot])
        names = chain(first, (f"b{number:02d}" for number in range(1, 10_000)))
        name = next(name for name in names if name not in there)
        self._request(Shot(folder, name=name, kind="calibration"))
        return name

    def request_calibration(self) -> None:
        """Have the rig calibrated by the boards so far. Raises BadInput if that cannot be now."""
        if self.rig_file is None:
            raise BadInput("start the station with --rig RIG.YAML to calibrate")
        self._enqueue(None, "calibrating")

    def _request(self, shot: Shot) -> None:
        if not self.can_capture:
            raise BadInput("the rig file does not say which devices take its images")
        refuse_existing_shot(self.rig, shot)
        self._enqueue(shot, "asked", shot=shot.name, scan=shot.folder.name)

    def _enqueue(self, request: Shot | None, state: str, **more: Any) -> None:
        with self._lock:
            if self.capturing["state"] not in ("idle", "failed"):
                raise BadInput("the rig is taking images, or is calibrated, already")
            self._show(state, **more)
        self._requests.put(request)

    def _show(self, state: str, **more: Any) -> None:
        self.capturing = {"state": state, **more}
        self.feed.publish({"kind": "capture", **self.capturing})

    def _serve_requests(self, rig_file: Path) -> None:
        """Take what is asked for; devices stay open from the first time, and until something fails."""
        with ExitStack() as held:
            devices: Devices | None = None
            while not self.stopped.is_set():
                with suppress(Empty):
                    shot = self._requests.get(timeout=0.2)
                    try:
                        if shot is None:
                            self._calibrate(rig_file, self.watched.calibration)
                            continue
                        devices = devices or self._open(held, rig_file.parent)
                        found = capture_shot(devices, shot, partial(self._report, "taking"))
                        self._show("idle", lost=dict(found.lost), retaken=found.retaken)
                    except Exception as error:
                        held.close()
                        devices = None
                        self._show("failed", reason=str(error))

    def _calibrate(self, rig_file: Path, folder: Path) -> None:
        """Calibrate as `calibrate-rig` does; the calibration before, if any, moves into its history."""
        with hold_folder(folder):
            found, _ = calibrate_folder(rig_file, folder, partial(self._report, "calibrating"))
        verdict = grade_calibration(found)
        self._show("idle", calibrated=verdict.mark, reasons=verdict.reasons)
        self._recalibrated.set()

    def _open(self, held: ExitStack, base: Path) -> Devices:
        self._show("opening")
        devices = held.enter_context(open_devices(self.rig, base))
        measure_delays(devices)
        if devices.plan.exposure_ms is None:
            for pair, exposure in find_exposures(devices):
                self.feed.publish({"kind": "exposure", "text": exposure.describe(pair)})
        return devices

    def _report(self, state: str, part: str, done: int, total: int) -> None:
        self._show(state, part=part, done=done, total=total)

    def tour_boards(self) -> dict[str, Any]:
        """What the board's tour has found so far; the first call begins to look.

        Raises BadInput without a rig file.
        """
        if self.rig_file is None:
            raise BadInput("start the station with --rig RIG.YAML to calibrate")
        with self._lock:
            if self.tour is None:
                self.tour = BoardTour(self.rig_file)
                self._run(self._look_at_boards, self.tour)
                self._run(self._solve_boards, self.tour)
        return self.tour.describe()

    def _look_at_boards(self, tour: BoardTour) -> None:
        while not self.stopped.wait(0.1):
            try:
                if tour.look():
                    self.feed.publish({"kind": "boards", **tour.describe()})
            except Exception as error:  # such as a board of another size; the next look is another
                self._complain(str(error))

    def _solve_boards(self, tour: BoardTour) -> None:
        """Solve whenever no image came for a moment: while they come, the advice is more urgent."""
        before = 0
        while not self.stopped.wait(0.5):
            images, solved = len(tour.looked), tour.solved.get("images", 0)
            if images == before > solved and len(tour.missed) > 2:
                tour.solve()
                self.feed.publish({"kind": "boards", **tour.describe()})
            before = images
