"""Who may ask: pages of this station alone, on this computer or with its token.

A page of another site that runs in the same browser can send requests here too. So the name in `Host`
must be ours (else a name that was rebound to this address would do), requests must come from our own
pages, and those that change something carry JSON, which a form cannot send.
"""

from __future__ import annotations

import hmac
import secrets
from collections.abc import Awaitable, Callable, Collection, MutableMapping
from dataclasses import dataclass
from http.cookies import CookieError, SimpleCookie
from typing import Any
from urllib.parse import parse_qs

Scope = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[MutableMapping[str, Any]]]
Send = Callable[[MutableMapping[str, Any]], Awaitable[None]]
App = Callable[[Scope, Receive, Send], Awaitable[None]]

MAX_BODY_BYTES = 20_000
"""Of a request: a note of a thousand words, in any alphabet."""
COOKIE = "bodyscan-station"
HEADERS = {
    "content-security-policy": "default-src 'none'; script-src 'self'; style-src 'self'; "
    "img-src 'self' blob: data:; connect-src 'self'; base-uri 'none'; form-action 'none'; "
    "frame-ancestors 'none'",
    "x-content-type-options": "nosniff",
    "referrer-policy": "no-referrer",
    "cross-origin-resource-policy": "same-origin",
    "cross-origin-opener-policy": "same-origin",
    "cache-control": "no-store",
}


@dataclass(frozen=True)
class Guard:
    """An ASGI application in front of another.

    hosts: names and addresses, with the port, under which the station may be asked.
    token: to be given once in the link; None: everybody on this computer may ask.
    """

    app: App
    hosts: Collection[str]
    token: str | None = None

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            if scope["type"] == "lifespan":
                await self.app(scope, receive, send)
            return
        headers = {
            name.decode("latin-1"): value.decode("latin-1") for name, value in scope["headers"]
        }
        refusal = self._refuse(scope, headers)
        if refusal is not None:
            await _answer(send, *refusal)
        elif self.token is not None and not self._has_cookie(headers):
            await self._require_token(scope, send)
        else:
            await self.app(scope, _limit_body(receive), _add_headers(send))

    def _refuse(self, scope: Scope, headers: dict[str, str]) -> tuple[int, str] | None:
        """Status and reason if the request is not from a page of ours."""
        if headers.get("host", "") not in self.hosts:
            return 421, "this station has another name"
        origin = headers.get("origin")
        if origin is not None and origin.partition("://")[2] != headers["host"]:
            return 403, "the request comes from another site"
        from_elsewhere = headers.get("sec-fetch-site", "none") not in ("none", "same-origin")
        if from_elsewhere and not (scope["path"] == "/" and scope["method"] == "GET"):
            return 403, "the request comes from another site"
        if scope["method"] in ("GET", "HEAD"):
            return None
        if headers.get("content-type", "").partition(";")[0].strip() != "application/json":
            return 415, "send JSON"
        length = headers.get("content-length", "0")
        if not length.isdecimal() or int(length) > MAX_BODY_BYTES:
            return 413, f"send no more than {MAX_BODY_BYTES} bytes"
        return None

    def _has_cookie(self, headers: dict[str, str]) -> bool:
        try:
            found = SimpleCookie(headers.get("cookie", "")).get(COOKIE)
        except CookieError:
            return False
        return found is not None and _compare_secrets(found.value, self.token or "")

    async def _require_token(self, scope: Scope, send: Send) -> None:
        """Exchange a valid ?token= in the link for a cookie (303 to "/"); answer 401 otherwise."""
        given = parse_qs(scope["query_string"].decode("latin-1")).get("token", [""])[0]
        if scope["path"] != "/" or not _compare_secrets(given, self.token or ""):
            await _answer(send, 401, "open the link that the station printed when it started")
            return
        secure = "; Secure" if scope["scheme"] == "https" else ""
        cookie = f"{COOKIE}={self.token}; Path=/; HttpOnly; SameSite=Strict{secure}"
        await _answer(send, 303, "", [(b"location", b"/"), (b"set-cookie", cookie.encode())])


class TooLarge(Exception):
    """A body longer than it said."""


def make_token() -> str:
    """A token that nobody guesses."""
    return secrets.token_urlsafe(24)


def _compare_secrets(given: str, wanted: str) -> bool:
    return hmac.compare_digest(given.encode(), wanted.encode())


def _limit_body(receive: Receive) -> Receive:
    """Receive no more than MAX_BODY_BYTES, whatever the length was said to be."""
    got = 0

    async def receive_limited() -> MutableMapping[str, Any]:
        nonlocal got
        message = await receive()
        got += len(message.get("body", b""))
        if got > MAX_BODY_BYTES:
            raise TooLarge
        return message

    return receive_limited


def _add_headers(send: Send) -> Send:
    """Add HEADERS to an answer, except those that it has itself."""

    async def sending(message: MutableMapping[str, Any]) -> None:
        if message["type"] == "http.response.start":
            given = {name.lower() for name, _ in message["headers"]}
            more = [(n.encode(), v.encode()) for n, v in HEADERS.items() if n.encode() not in given]
            message = {**message, "headers": [*message["headers"], *more]}
        await send(message)

    return sending


async def _answer(
    send: Send, status: int, text: str, headers: list[tuple[bytes, bytes]] | None = None
) -> None:
    kind = [(b"content-type", b"text/plain; charset=utf-8")]
    start = {"type": "http.response.start", "status": status, "headers": [*kind, *(headers or [])]}
    send = _add_headers(send)
    await send(start)
    await send({"type": "http.response.body", "body": text.encode()})
