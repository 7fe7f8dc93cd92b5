"""Configuration that all scenes and recordings share (`scene.*`, `record.*`), and `--split`.

Keys of one scene only are in the module of that scene.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import ClassVar, Literal

from cdmisfa.core.clock import RECORDED_FPS, START_NS
from cdmisfa.core.config import Section, key
from cdmisfa.core.errors import UsageError

# Compression of the chunks of a log.
Compression = Literal["zstd", "lz4", "none"]


@dataclass(frozen=True, slots=True)
class SceneConfig(Section):
    """Keys of every scene; each adds its own.

    Attributes:
        kind: name of the scene.
        seed: seed of the motions in the scene. `auto` uses the seed of the run.
    """

    prefix: ClassVar[str] = "scene"
    kind: str = ""
    seed: int | None = key(None, 0)


@dataclass(frozen=True, slots=True)
class RecordConfig(Section):
    """Settings of a recording (keys `record.*`).

    Attributes:
        fps: frames per second of the clock that all streams share.
        start_ns: log time of frame 0 in nanoseconds. It is not the time of day, so that the same
            command writes the same bytes.
        compression: compression of the MCAP chunks: `zstd`, `lz4` or `none`.
        chunk_size: largest size of an MCAP chunk before compression (bytes).
    """

    prefix: ClassVar[str] = "record"
    fps: float = key(50.0, *RECORDED_FPS)
    start_ns: int = key(START_NS, 0, 2**62)
    compression: Compression = "zstd"
    chunk_size: int = key(1024 * 1024, 1024, 2**27)


def parse_split(text: str) -> float:
    """Return the length of a part of a recording in seconds, from a duration such as "10min".

    Raises:
        UsageError: the text is not a duration.
    """
    duration = re.fullmatch(r"(\d{1,9}(?:\.\d{1,6})?) ?(s|min|h)", text.strip())
    if duration is None or not float(duration[1]):
        raise UsageError(f"--split is {text!r}: give a duration such as 90s, 10min or 1h")
    return float(duration[1]) * {"s": 1, "min": 60, "h": 3600}[duration[2]]


def check_view_names(names: tuple[str, ...], key: str) -> None:
    """Check that names of views are distinct and can be file names.

    Raises:
        UsageError: they are not.
    """
    plain = all(name.isidentifier() and name.isascii() and len(name) <= 64 for name in names)
    if not names or not plain or len(set(names)) != len(names):
        actual = ", ".join(map(repr, names))
        raise UsageError(f"{key} is {actual}: name each view once, in letters, digits and _")
