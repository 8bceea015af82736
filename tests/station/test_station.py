"""The station: who may ask, what a page is told, what is kept; and a page in a browser."""

from __future__ import annotations

import asyncio
import json
import re
import shutil
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import MagicMock, Mock

import numpy as np
import pytest
from required import missing
from small_workspace import small_rig

from bodyscan.boards.view import BoardView
from bodyscan.capture.devices import load_capture_rig, open_devices
from bodyscan.capture.session import Shot, capture_shot
from bodyscan.errors import BadInput
from bodyscan.files.atomic import write_json, write_text
from bodyscan.jobs.pipeline import Pipeline
from bodyscan.jobs.watching import Watched
from bodyscan.registration.storage import calibration_id, load_calibration
from bodyscan.rig.rig import load_rig, write_rig
from bodyscan.simulation.files import scale_rig
from bodyscan.station.board_tour import BoardTour
from bodyscan.station.day import GIRTHS, Day, format_table_csv
from bodyscan.station.feed import BACKLOG, Feed
from bodyscan.station.operation import Operation
from bodyscan.station.serving import list_names_of_host, make_operation
from bodyscan.verdict import Verdict

try:
    from starlette.testclient import TestClient

    from bodyscan.station.server import make_app
except ImportError:
    TestClient = None

PROJECT = Path(__file__).parents[2]
STORED = PROJECT / "tests" / "data" / "stored-0.1.0" / "calibration"
JSON = {"content-type": "application/json"}


@pytest.fixture
def operation(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Operation:
    """Without threads: nothing happens but what a test does."""
    if TestClient is None:
        missing("starlette or httpx2 is not installed (pip install '.[station,dev]')")
    (tmp_path / "inbox").mkdir()
    pipeline = Pipeline(name="watch", kind="fuse")
    made = make_operation(Watched(tmp_path / "inbox", tmp_path / "out", STORED, pipeline), None)
    monkeypatch.setattr(Operation, "can_capture", True)
    monkeypatch.setattr(made, "start", lambda: None)
    return made


@pytest.mark.parametrize(
    ("method", "path", "headers", "body", "status"),
    [
        ("GET", "/", {}, b"", 200),
        ("GET", "/api/state", {"host": "evil.example:8765"}, b"", 421),
        ("GET", "/api/state", {"sec-fetch-site": "cross-site"}, b"", 403),
        ("GET", "/", {"sec-fetch-site": "cross-site"}, b"", 200),  # a link may be followed
        ("POST", "/api/start", {**JSON, "origin": "http://evil.example"}, b'{"subject": "a"}', 403),
        ("POST", "/api/start", {"content-type": "text/plain"}, b'{"subject": "a"}', 415),
        ("POST", "/api/start", {**JSON, "content-length": "1000000000"}, b"{}", 413),
        ("POST", "/api/start", JSON, b'{"subject": "../../etc"}', 409),
        ("POST", "/api/start", JSON, b'{"subject": "<script>"}', 409),
        ("POST", "/api/start", JSON, b"[" * 9000, 409),
        ("POST", "/api/scans/..%2F..%2Fetc", JSON, b'{"decision": "keep"}', 404),
        ("GET", "/api/scans/..%2F..%2Fetc/report", {}, b"", 404),
        ("GET", "/languages/ja.json", {}, b"", 200),
    ],
)
def test_only_the_stations_own_pages_are_answered(
    operation: Operation, method: str, path: str, headers: dict[str, str], body: bytes, status: int
) -> None:
    app = make_app(operation, list_names_of_host("127.0.0.1", 8765))
    with TestClient(app, base_url="http://127.0.0.1:8765") as client:
        answer = client.request(method, path, headers=headers, content=body)
        assert answer.status_code == status, answer.text
        assert "default-src 'none'" in answer.headers["content-security-policy"]
        sent = client.post("/api/start", headers=JSON, content=(b" " * 9000 for _ in range(9)))
        assert sent.status_code == 413, "longer than it said"
    assert list(operation.watched.inbox.iterdir()) == []


def test_from_another_computer_the_token_of_the_link_is_needed(operation: Operation) -> None:
    app = make_app(operation, list_names_of_host("10.0.0.5", 8765), "secret")
    with TestClient(app, base_url="http://10.0.0.5:8765", follow_redirects=False) as client:
        for wrong in ("/", "/?token=", "/?token=secreT", "/api/state", "/api/state?token=secret"):
            assert client.get(wrong).status_code == 401
        client.cookies.set("bodyscan-station", "secreT")
        assert client.get("/api/state").status_code == 401
        client.cookies.clear()
        entered = client.get("/?token=secret")
        assert (entered.status_code, entered.headers["location"]) == (303, "/")
        assert {"HttpOnly", "SameSite=Strict"} <= set(entered.headers["set-cookie"].split("; "))
        assert client.get("/api/state").json()["rows"] == []


def test_a_page_that_was_away_is_told_what_it_missed_or_to_begin_anew() -> None:
    async def read(feed: Feed, after: int, count: int) -> list[str]:
        reader = feed.read(after, pulse_s=0.01)
        return [await anext(reader) for _ in range(count)]

    feed = Feed()
    for number in range(3 * BACKLOG):
        feed.publish({"number": number})
    last = asyncio.run(read(feed, feed.number - 2, 3))
    assert [text.split("\n")[0] for text in last[:2]] == [f"id: {feed.number - k}" for k in (1, 0)]
    assert last[2].startswith(":"), "a sign of life"
    for lost in (0, BACKLOG, 10**9):
        assert "event: anew" in asyncio.run(read(feed, lost, 1))[0]


def test_what_people_decide_stays_and_what_is_taken_again_begins_anew(operation: Operation) -> None:
    out, day = operation.watched.out, operation.day
    operation.listen({"event": "images", "job": "anna", "scan": "anna", "pairs": {"p": [1, 9]}})
    assert operation.request_person("anna") == "anna-01"
    with pytest.raises(BadInput, match="already"):  # two who press Start at once
        operation.request_person("bea")
    with pytest.raises(BadInput, match="no such scan"):
        day.decide("anna", {"decision": "keep"})
    table = "name,value,low,high\nwaist girth,731.2,,\nhip girth,,940.4,962.3\nbust girth,,,\n"
    verdict = {"grade": "repeat", "reasons": ["moved 14 mm"]}
    facts = {"verdict": verdict, "alignment": {"motion_mm": {"p": 14.0}}, "person": None}
    write_text(out / "anna/measures/measures.csv", table)
    write_json(out / "anna/job.json", {"subject": "anna", "source": "../../inbox/anna"})
    write_json(out / "anna/state.json", {"state": "done", "seconds": 3.0})
    write_json(out / "anna/scan/scan.json", facts)
    operation.listen({"event": "job", "job": "anna", "state": "done"})
    row = day.row("anna")
    assert (row["mark"], row["sway_mm"], row["pairs"]) == ("bad", 14.0, {"p": [1, 9]})
    assert [row[girth] for girth in GIRTHS] == [None, 731.2, "940-962"]
    with pytest.raises(BadInput):
        day.decide("anna", {"decision": "burn"})
    day.decide("anna", {"decision": "discard", "note": "=HYPERLINK(1)<b>"})
    operation.day = again = Day(out)
    assert (again.row("anna")["decision"], again.row("anna")["grade"]) == ("discard", "repeat")
    assert ",'=HYPERLINK(1)<b>," in format_table_csv(again.rows())
    operation.listen({"event": "job", "job": "\udce9", "state": "set aside", "reason": "no UTF-8"})
    with TestClient(make_app(operation, {"testserver"})) as client:
        assert all(r"\udce9" in client.get(f"/api/{what}").text for what in ("state", "day.csv"))
    shutil.rmtree(out / "anna")  # as `forget` does
    assert [(row["job"], row["state"]) for row in again.rows()] == [("\udce9", "set aside")]
    operation.listen({"event": "images", "job": "anna", "scan": "anna", "pairs": {"p": [2, 9]}})
    assert (again.row("anna")["grade"], again.row("anna")["state"]) == (None, "arriving")


def test_every_language_has_all_words_and_translates_only_what_is_said() -> None:
    said = "".join(path.read_text("utf-8") for path in (PROJECT / "bodyscan").rglob("*.py"))
    joined = re.sub(r'"\s*f?"', "", said)
    rooms = PROJECT / "bodyscan/station/pages/languages"
    english = json.loads((rooms / "en.json").read_text("utf-8"))
    for file in rooms.glob("[!e]*.json"):
        words = json.loads(file.read_text("utf-8"))
        kinds, terms = words.pop("kinds"), words.pop("terms")
        assert [part for parts, _ in kinds for part in parts if part not in joined] == [], file
        assert [term for term in terms if f'"{term}"' not in said] == [], file
        fields = [re.findall(r"\{\w+\}", str(each)) for each in (english, words)]
        assert (words.keys(), sorted(fields[1])) == (english.keys(), sorted(fields[0])), file


def test_a_rig_is_calibrated_on_its_page_and_its_scans_are_watched_from_then_on(
    operation: Operation, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def calibrate(_: Path, folder: Path, progress: Any) -> tuple[Any, Path]:
        return load_calibration(shutil.copytree(STORED, folder, dirs_exist_ok=True)), folder

    monkeypatch.setattr("bodyscan.station.operation.calibrate_folder", calibrate)
    monkeypatch.setattr("bodyscan.station.operation.watch", lambda *_, stopped: stopped.wait())
    write_rig(tmp_path / "rig.yaml", operation.rig)
    watched = replace(operation.watched, calibration=tmp_path / "calibration")
    operation = make_operation(watched, tmp_path / "rig.yaml")
    told: list[dict[str, Any]] = []
    monkeypatch.setattr(operation.feed, "publish", told.append)
    with TestClient(make_app(operation, {"testserver"})) as client:
        assert client.get("/api/state").json()["rig"]["id"] is None
        assert client.post("/api/calibrate", headers=JSON, content="{}").status_code == 200
        while {"kind": "rig"} not in told and operation.capturing["state"] != "failed":
            time.sleep(0.01)
        assert client.get("/api/state").json()["rig"]["id"] == calibration_id(STORED)[:12]


def test_a_board_is_found_pair_by_pair_as_the_rig_takes_its_images(tmp_path: Path) -> None:
    rig = scale_rig(load_rig(small_rig(tmp_path)), 0.3, "shots")
    write_rig(tmp_path / "rig.yaml", rig)
    with (tmp_path / "rig.yaml").open("a") as file:
        file.write("capture: {camera: {kind: simulated, subject: nobody.ply, samples: 1}}\n")
    shot = Shot(tmp_path / "taken", name="b01", kind="calibration")
    with open_devices(load_capture_rig(tmp_path / "rig.yaml"), tmp_path) as devices:
        assert capture_shot(devices, shot).lost == {}
        with pytest.raises(BadInput, match="b01, b02 and so on"):
            capture_shot(devices, replace(shot, name="table"))
    tour = BoardTour(tmp_path / "rig.yaml")
    assert tour.look() == ""
    assert tour.describe()["advice"][0].endswith(f"they come into {tmp_path / 'shots'}")
    shutil.copytree(shot.folder, tmp_path / "shots", ignore=shutil.ignore_patterns("*.png"))
    names = [pair.name for pair in rig.pairs]
    for number, name in enumerate(names, start=1):
        there = tmp_path / "shots/b01" / name
        shutil.copytree(tmp_path / "taken/b01" / name, there, dirs_exist_ok=True)
        whole = (there / "lit.png").read_bytes()
        (there / "lit.png").write_bytes(whole[:-9])
        assert tour.look() == "", "half written"
        (there / "lit.png").write_bytes(whole)
        assert (tour.look(), tour.look()) == ("b01", "")
        told = tour.describe()
        assert [pair["boards"] for pair in told["pairs"]] == [1] * number + [0] * (4 - number)
        assert (told["shots"], told["last"], told["missed"], told["advice"]) == (1, "b01", [], [])
    shutil.copyfile(there / "dark.png", there / "again.png").replace(there / "lit.png")
    assert (tour.look(), tour.describe()["missed"]) == ("b01", names[3:]), "taken again"


def test_the_board_is_held_where_stripes_are_lacking_until_it_was_everywhere() -> None:
    tour = BoardTour(PROJECT / "rigs" / "three-pole-12.yaml")
    assert tour.describe()["next"] == {"say": "frame", "shot": "floor", "board": "board"}
    tour.views.append(BoardView("p1-1", "floor", "board", np.zeros(1, int), np.ones((1, 2))))
    assert tour.describe()["next"]["boards"] == 0
    names = [pair.name for pair in tour.rig.pairs]
    for number in range(24):
        shot, (y, x) = f"b{number}", divmod(number % 12, 4)
        for pair in tour.rig.pairs:
            at = np.array([[(x + 0.5) * pair.camera.width / 4, (y + 0.5) * pair.camera.height / 3]])
            tour.views.append(BoardView(pair.name, shot, "board", np.zeros(1, int), at))
        tour.missed[shot] = []
    assert tour.describe()["next"] == {"say": "checking"}, "covered pictures are not yet a good rig"
    tour.solved = {"images": 0, "advice": [], "weakest": "p3-1", "enough": False}
    assert {"holdShared", "p3-1", "p1"} <= {*tour.describe()["next"].values()}, "tying it"
    tour.solved = {"images": 0, "advice": [], "weakest": None, "enough": True}
    assert tour.describe()["next"] == {"say": "enough"}
    tour.looked, tour.lit = {("p1-1", "late", 0, 0)}, {("p2-3", f"b{k}") for k in range(21)}
    assert tour.describe()["next"].items() >= {"pair": "p2-3", "boards": 5}.items()
    tour.lit = set()
    even = {"floor", *(f"b{number}" for number in range(0, 24, 2))}
    tour.views = [v for v in tour.views if (v.pair in names[:6]) == (v.shot in even)]
    assert tour.describe()["next"] == {"say": "tie", "one": names[:6], "other": names[6:]}


def test_shots_are_enough_once_every_pair_sees_places_as_well_as_a_scan_needs(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    tour, module = BoardTour(PROJECT / "rigs" / "three-pole-12.yaml"), "bodyscan.station.board_tour"
    names = [pair.name for pair in tour.rig.pairs]
    tour.views = [BoardView(n, "b1", "board", np.zeros(1, int), np.ones((1, 2))) for n in names]
    tour.missed = {"b1": []}
    found: dict[str, Any] = {"collect_figures": [], "grade_calibration": Verdict("good", ())}
    for name in ("calibrate_cameras", "locate_views", "solve_rig", "solve_boards", "open_captures"):
        found[name] = MagicMock(**{"calibration.failed": {}})
    for name, value in found.items():
        monkeypatch.setattr(f"{module}.{name}", Mock(return_value=value))
    cases = [(6, 0.04, 1.0, 0), (6, 0.03, 1.9, 1), (6, 0.03, 2.1, 0), (20, 0.04, 1.0, 1)]
    for boards, mm, times, enough in [*cases, (6, 0.03, -1.1, 0)]:  # negative: too little seen
        beyond = Mock(return_value=[(abs(times), times > 0.0, "figure")])
        found["collect_figures"][:] = [SimpleNamespace(name="p2-3", beyond=beyond)]
        monkeypatch.setattr(tour, "_count_boards", dict.fromkeys(names, boards).copy)
        sigmas = {name: mm if name == "p2-3" else 0.01 for name in names}
        monkeypatch.setattr(f"{module}.assess_pairs", Mock(return_value=(sigmas, ["note"])))
        tour.solve()
        told = {"enough": bool(enough), "weakest": None if enough else "p2-3", "advice": ["note"]}
        assert tour.solved.items() >= told.items()
