"""What the station does besides answering: the watch, the rig's devices, a board carried round."""

from __future__ import annotations

import threading
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field
from itertools import chain
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any

from bodyscan.capture.devices import Devices, open_devices
from bodyscan.capture.exposure import find_exposures, measure_delays
from bodyscan.capture.session import Shot, capture_shot, refuse_existing_shot
from bodyscan.captures.folder import resolve_capture_path
from bodyscan.errors import BadInput, BodyscanError
from bodyscan.jobs.watching import Watched, watch
from bodyscan.rig.rig import Rig
from bodyscan.station.board_tour import BoardTour
from bodyscan.station.day import Day
from bodyscan.station.feed import Feed


@dataclass
class Operation:
    """The threads of a station; each tells the pages how far it is.

    rig_file: whose devices take the images and whose captures show the board; None: another program
        takes the images.
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
    _requests: SimpleQueue[Shot] = field(default_factory=SimpleQueue)
    _lock: threading.Lock = field(default_factory=threading.Lock)
    _threads: list[threading.Thread] = field(default_factory=list)

    @property
    def can_capture(self) -> bool:
        return self.rig_file is not None and self.rig.capture is not None

    def start(self) -> None:
        """Start the watch, and the thread that holds the devices."""
        self._run(self._watch)
        if self.can_capture:
            self._run(self._capture)

    def stop(self) -> None:
        """End all threads, and wait for them; jobs that run are begun anew at the next start."""
        self.stopped.set()
        for thread in self._threads:
            thread.join(30.0)

    def _run(self, work: Any) -> None:
        thread = threading.Thread(target=work, daemon=True)
        thread.start()
        self._threads.append(thread)

    def _watch(self) -> None:
        try:
            watch(self.watched, self.listen, stopped=self.stopped)
        except BodyscanError as error:
            self._complain(str(error))
        except Exception as error:
            self._complain(f"the watch ended: {type(error).__name__}: {error}")
            raise

    def _complain(self, text: str) -> None:
        self.trouble = text
        self.feed.publish({"kind": "trouble", "text": text})

    def listen(self, event: dict[str, Any]) -> None:
        """Hand an event of the watch on to the pages, as the row that it changed."""
        row = self.day.take(event)
        if row is not None:
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

    def _request(self, shot: Shot) -> None:
        if not self.can_capture:
            raise BadInput("the rig file does not say which devices take its images")
        refuse_existing_shot(self.rig, shot)
        with self._lock:
            if self.capturing["state"] not in ("idle", "failed"):
                raise BadInput("the rig is taking images already")
            self._show("asked", shot=shot.name, scan=shot.folder.name)
        self._requests.put(shot)

    def _show(self, state: str, **more: Any) -> None:
        self.capturing = {"state": state, **more}
        self.feed.publish({"kind": "capture", **self.capturing})

    def _capture(self) -> None:
        """Take what is asked for; devices stay open from the first time, and until something fails."""
        with ExitStack() as held:
            devices: Devices | None = None
            while not self.stopped.is_set():
                with suppress(Empty):
                    shot = self._requests.get(timeout=0.2)
                    try:
                        devices = devices or self._open(held)
                        found = capture_shot(devices, shot, self._report)
                        self._show("idle", lost=dict(found.lost), retaken=found.retaken)
                    except Exception as error:
                        held.close()
                        devices = None
                        self._show("failed", reason=str(error))

    def _open(self, held: ExitStack) -> Devices:
        assert self.rig_file is not None
        self._show("opening")
        devices = held.enter_context(open_devices(self.rig, self.rig_file.parent))
        measure_delays(devices)
        if devices.plan.exposure_ms is None:
            for pair, exposure in find_exposures(devices):
                self.feed.publish({"kind": "exposure", "text": exposure.describe(pair)})
        return devices

    def _report(self, stage: str, done: int, total: int) -> None:
        self._show("taking", done=done, total=total)

    def tour_boards(self) -> dict[str, Any]:
        """What the board's tour has found so far; the first call begins to look.

        Raises BadInput without a rig file.
        """
        if self.rig_file is None:
            raise BadInput("start the station with --rig RIG.YAML to calibrate")
        with self._lock:
            if self.tour is None:
                self.tour = BoardTour(self.rig_file)
                self._run(self._look_at_boards)
                self._run(self._solve_boards)
        return self.tour.describe()

    def _look_at_boards(self) -> None:
        assert self.tour is not None
        while not self.stopped.wait(0.1):
            try:
                if self.tour.look():
                    self.feed.publish({"kind": "boards", **self.tour.describe()})
            except Exception as error:  # such as a board of another size; the next look is another
                self._complain(str(error))

    def _solve_boards(self) -> None:
        """Solve whenever no image came for a moment: while they come, the advice is more urgent."""
        assert self.tour is not None
        before = 0
        while not self.stopped.wait(0.5):
            images, solved = len(self.tour.looked), self.tour.solved.get("images", 0)
            if images == before > solved and len(self.tour.seen) > 2:
                self.tour.solve()
                self.feed.publish({"kind": "boards", **self.tour.describe()})
            before = images
