"""Start the station: what it needs is looked at first, then it serves until it is stopped."""

from __future__ import annotations

import ipaddress
import socket
import threading
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from bodyscan.capture.devices import load_capture_rig
from bodyscan.errors import BadInput, FailedWork
from bodyscan.jobs.job import CALIBRATION
from bodyscan.jobs.stages import read_rig_of
from bodyscan.jobs.watching import Watched
from bodyscan.station.day import Day
from bodyscan.station.feed import Feed
from bodyscan.station.guard import make_token
from bodyscan.station.operation import Operation


@dataclass(frozen=True)
class Address:
    """Where a station is reached. certificate, key: for https; None: plain http."""

    host: str = "127.0.0.1"
    port: int = 8765
    certificate: Path | None = None
    key: Path | None = None

    @property
    def link(self) -> str:
        scheme = "http" if self.certificate is None else "https"
        return f"{scheme}://{self.host}:{self.port}/"


def serve(
    watched: Watched, rig_file: Path | None, address: Address, say: Callable[[str], None]
) -> None:
    """Serve until stopped. Raises BadInput for what cannot work, before anything is served."""
    operation = make_operation(watched, rig_file)
    try:
        import uvicorn

        from bodyscan.station.server import make_app
    except ImportError as error:
        raise BadInput(
            "the station needs the packages starlette and uvicorn, which are not installed",
            remedy="pip install 'bodyscan[station]'",
        ) from error
    if (address.certificate is None) != (address.key is None):
        raise BadInput("https needs both --certificate and --key")
    token = None if is_loopback(address.host) else make_token()
    app = make_app(operation, list_names_of_host(address.host, address.port), token)
    say(f"open {address.link}{f'?token={token}' if token else ''}")
    if token and address.certificate is None:
        say(
            "whoever listens on this network can read the page and its token: give --certificate and "
            "--key (docs/station.md)"
        )
    config = uvicorn.Config(
        app,
        host=address.host,
        port=address.port,
        log_level="warning",
        ssl_certfile=address.certificate,
        ssl_keyfile=address.key,
        timeout_graceful_shutdown=1,
        server_header=False,
        proxy_headers=False,
        h11_max_incomplete_event_size=16_384,
    )
    # In a thread of its own: a signal that stops the command shows no traceback of what was open.
    server = uvicorn.Server(config)
    serving = threading.Thread(target=server.run, daemon=True)
    serving.start()
    serving.join()
    if not server.started:
        raise FailedWork(
            "cannot be served", where=address.link, remedy="give another --port or --host"
        )


def make_operation(watched: Watched, rig_file: Path | None) -> Operation:
    """What a station does. Raises BadInput for a calibration or rig file that cannot be used."""
    if not watched.inbox.is_dir():
        raise BadInput("there is no such folder", where=str(watched.inbox), remedy="make it first")
    watched.out.mkdir(parents=True, exist_ok=True, mode=0o700)
    is_there = (watched.calibration / CALIBRATION).exists()
    calibrated = read_rig_of(watched.calibration) if is_there or rig_file is None else None
    rig = calibrated if rig_file is None else load_capture_rig(rig_file)
    assert rig is not None
    if calibrated and [pair.name for pair in rig.pairs] != [pair.name for pair in calibrated.pairs]:
        raise BadInput(
            "has other pairs than the calibration",
            where=str(rig_file),
            remedy="give the rig file that was calibrated, or another folder to calibrate into",
        )
    return Operation(watched, rig_file, rig, Day(watched.out), Feed())


def list_names_of_host(host: str, port: int) -> set[str]:
    """Names under which a browser may ask for a station that listens there, with the port."""
    names = {host}
    if is_loopback(host):
        names |= {"127.0.0.1", "localhost", "[::1]"}
    elif host in ("0.0.0.0", "::"):
        names |= {"127.0.0.1", "localhost", socket.gethostname(), socket.getfqdn()}
        names |= {str(info[4][0]) for info in socket.getaddrinfo(socket.gethostname(), port)}
    portless = names if port in (80, 443) else set()
    return portless | {f"{name}:{port}" for name in names}


def is_loopback(host: str) -> bool:
    """Whether only this computer reaches it."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"
