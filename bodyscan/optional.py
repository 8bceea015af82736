"""What a result stands without: pictures, tables, advice. It fails by itself, and says so."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from bodyscan.errors import BodyscanError, plainly

LOG = logging.getLogger("bodyscan")


@contextmanager
def optional(what: str, say: Callable[[str], object]) -> Iterator[None]:
    """Whatever the block raises is one line to `say`, and its traceback a line of the debug log.

    Only for what comes after the result was written, or does not enter it.
    """
    try:
        yield
    except BodyscanError as error:
        say(f"{what}: left out: {plainly(error)}")
        LOG.debug("%s", what, exc_info=True)
    except Exception as error:
        say(
            f"{what}: left out, failed with {type(error).__name__}: {error} (the result stands; "
            "--debug shows where)"
        )
        LOG.debug("%s", what, exc_info=True)
