"""What every scene and every recording can be told (keys `scene.*` and `record.*`), and --split.

Imported by `world` and `log`. What only one scene has stands with that scene.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any, ClassVar, Final, Literal

from cdmisfa.core.clock import RECORDED_FPS, START_NS
from cdmisfa.core.config import Section, key
from cdmisfa.core.errors import UsageError

Compression = Literal["zstd", "lz4", "none"]
"""What the chunks of a log can be compressed with."""

_BYTES: Final = {"kB": 10**3, "MB": 10**6, "GB": 10**9, "KiB": 2**10, "MiB": 2**20, "GiB": 2**30}
_SECONDS: Final = {"s": 1.0, "min": 60.0, "h": 3600.0}


@dataclass(frozen=True, slots=True)
class SceneConfig(Section):
    """What every scene can be told; each adds its own keys.

    Attributes:
        kind: name of the scene; each gives its own.
        seed: of what moves in it; None is "as the run's seed".
    """

    prefix: ClassVar[str] = "scene"
    kind: str = ""
    seed: int | None = key(None, 0)


@dataclass(frozen=True, slots=True)
class RecordConfig(Section):
    """How frames become a log (keys `record.*`).

    Attributes:
        fps: frames per second of the common clock.
        start_ns: log time of frame 0, in nanoseconds; never the wall clock, so that a
            recording is the same bytes every time.
        compression: of the chunks.
        chunk_size: most bytes of a chunk before compression.
    """

    prefix: ClassVar[str] = "record"
    fps: float = key(50.0, *RECORDED_FPS)
    start_ns: int = key(START_NS, 0, 2**62)
    compression: Compression = "zstd"
    chunk_size: int = key(1024 * 1024, 1024, 2**27)


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


def check_view_names(names: tuple[str, ...], key: str) -> None:
    """Refuse names of views that could not be told apart, or not be names of files.

    Raises:
        UsageError: at the first such name.
    """
    plain = all(name.isidentifier() and name.isascii() and len(name) <= 64 for name in names)
    if not names or not plain or len(set(names)) != len(names):
        given = ", ".join(map(repr, names))
        raise UsageError(f"{key} is {given}: name each view once, by letters, digits and _")
