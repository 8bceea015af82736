"""The station's addresses and what they answer: Starlette behind the guard, served by uvicorn."""

from __future__ import annotations

import base64
import json
import re
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.requests import ClientDisconnect, Request
from starlette.responses import FileResponse, Response, StreamingResponse
from starlette.routing import Route

from bodyscan.captures.folder import open_scan
from bodyscan.errors import BadInput, BodyscanError
from bodyscan.files.reading import read_regular
from bodyscan.jobs.job import MEASURES
from bodyscan.station.day import Row, format_table_csv
from bodyscan.station.guard import Guard, TooLarge
from bodyscan.station.operation import Operation
from bodyscan.station.rig_history import describe_rig, find_series

KINDS = {
    "html": "text/html",
    "css": "text/css",
    "js": "text/javascript",
    "json": "application/json",
}
READERS = 40
"""Open pages: more than a rig has people around it, fewer than exhaust a computer."""
REPORT_POLICY = (
    "sandbox allow-scripts; default-src 'none'; img-src data:; style-src 'unsafe-inline'; "
    "script-src 'unsafe-inline'"
)
"""A report carries its script inside; it may do nothing in the station's name."""


@dataclass
class Station:
    """One station's answers."""

    operation: Operation

    async def state(self, request: Request) -> Response:
        operation = self.operation
        calibration = operation.watched.calibration
        return _answer({
            "number": self.operation.feed.number,
            "rows": self.operation.day.rows(),
            "capture": operation.capturing,
            "can_capture": operation.can_capture,
            "has_rig": operation.rig_file is not None,
            "trouble": operation.trouble,
            "rig": await run_in_threadpool(describe_rig, calibration, operation.rig.name),
        })  # fmt: skip

    async def events(self, request: Request) -> Response:
        last = request.headers.get("last-event-id") or request.query_params.get("after", "0")
        if len(self.operation.feed.readers) >= READERS:
            return _answer({"what": "too many pages are open"}, 503)
        after = int(last) if last.isdecimal() and len(last) < 16 else 0
        return StreamingResponse(self.operation.feed.read(after), media_type="text/event-stream")

    async def start(self, request: Request) -> Response:
        subject = (await _object(request)).get("subject")
        if not isinstance(subject, str) or not re.fullmatch(r"\w[\w.-]{0,59}", subject):
            raise BadInput("a pseudonym has letters, digits, '_', '-' and '.' only, 60 at most")
        return _answer({"scan": self.operation.request_person(subject)})

    async def board(self, request: Request) -> Response:
        return _answer({"shot": self.operation.request_board()})

    async def calibrate(self, request: Request) -> Response:
        self.operation.request_calibration()
        return _answer({})

    async def boards(self, request: Request) -> Response:
        return _answer(await run_in_threadpool(self.operation.tour_boards))

    async def decide(self, request: Request) -> Response:
        row = self.operation.day.decide(request.path_params["job"], await _object(request))
        self.operation.feed.publish({"kind": "scan", "row": row})
        return _answer(row)

    async def body(self, request: Request) -> Response:
        model = await run_in_threadpool(self.operation.day.body, self._row(request)["job"])
        return _answer(model) if model else _answer_absent()

    async def picture(self, request: Request) -> Response:
        scan = self.operation.day.out / self._row(request)["job"] / "scan"
        return _send(scan / ("cloud.png" if (scan / "cloud.png").is_file() else "mesh.png"))

    async def report(self, request: Request) -> Response:
        path = self.operation.day.out / self._row(request)["job"] / "report" / "report.html"
        return _send(path, headers={"content-security-policy": REPORT_POLICY})

    async def pair(self, request: Request) -> Response:
        seen = await run_in_threadpool(self._look, self._row(request), request.path_params["pair"])
        return _answer(seen) if seen else _answer_absent()

    async def csv(self, request: Request) -> Response:
        attached = {"content-disposition": "attachment; filename=day.csv"}
        table = format_table_csv(self.operation.day.rows()).encode("utf-8", "backslashreplace")
        return Response(table, media_type="text/csv", headers=attached)

    async def measures(self, request: Request) -> Response:
        return _send(self.operation.day.out / MEASURES, filename=MEASURES)

    async def rig(self, request: Request) -> Response:
        day = self.operation.day
        folders = [day.out / row["job"] for row in day.rows() if row["state"] == "done"]
        return _answer(await run_in_threadpool(find_series, folders))

    def _row(self, request: Request) -> Row:
        """The row that an address names. Raises KeyError for anything else."""
        return self.operation.day.row(request.path_params["job"])

    def _look(self, row: Row, pair: str) -> dict[str, Any] | None:
        """A pair's lit image, small, and how bright it is; None if it is not there."""
        rig = self.operation.rig
        captures = open_scan(rig, self.operation.watched.inbox / row["scan"])
        paths = [s.board_path for s in captures.pair_sequences(pair) if s.board_path.is_file()]
        if not paths:
            return None
        data = np.frombuffer(read_regular(paths[0], 200_000_000), np.uint8)
        image = cv2.imdecode(data, cv2.IMREAD_REDUCED_GRAYSCALE_2)
        if image is None:
            return None
        small = cv2.resize(image, (240, max(1, 240 * image.shape[0] // image.shape[1])))
        packed = base64.b64encode(cv2.imencode(".jpg", small)[1].tobytes()).decode("ascii")
        bright = float(np.quantile(image, 0.99)) / 255.0
        saturated = float(np.mean(image >= 254))
        return {"picture": packed, "bright": bright, "saturated": saturated}


def make_app(operation: Operation, hosts: set[str], token: str | None = None) -> Guard:
    """The whole application; the operation's threads run as long as it does."""
    station = Station(operation)
    scan = "/api/scans/{job}"

    @asynccontextmanager
    async def run(_: Starlette) -> AsyncIterator[None]:
        operation.start()
        yield
        await run_in_threadpool(operation.stop)

    app = Starlette(
        routes=[
            *pages(),
            Route("/api/state", station.state),
            Route("/api/events", station.events),
            Route("/api/start", station.start, methods=["POST"]),
            Route("/api/board", station.board, methods=["POST"]),
            Route("/api/boards", station.boards),
            Route("/api/calibrate", station.calibrate, methods=["POST"]),
            Route("/api/rig", station.rig),
            Route("/api/day.csv", station.csv),
            Route("/api/measures.csv", station.measures),
            Route(scan, station.decide, methods=["POST"]),
            Route(f"{scan}/body", station.body),
            Route(f"{scan}/picture", station.picture),
            Route(f"{scan}/report", station.report),
            Route(f"{scan}/pairs/{{pair}}", station.pair),
        ],
        exception_handlers=dict.fromkeys((BodyscanError, KeyError, TooLarge), _explain),
        lifespan=run,
    )
    return Guard(app, hosts, token)


def pages() -> list[Route]:
    """What a browser shows: the files of this package by name, and nothing else."""
    room = files("bodyscan.station") / "pages"
    names = [f"languages/{one.name}" for one in (room / "languages").iterdir()]
    places = {name: room / name for name in ("station.css", "station.js", *names)}
    places |= {"": room / "index.html", "viewer.js": files("bodyscan.report") / "viewer.js"}

    def route(name: str) -> Route:
        kind = KINDS[places[name].name.rpartition(".")[2]]
        content = places[name].read_bytes()

        async def answer(request: Request) -> Response:
            return Response(content, media_type=kind)

        return Route(f"/{name}", answer)

    return [route(name) for name in places]


async def _object(request: Request) -> dict[str, Any]:
    """The JSON object in a request's body. Raises BadInput for anything else."""
    try:
        content = await request.json()
    except (ValueError, RecursionError, ClientDisconnect):  # the last: cut off
        content = None
    if not isinstance(content, dict):
        raise BadInput("send a JSON object")
    return content


async def _explain(request: Request, error: Exception) -> Response:
    if isinstance(error, BodyscanError):
        return _answer({"what": error.what, "remedy": error.remedy}, 409)
    return _answer({"what": "too long"}, 413) if isinstance(error, TooLarge) else _answer_absent()


def _answer(content: Any, status: int = 200) -> Response:
    """JSON in ASCII, as names of files need not be UTF-8."""
    return Response(json.dumps(content, allow_nan=False), status, media_type="application/json")


def _send(path: Path, **how: Any) -> Response:
    return FileResponse(path, **how) if path.is_file() else _answer_absent()


def _answer_absent() -> Response:
    return _answer({"what": "there is no such thing here"}, 404)
