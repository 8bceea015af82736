"""The station's page in a browser: a scan arrives, is judged, drawn and kept, through a kill."""

from __future__ import annotations

import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest
from browser import Page, browser_page, find_browser
from required import missing


@pytest.fixture
def rig_page(example: Path, tmp_path: Path) -> Iterator[tuple[Page, Path, list[str]]]:
    found = find_browser()
    if found is None or find_spec("uvicorn") is None:
        missing("no chromium, or starlette is not installed")
    (tmp_path / "inbox").mkdir()
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = str(free.getsockname()[1])
    at = [
        "--calibration",
        str(example / "made" / "calibration"),
        "--inbox",
        str(tmp_path / "inbox"),
    ]
    at += ["--out", str(tmp_path / "out"), "--port", port, "--quiet-s", "600"]
    small = ("fusion.points=20000", "mesh.depth=6", "export.formats=glb")
    line = [
        sys.executable,
        "-m",
        "bodyscan",
        "station",
        *at,
        *(x for s in small for x in ("--set", s)),
    ]
    with browser_page(found, tmp_path / "profile") as page:
        yield page, tmp_path, [*line, f"http://127.0.0.1:{port}/"]


def until(page: Page, expression: str, patience_s: float = 240.0) -> Any:
    deadline = time.monotonic() + patience_s
    while not (value := page.evaluate(expression)):
        assert time.monotonic() < deadline, f"never: {expression}"
        time.sleep(0.2)
    return value


def test_a_person_is_scanned_in_front_of_a_browser_and_kept_through_a_kill(
    example: Path, rig_page: tuple[Page, Path, list[str]]
) -> None:
    page, folder, [*line, address] = rig_page
    station = subprocess.Popen(line, stdout=subprocess.PIPE, text=True)
    assert station.stdout is not None
    assert address in station.stdout.readline()
    page.navigate(address, 1280, 900)
    until(page, "document.querySelector('#line').textContent === 'connected'")
    for number in range(30):
        (folder / "inbox" / f"rubbish<b>{number}").mkdir()
    shutil.copytree(example / "pole" / "captures" / "person", folder / "inbox" / "anna")
    until(page, "!document.querySelector('#decide').hidden")
    until(page, "document.querySelector('#body canvas').width > 300")
    marks = "['good', 'usable', 'bad']"
    grade = page.evaluate(f"{marks}.find(g => document.querySelector(`#verdict.${{g}}`))")
    page.evaluate("document.querySelector('[data-decision=keep]').click()")
    until(
        page,
        "document.querySelector('[data-decision=keep]').getAttribute('aria-pressed') === 'true'",
    )
    x, y, width, height = page.box("#body .stage")
    picture = page.picture((x + 0.3 * width, y + 0.1 * height, 0.4 * width, 0.8 * height))
    assert picture.std() > 12.0, "no body is drawn"
    station.send_signal(signal.SIGKILL)
    station.wait()
    until(page, "document.querySelector('#line').classList.contains('lost')")
    station = subprocess.Popen(line, stdout=subprocess.PIPE, text=True)
    try:
        until(page, "document.querySelector('#line').textContent === 'connected'")
        page.evaluate("location.hash = 'today'")
        mark = (
            "[...document.querySelectorAll('#rows tr')].find(r => r.textContent.includes('anna'))"
        )
        assert until(
            page, f"{mark}?.querySelector('.badge.{grade}') && {mark}.textContent.includes('Keep')"
        )
        for size in (400, 3840):
            page.navigate(f"{address}#now", size, 900)
            assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")
    finally:
        station.kill()
        station.wait()
    assert [url for url in page.requests if not url.startswith((address, "data:", "about:"))] == []
    assert [e for e in page.errors if "exceptionId" in e or "Security Policy" in e] == []
