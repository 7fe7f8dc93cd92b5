"""What every scene and every recording can be told (keys `scene.*` and `record.*`).

Imported by `world` and `log`. What only one scene has stands with that scene.
"""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from cdmisfa.core.blocks import told_apart
from cdmisfa.core.clock import RECORDED_FPS, START_NS
from cdmisfa.core.config import within
from cdmisfa.core.errors import UsageError

Compression = Literal["zstd", "lz4", "none"]
"""What the chunks of a log can be compressed with."""


@dataclass(frozen=True, slots=True)
class SceneConfig:
    """What every scene can be told; each adds its own keys.

    Attributes:
        kind: name of the scene; each gives its own.
        seed: of what moves in it; None is "as the run's seed".
    """

    kind: str = ""
    seed: int | None = None

    def __post_init__(self) -> None:
        if self.seed is not None and self.seed < 0:
            raise UsageError(f"scene.seed is {self.seed}: it must be 0 or above")


@dataclass(frozen=True, slots=True)
class RecordConfig:
    """How frames become a log (keys `record.*`).

    Attributes:
        fps: frames per second of the common clock.
        start_ns: log time of frame 0, in nanoseconds; never the wall clock, so that a
            recording is the same bytes every time.
        compression: of the chunks.
        chunk_size: most bytes of a chunk before compression.
    """

    fps: float = 50.0
    start_ns: int = START_NS
    compression: Compression = "zstd"
    chunk_size: int = 1024 * 1024

    def __post_init__(self) -> None:
        within(self, "record", *RECORDED_FPS, "fps")
        within(self, "record", 0, 2**62, "start_ns")
        within(self, "record", 1024, 2**27, "chunk_size")


def check_view_names(names: tuple[str, ...], key: str) -> None:
    """Refuse names of views that could not be told apart, or not be names of files.

    Raises:
        UsageError: at the first such name.
    """
    if not names:
        raise UsageError(f"{key} is empty: name at least one")
    if len(set(names)) != len(names):
        raise UsageError(f"{key} names one twice: {', '.join(names)}")
    for name in names:
        if not (name.isidentifier() and name.isascii() and len(name) <= 64):
            raise UsageError(f"{key} has {name!r}: use letters, digits and _")


def view_names(streams: Sequence[str]) -> tuple[str, ...]:
    """Streams of others as names of views, which are those of files: "/cam/left" is cam_left.

    Letters lose their accents, those of other scripts stay.
    """
    names: list[str] = []
    for stream in streams:
        letters = unicodedata.normalize("NFKD", stream)
        bare = "".join(c for c in letters if not unicodedata.combining(c))
        names.append(re.sub(r"[^\w.-]+", "_", bare).strip("._-") or "stream")
    return told_apart(names)
