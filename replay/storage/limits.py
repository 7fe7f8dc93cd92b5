"""How long a server is waited for."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from contextvars import ContextVar
from dataclasses import dataclass
from typing import Final

_PART: Final = 1 << 20


@dataclass(frozen=True, slots=True)
class Limits:
    """Time limits for servers, in seconds.

    Attributes:
        total: for a part of a log, tries and waits together; of a part above 1 MiB for each MiB.
        read: without a byte, after which the server is asked again.
    """

    total: float = 60.0
    read: float = 20.0

    def of(self, count: int) -> float:
        """Seconds for `count` bytes."""
        return self.total * max(1.0, count / _PART)


_LIMITS: Final = ContextVar("limits", default=Limits())  # noqa: B039 - it is frozen


def limits() -> Limits:
    """Those that hold here."""
    return _LIMITS.get()


@contextlib.contextmanager
def limited(chosen: Limits) -> Iterator[None]:
    """Hold the servers that are connected to in the body to these limits."""
    before = _LIMITS.set(chosen)
    try:
        yield
    finally:
        _LIMITS.reset(before)
