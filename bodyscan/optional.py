"""Optional parts of a result (pictures, tables, advice), whose failure leaves the result intact."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from bodyscan.errors import BodyscanError, format_error

LOG = logging.getLogger("bodyscan")


@contextmanager
def optional(what: str, say: Callable[[str], object]) -> Iterator[None]:
    """Report any error of the block as one line to `say`; its traceback goes to the debug log.

    Only for work that comes after the result was written, or that does not enter it.
    """
    try:
        yield
    except BodyscanError as error:
        say(f"{what}: left out: {format_error(error)}")
        LOG.debug("%s", what, exc_info=True)
    except Exception as error:
        say(
            f"{what}: left out, failed with {type(error).__name__}: {error} (the result stands; "
            "--debug shows where)"
        )
        LOG.debug("%s", what, exc_info=True)
