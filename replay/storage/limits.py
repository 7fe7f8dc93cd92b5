"""How long a server is waited for."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from contextvars import ContextVar
from dataclasses import dataclass
from typing import Final

from cdmisfa.core.options import setting

_PART: Final = 1 << 20


@dataclass(frozen=True, slots=True)
class Limits:
    """Time limits for servers, in seconds; `total` is for tries and waits together."""

    total: float = setting(
        60.0,
        "Give up on a part of a log at a URL (of a large one, on each MiB) after so long.",
        unit="SECONDS",
        name="timeout",
        least=0.1,
        most=1e6,
    )
    read: float = setting(
        20.0,
        "Ask a server again that sends nothing for so long.",
        unit="SECONDS",
        name="read-timeout",
        least=0.1,
        most=1e6,
    )

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
