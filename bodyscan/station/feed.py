"""Events to every open page, by server-sent events (WHATWG HTML, 9.2).

A page that was away asks for what it missed by the number of the last event that it had. One that is
too slow, or away too long, is told to begin anew: nothing waits for it, and no memory grows.
"""

from __future__ import annotations

import asyncio
import json
from collections import deque
from collections.abc import AsyncIterator
from typing import Any

BACKLOG = 400
"""Events that a page may be behind: of a scan some hundred."""


class Feed:
    """Numbered events, published by any thread, read by any number of pages."""

    def __init__(self) -> None:
        self._events: deque[tuple[int, str]] = deque(maxlen=BACKLOG)
        self.number = 0  # of the last event
        self.readers: set[asyncio.Event] = set()
        self._loop: asyncio.AbstractEventLoop | None = None

    def publish(self, event: dict[str, Any]) -> None:
        """Hand an event to all readers."""
        data = json.dumps(event, allow_nan=False)
        loop = self._loop
        if loop is None or loop.is_closed():
            self._append(data)
        else:
            loop.call_soon_threadsafe(self._append, data)

    def _append(self, data: str) -> None:
        self.number += 1
        self._events.append((self.number, data))
        for reader in self.readers:
            reader.set()

    async def read(self, after: int, pulse_s: float = 15.0) -> AsyncIterator[str]:
        """Events after that number, as text of an event stream, for as long as the reader wants.

        pulse_s: a comment is sent when nothing happened for so long, so that a lost connection shows.
        """
        self._loop = asyncio.get_running_loop()
        news = asyncio.Event()
        self.readers.add(news)
        try:
            while True:
                news.clear()
                first = self._events[0][0] if self._events else self.number + 1
                if not first - 1 <= after <= self.number:
                    after = self.number
                    yield f"id: {after}\nevent: anew\ndata: {{}}\n\n"
                for number, data in [one for one in self._events if one[0] > after]:
                    after = number
                    yield f"id: {number}\ndata: {data}\n\n"
                try:
                    await asyncio.wait_for(news.wait(), pulse_s)
                except TimeoutError:
                    yield ": still here\n\n"
        finally:
            self.readers.discard(news)
