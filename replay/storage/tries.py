"""Asking a server again after what may be a passing fault."""

from __future__ import annotations

import asyncio
import contextlib
import random
import time
from collections.abc import Awaitable, Callable
from email.utils import parsedate_to_datetime
from typing import Final, TypeVar

from cdmisfa.core.errors import CdmisfaError

TRIES: Final = 6
FIRST_WAIT = 0.5
"""Seconds before the second try; each further wait is twice as long."""

_JITTER: Final = random.Random()
"""Keeps clients that failed together from coming back together; nothing else draws from it."""

Value = TypeVar("Value")


class UnreachableError(CdmisfaError):
    """A server that cannot be reached, or does not give parts of the log."""


class Again(Exception):  # noqa: N818 - asks for another try
    """What may go better the next time, after the seconds that the server asks for."""

    def __init__(self, reason: str = "", after: float = 0.0) -> None:
        super().__init__(reason)
        self.after = after


async def patiently(ask: Callable[[], Awaitable[Value]], seconds: float) -> Value:
    """Ask until there is an answer: up to `TRIES` times, and no longer than `seconds`.

    Raises:
        UnreachableError: there was none in time.
        Again: the last try failed, too.
    """
    clock = asyncio.get_running_loop().time
    end = clock() + seconds
    try:
        async with asyncio.timeout_at(end):
            for attempt in range(TRIES - 1):
                try:
                    return await ask()
                except Again as error:
                    wait = max(error.after, backoff(attempt))
                    if clock() + wait >= end:
                        if error.after < wait:
                            raise
                        raise UnreachableError(
                            f"{error} and asks for {error.after:.0f} s, longer than --timeout "
                            f"leaves of {seconds:g} s"
                        ) from error
                await asyncio.sleep(wait)
            return await ask()
    except TimeoutError:
        raise UnreachableError(
            f"the server took longer than {seconds:g} s: raise --timeout, or download it first"
        ) from None


def backoff(attempt: int) -> float:
    """Seconds to wait after so many failed tries (0 the first), with jitter."""
    return FIRST_WAIT * 2.0**attempt * _JITTER.uniform(0.5, 1.0)


def asked_wait(retry_after: str) -> float:
    """Seconds that a `Retry-After` header asks for: a number or a date; 0 where it is neither."""
    text = retry_after.strip()
    if text.isascii() and text.isdigit():
        return float(text[:12])
    with contextlib.suppress(ValueError, OverflowError):
        return max(parsedate_to_datetime(text).timestamp() - time.time(), 0.0)
    return 0.0
