"""`Split`: where the parts of a view end."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any, Final

from cdmisfa.core.errors import UsageError

_BYTES: Final = {"kB": 10**3, "MB": 10**6, "GB": 10**9, "KiB": 2**10, "MiB": 2**20, "GiB": 2**30}
_SECONDS: Final = {"s": 1.0, "min": 60.0, "h": 3600.0}


@dataclass(frozen=True, slots=True)
class Split:
    """Where a new part begins; one of the two is set.

    Attributes:
        size: bytes of a part, exceeded by a chunk and the index at most.
        seconds: of log time in a part.
    """

    size: int | None = None
    seconds: float | None = None

    @classmethod
    def parse(cls, text: str) -> Split:
        """Read "512MB" or "10min".

        Raises:
            UsageError: it is neither.
        """
        found = re.fullmatch(r"(\d{1,9}(?:\.\d{1,6})?) ?([A-Za-z]+)", text.strip())
        number, unit = (float(found[1]), found[2]) if found else (0.0, "")
        if number > 0 and unit in _BYTES:
            return cls(size=max(round(number * _BYTES[unit]), 1))
        if number > 0 and unit in _SECONDS:
            return cls(seconds=number * _SECONDS[unit])
        raise UsageError(
            f"--split is {text!r}: give a size ({', '.join(_BYTES)}) or a duration "
            f"({', '.join(_SECONDS)}), as 512MB or 10min"
        )

    def __str__(self) -> str:
        """The limit as `parse` reads it, in the largest unit that it is a multiple of."""
        units: dict[str, Any] = _SECONDS if self.size is None else _BYTES
        limit = (self.seconds or 0.0) if self.size is None else self.size
        least = next(iter(units))
        unit = max(
            (u for u in units if limit % units[u] == 0), key=units.__getitem__, default=least
        )
        return f"{limit / units[unit]:.6f}".rstrip("0").rstrip(".") + unit

    def frames(self, fps: float) -> int | None:
        """Frames of a part, where a duration is given."""
        return None if self.seconds is None else max(round(self.seconds * fps), 1)
